"""UsdGeomMesh and gprims to triangles in the prim's own space, shared between instances."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from warp_dvct.errors import StageError
from warp_dvct.usd.context import Context, transform_points
from warp_dvct.usd.gprims import read_gprim
from warp_dvct.usd.primvars import Topology, corner_values
from warp_dvct.usd.refine import refine
from warp_dvct.usd.subdivision import SCHEMES
from warp_dvct.usd.triangulate import has_area, triangulate

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

# A corner's face may lean this far from the averaged normal of its point; beyond, the edge is meant to be seen.
CREASE_COSINE = float(np.cos(np.radians(40.0)))


@dataclass
class LocalMesh:
    """Triangles in the prim's space; counter-clockwise from outside.

    Attributes:
        points: float64 ``[v, 3]``.
        topology: Triangles and where their corners come from.
        normals: Unit normals per corner ``[t, 3, 3]``, or None for faceted.
        default_uvs: Texture coordinates ``[t, 3, 2]`` of a gprim, which authors none; None for a mesh.
        double_sided: As authored.
        values: Corner values of the prim's own primvars, by name and width, once they were asked for.
    """

    points: np.ndarray
    topology: Topology
    normals: np.ndarray | None
    default_uvs: np.ndarray | None
    double_sided: bool
    values: dict[tuple[str, int], np.ndarray | None] = field(default_factory=dict)


def read_local(prim: Usd.Prim, ctx: Context) -> LocalMesh | None:
    """The triangles of a Mesh or gprim; None where the prim has none.

    Raises:
        StageError: Points are NaN or infinite, indices are out of range, counts do not add up, a size is not positive.
    """
    from pxr import UsdGeom

    if prim.IsA(UsdGeom.Mesh):
        return _read_mesh(UsdGeom.Mesh(prim), ctx)
    shape = read_gprim(prim, ctx.time)
    if shape is None:
        return None
    count = len(shape.triangles)
    triangles, uvs, normals = shape.triangles, shape.uvs, shape.normals
    if _left_handed(prim, ctx):
        triangles, uvs = triangles[:, ::-1], uvs[:, ::-1]
        normals = None if normals is None else -normals[:, ::-1]
    # A gprim has neither faces nor points of its own: only constant primvars fit it.
    topology = Topology(triangles, np.zeros((count, 3), np.int64), np.zeros(count, np.int64), 0, 0, 0)
    double_sided = bool(UsdGeom.Gprim(prim).GetDoubleSidedAttr().Get(ctx.time))
    return LocalMesh(shape.points, topology, normals, uvs, double_sided)


def _left_handed(prim: Usd.Prim, ctx: Context) -> bool:
    from pxr import UsdGeom

    return UsdGeom.Gprim(prim).GetOrientationAttr().Get(ctx.time) == UsdGeom.Tokens.leftHanded


def _read_mesh(mesh: UsdGeom.Mesh, ctx: Context) -> LocalMesh | None:
    prim, path = mesh.GetPrim(), str(mesh.GetPath())
    points = np.array(mesh.GetPointsAttr().Get(ctx.time) or (), dtype=np.float64).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(ctx.time) or (), dtype=np.int64)
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(ctx.time) or (), dtype=np.int64)
    if not len(counts) or not len(points):
        ctx.notices.add(path, "has no faces or no points; nothing is drawn")
        return None
    _check_mesh(path, points, counts, indices)
    keep = np.ones(len(counts), bool)
    holes = np.array(mesh.GetHoleIndicesAttr().Get(ctx.time) or (), dtype=np.int64)
    if len(holes):
        if holes.min() < 0 or holes.max() >= len(counts):
            raise StageError(f"{path}: holeIndices go up to {holes.max()}, but there are {len(counts)} faces")
        keep[holes] = False
    refined = refine(mesh, points, counts, indices, ctx)
    drawn = points if refined is None else refined.vertices(points)
    parts = (counts, indices, keep) if refined is None else (refined.counts, refined.indices, keep[refined.parents])
    cut = triangulate(drawn, *parts)
    corners, faces = cut.corners, cut.faces
    solid = has_area(drawn, parts[1][corners])
    dropped = int((~solid).sum()) + int((counts[keep] < 3).sum())
    if dropped:
        ctx.notices.add(path, f"{dropped} degenerate triangles dropped")
    if cut.folded:
        ctx.notices.add(path, f"{cut.folded} polygons cross themselves; their triangulation is a guess")
    if not solid.all():
        corners, faces = corners[solid], faces[solid]
    if _left_handed(prim, ctx):
        corners = corners[:, ::-1]
    of_face = faces if refined is None else refined.parents[faces]
    topology = Topology(parts[1][corners], corners, of_face, len(points), len(indices), len(counts), refined)
    double_sided = bool(mesh.GetDoubleSidedAttr().Get(ctx.time))
    # Normals that are authored on a subdivision mesh are not the surface's: UsdGeom asks to ignore them.
    normals = _normals(mesh, points, topology, ctx) if refined is None else _smooth(drawn, topology.triangles)
    return LocalMesh(drawn, topology, normals, None, double_sided)


def _check_mesh(path: str, points: np.ndarray, counts: np.ndarray, indices: np.ndarray) -> None:
    finite = np.isfinite(points).all(1)
    if not finite.all():
        bad = int(np.argmin(finite))
        raise StageError(
            f"{path}: {int((~finite).sum())} of {len(points)} points are NaN or infinite (the first is point {bad});"
            " clean the mesh"
        )
    if counts.min() < 0 or counts.sum() != len(indices):
        raise StageError(
            f"{path}: faceVertexCounts add up to {counts.sum()}, but there are {len(indices)} faceVertexIndices"
        )
    if len(indices) and (indices.min() < 0 or indices.max() >= len(points)):
        bad = indices[(indices < 0) | (indices >= len(points))][0]
        raise StageError(f"{path}: faceVertexIndices has the index {bad}, but there are {len(points)} points")


def _normals(mesh: UsdGeom.Mesh, points: np.ndarray, topology: Topology, ctx: Context) -> np.ndarray | None:
    """primvars:normals, else normals, else smooth ones on a subdivision mesh, else None: faceted."""
    from pxr import UsdGeom

    path = str(mesh.GetPath())
    subdivided = mesh.GetSubdivisionSchemeAttr().Get(ctx.time) in SCHEMES
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    authored = mesh.GetNormalsAttr()
    if not (primvar and primvar.HasAuthoredValue()):
        primvar = UsdGeom.Primvar(authored) if authored.HasAuthoredValue() else None
        if primvar is not None:
            return _unit(_attribute_normals(mesh, topology, ctx), points, topology)
    else:
        return _unit(corner_values(primvar, ctx, topology, 3, path), points, topology)
    return _smooth(points, topology.triangles) if subdivided else None


def _attribute_normals(mesh: UsdGeom.Mesh, topology: Topology, ctx: Context) -> np.ndarray | None:
    """The plain ``normals`` attribute, whose interpolation is kept apart from primvars."""
    from warp_dvct.usd.primvars import spread

    path = str(mesh.GetPath())
    values = np.array(mesh.GetNormalsAttr().Get(ctx.time) or (), dtype=np.float64).reshape(-1, 3)
    interpolation = str(mesh.GetNormalsInterpolation())
    corners = spread(values, interpolation, topology) if len(values) else None
    if corners is None or not np.isfinite(corners).all():
        ctx.notices.add(path, f"normals ({len(values)} values, '{interpolation}') do not fit the mesh and are not used")
        return None
    return corners


def _face_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Normals ``[t, 3]`` as long as twice the triangle's area."""
    a = points[triangles[:, 0]]
    return np.cross(points[triangles[:, 1]] - a, points[triangles[:, 2]] - a)


def _unit(normals: np.ndarray | None, points: np.ndarray, topology: Topology) -> np.ndarray | None:
    """Normalise; a corner whose normal is zero takes its triangle's."""
    if normals is None:
        return None
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    if not (length > 0.0).all():
        face = _face_normals(points, topology.triangles)
        normals = np.where(length > 0.0, normals, face[:, None])
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals / length


def _smooth(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Point normals weighted by the corners' angles; at a crease those of the faces on the corner's own side.

    Angles do not depend on how a face was cut into triangles (Thuermer and Wuethrich 1998).
    """
    face = _face_normals(points, triangles)
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    weighted = face[:, None] * _angles(points, triangles)[..., None]
    summed = np.stack(
        [np.bincount(triangles.ravel(), weighted[..., axis].ravel(), len(points)) for axis in range(3)], 1
    )
    summed /= np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-300)
    corners = summed[triangles]
    hard = np.einsum("tck,tk->tc", corners, face) < CREASE_COSINE
    if hard.any():
        corners[hard] = _own_side(triangles, face, weighted, hard)
    return corners


def _angles(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Of each triangle at each of its corners, ``[t, 3]``."""
    angles = np.empty(triangles.shape)
    for k in range(3):
        at = points[triangles[:, k]]
        a, b = points[triangles[:, (k + 1) % 3]] - at, points[triangles[:, (k + 2) % 3]] - at
        angles[:, k] = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("tk,tk->t", a, b))
    return angles


def _own_side(triangles: np.ndarray, face: np.ndarray, weighted: np.ndarray, hard: np.ndarray) -> np.ndarray:
    """Normals ``[n, 3]`` of the ``hard`` corners from the faces at their point that lean less than a crease from their
    own, which keeps both the edge and what is round beside it, as at the rim of a cylinder."""
    order = np.argsort(triangles.ravel(), kind="stable")
    number = np.bincount(triangles.ravel())
    first = np.cumsum(number) - number
    asked = np.flatnonzero(hard.ravel())
    around = number[triangles.ravel()[asked]]
    row = np.repeat(np.arange(len(asked)), around)
    step = np.arange(len(row)) - np.repeat(np.cumsum(around) - around, around)
    other = order[np.repeat(first[triangles.ravel()[asked]], around) + step]
    own = face[asked // 3][row]
    near = np.einsum("rk,rk->r", own, face[other // 3]) >= CREASE_COSINE
    values = weighted.reshape(-1, 3)[other[near]]
    summed = np.stack([np.bincount(row[near], values[:, axis], len(asked)) for axis in range(3)], 1)
    return summed / np.linalg.norm(summed, axis=1, keepdims=True)


@dataclass(frozen=True)
class WorldTriangles:
    """A :class:`LocalMesh` placed in the world once or several times, float64, float32 normals.

    ``repeat`` says how often per-corner values of the local mesh follow each other; ``flip`` says per copy whether the
    corners run backwards there, because its transform mirrors.
    """

    points: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray | None
    flip: np.ndarray

    def per_corner(self, values: np.ndarray) -> np.ndarray:
        """Copy values ``[t, 3, w]`` of the local corners for each placement, float32."""
        values = values.astype(np.float32)
        return np.concatenate([values[:, ::-1] if mirrored else values for mirrored in self.flip])

    def per_triangle(self, values: np.ndarray) -> np.ndarray:
        """Copy values ``[t]`` of the local triangles for each placement."""
        return np.tile(values, len(self.flip))


def place(local: LocalMesh, matrices: np.ndarray) -> WorldTriangles:
    """Put a mesh into the world by each of ``matrices`` ``[n, 4, 4]`` (row vectors, invertible).

    A mirroring transform reverses the winding, so that the outside stays outside.
    """
    flip = np.linalg.det(matrices[:, :3, :3]) < 0.0
    triangles = local.topology.triangles
    points = np.concatenate([transform_points(local.points, m) for m in matrices])
    base = np.arange(len(matrices)) * len(local.points)
    placed = np.concatenate(
        [(triangles[:, ::-1] if mirrored else triangles) + b for mirrored, b in zip(flip, base, strict=True)]
    )
    normals = None
    if local.normals is not None:
        turned = []
        for m, mirrored in zip(matrices, flip, strict=True):
            n = local.normals @ np.linalg.inv(m[:3, :3]).T
            n /= np.linalg.norm(n, axis=-1, keepdims=True)
            turned.append((n[:, ::-1] if mirrored else n).astype(np.float32))
        normals = np.concatenate(turned)
    return WorldTriangles(points, placed.astype(np.int32), normals, flip)

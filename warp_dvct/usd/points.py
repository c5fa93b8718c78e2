"""UsdGeom.Points: the points of a scan, each standing for a disc of surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warp_dvct.errors import StageError
from warp_dvct.extras import load_open3d
from warp_dvct.usd.context import Context
from warp_dvct.usd.geometry import LocalMesh
from warp_dvct.usd.primvars import Topology, flat_values

if TYPE_CHECKING:
    from pxr import UsdGeom

NORMAL_NEIGHBOURS = 16  # points that say how a surface lies
RADIUS_NEIGHBOURS = 8  # points that say how densely it is sampled
HOW_TO_INSTALL = 'author {what}, or install what estimates them: pip install "warp-dvct[reconstruct]"'


@dataclass
class LocalPoints(LocalMesh):
    """Points in the prim's space; ``topology.triangles`` is ``[n, 1]``: each point is a face with a single corner.

    Attributes:
        radii: Of the disc that a point stands for, float64 ``[n]``.
    """

    radii: np.ndarray | None = None


def read_points(prim: UsdGeom.Points, ctx: Context) -> LocalPoints | None:
    """The points of a prim, their normals and radii (half of ``widths``); None, and a notice, where it has none.

    Normals and widths that are not authored are estimated by neighbours: normals as the direction of least variance
    of the nearest sixteen points, of arbitrary sign, so that the points count as double-sided; radii so that as many
    discs as there are points within the distance of the eighth neighbour have that circle's area.

    Raises:
        StageError: Values are NaN, negative or do not fit the number of points, or something has to be estimated and
            Open3D is not installed.
    """
    path = str(prim.GetPath())
    points = np.array(prim.GetPointsAttr().Get(ctx.time) or (), dtype=np.float64).reshape(-1, 3)
    if not len(points):
        ctx.notices.add(path, "has no points; nothing is drawn")
        return None
    _check_finite(path, "points", points)
    normals = _values(prim, "normals", 3, len(points), ctx)
    widths = _values(prim, "widths", 1, len(points), ctx)
    double_sided = bool(prim.GetDoubleSidedAttr().Get(ctx.time)) or normals is None
    used = np.ones(len(points), bool)
    if widths is not None:
        if widths.min() < 0.0:
            raise StageError(f"{path}: widths go down to {widths.min():g}; they are diameters and cannot be negative")
        used &= widths[:, 0] > 0.0
    if normals is not None:
        used &= np.linalg.norm(normals, axis=1) > 0.0
    if not used.all():
        ctx.notices.add(path, f"{int((~used).sum())} points of no width or without a normal dropped")
    if not used.any():
        return None
    shown = points[used]
    normals = _estimated_normals(path, shown) if normals is None else normals[used]
    radii = _estimated_radii(path, shown) if widths is None else 0.5 * widths[used, 0]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    index = np.flatnonzero(used)[:, None]
    return LocalPoints(
        points=points,
        topology=Topology(index, index, index[:, 0], len(points), len(points), len(points)),
        normals=normals[:, None],
        default_uvs=None,
        double_sided=double_sided,
        radii=radii,
    )


def _values(prim: UsdGeom.Points, name: str, width: int, count: int, ctx: Context) -> np.ndarray | None:
    """``primvars:name``, else the plain attribute, at each point ``[n, width]``; None where neither is authored."""
    from pxr import UsdGeom

    path = str(prim.GetPath())
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(name)
    attribute = prim.GetPrim().GetAttribute(name)
    if primvar and primvar.HasAuthoredValue():
        values = flat_values(primvar, ctx, width)
    elif attribute.HasAuthoredValue():
        values = np.array(attribute.Get(ctx.time) or (), dtype=np.float64).reshape(-1, width)
    else:
        return None
    if values is None or not len(values):
        return None
    if len(values) not in (1, count):
        raise StageError(f"{path}: {len(values)} {name}, but {count} points; author one for each, or a single one")
    _check_finite(path, name, values)
    return np.broadcast_to(values, (count, width))


def _check_finite(path: str, name: str, values: np.ndarray) -> None:
    finite = np.isfinite(values).all(1)
    if not finite.all():
        raise StageError(
            f"{path}: {int((~finite).sum())} of {len(values)} {name} are NaN or infinite (the first is that of point"
            f" {int(np.argmin(finite))}); leave such points out"
        )


def _estimated_normals(path: str, points: np.ndarray) -> np.ndarray:
    if len(points) < 3:
        raise StageError(f"{path}: {len(points)} points without normals; author normals, no surface is to be seen")
    o3d = load_open3d(f"{path} has no normals: " + HOW_TO_INSTALL.format(what="normals"), StageError)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
    return np.asarray(cloud.normals).copy()


def _estimated_radii(path: str, points: np.ndarray) -> np.ndarray:
    if len(points) < 2:
        raise StageError(f"{path}: a single point without a width; author widths, the diameters of the points")
    o3d = load_open3d(f"{path} has no widths: " + HOW_TO_INSTALL.format(what="widths"), StageError)
    neighbours = min(RADIUS_NEIGHBOURS, len(points) - 1)
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(np.ascontiguousarray(points)))
    search.knn_index()
    _, squares = search.knn_search(o3d.core.Tensor(np.ascontiguousarray(points)), neighbours + 1)
    return np.sqrt(squares.numpy()[:, -1] / neighbours)


def placed_radii(local: LocalPoints, matrices: np.ndarray) -> np.ndarray:
    """Radii in the world, one placement after the other, ``[n * placements]``: discs keep the area they are given.

    A plane with normal n grows by |det M| |M^-T n|.
    """
    assert local.normals is not None
    assert local.radii is not None
    parts = []
    for m in matrices[:, :3, :3]:
        growth = np.abs(np.linalg.det(m)) * np.linalg.norm(local.normals[:, 0] @ np.linalg.inv(m).T, axis=1)
        parts.append(local.radii * np.sqrt(growth))
    return np.concatenate(parts)

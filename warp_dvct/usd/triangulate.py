"""Polygons to triangles, in NumPy: fans where a fan is right, ear clipping where it is not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# A fan triangle may turn the wrong way by this fraction of its polygon's area before the polygon counts as concave:
# collinear corners and float32 noise stay below it.
FAN_TOLERANCE = 1e-7
# Height over longest edge, squared, below which a triangle has no area that float32 could resolve.
SLIVER = 1e-10


@dataclass(frozen=True)
class Triangulation:
    """Triangles of a polygon mesh.

    Attributes:
        corners: Position of each triangle corner in ``faceVertexIndices``, int64, ``[t, 3]``.
        faces: Polygon that each triangle came from, int64, ``[t]``.
        folded: Polygons that cross themselves, so that no triangulation is exact.
    """

    corners: np.ndarray
    faces: np.ndarray
    folded: int = 0


def triangulate(points: np.ndarray, counts: np.ndarray, indices: np.ndarray, keep: np.ndarray) -> Triangulation:
    """Cut polygons into triangles that keep the winding; triangles stay in the order of their polygons.

    Args:
        points: ``[v, 3]`` float64.
        counts: Corners per polygon, ``[f]``; polygons with fewer than three corners give nothing.
        indices: ``[sum(counts)]`` into ``points``, all in range.
        keep: ``[f]`` bool; False leaves a polygon out (a hole).
    """
    starts = np.cumsum(counts) - counts
    corners: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    folded = 0
    for size in np.unique(counts[keep & (counts >= 3)]):
        members = np.nonzero(keep & (counts == size))[0]
        polygons = starts[members][:, None] + np.arange(size)
        if size == 3:
            corners.append(polygons)
            faces.append(members)
            continue
        fan = _fan(points[indices[polygons]])
        good = polygons[fan]
        corners.append(np.stack([np.broadcast_to(good[:, :1], good[:, 1:-1].shape), good[:, 1:-1], good[:, 2:]], -1))
        corners[-1] = corners[-1].reshape(-1, 3)
        faces.append(np.repeat(members[fan], size - 2))
        for polygon, face in zip(polygons[~fan], members[~fan], strict=True):
            ears, crossed = clip_ears(points[indices[polygon]])
            corners.append(polygon[ears])
            faces.append(np.full(len(ears), face))
            folded += crossed
    if not corners:
        return Triangulation(np.zeros((0, 3), np.int64), np.zeros(0, np.int64))
    all_corners, all_faces = np.concatenate(corners), np.concatenate(faces)
    if len(corners) > 1:
        order = np.argsort(all_faces, kind="stable")
        all_corners, all_faces = all_corners[order], all_faces[order]
    return Triangulation(all_corners, all_faces, folded)


def _fan(polygons: np.ndarray) -> np.ndarray:
    """Whether each polygon ``[f, n, 3]`` may be cut as a fan from its first corner: no triangle turns backwards."""
    spokes = polygons[:, 1:] - polygons[:, :1]
    areas = np.cross(spokes[:, :-1], spokes[:, 1:])
    normal = areas.sum(1)
    turning = np.einsum("fnk,fk->fn", areas, normal)
    return (turning >= -FAN_TOLERANCE * np.einsum("fk,fk->f", normal, normal)[:, None]).all(1)


def clip_ears(polygon: np.ndarray) -> tuple[np.ndarray, bool]:
    """Ear clipping of one polygon in space, projected along its Newell normal.

    Args:
        polygon: ``[n, 3]``; a hole may be joined to the border by a doubled edge.
    Returns:
        Triangles ``[n - 2, 3]`` into ``polygon``, and whether the polygon crosses itself, in which case the rest was
        cut off at its most convex corners.

    Meisters 1975, "Polygons have ears".
    """
    flat = _project(polygon)
    left = list(range(len(flat)))
    triangles: list[tuple[int, int, int]] = []
    crossed = False
    while len(left) > 3:
        ring = flat[left]
        turn = _cross2(ring - np.roll(ring, 1, 0), np.roll(ring, -1, 0) - ring)
        ear = _find_ear(ring, turn)
        if ear is None:
            crossed = True
            ear = int(np.argmax(turn))
        n = len(left)
        triangles.append((left[ear - 1], left[ear], left[(ear + 1) % n]))
        del left[ear]
    triangles.append((left[0], left[1], left[2]))
    return np.array(triangles), crossed


def _project(polygon: np.ndarray) -> np.ndarray:
    """Coordinates ``[n, 2]`` in the polygon's plane, in which it runs counter-clockwise."""
    centred = polygon - polygon.mean(0)
    normal = np.cross(centred, np.roll(centred, -1, 0)).sum(0)
    drop = int(np.argmax(np.abs(normal)))
    flat = centred[:, [(drop + 1) % 3, (drop + 2) % 3]]
    return flat if normal[drop] >= 0 else flat * np.array([-1.0, 1.0])


def _cross2(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _find_ear(ring: np.ndarray, turn: np.ndarray) -> int | None:
    """A convex corner whose triangle holds no other corner; failing that a flat corner, which has no area.

    Flat corners hold back an ear as reflex ones do: cut past one, and it would lie on an edge as a T-junction.
    """
    flat = np.abs(turn) <= FAN_TOLERANCE * np.abs(turn).max()
    blockers = ring[(turn < 0) | flat]
    # Corners in order of their sharpness would give nicer triangles; in ring order the result is stable.
    for i in np.nonzero((turn > 0) & ~flat)[0]:
        a, b, c = ring[i - 1], ring[i], ring[(i + 1) % len(ring)]
        # A corner at the same place as one of the ear's is the other end of a doubled edge, and does no harm.
        other = blockers[~((blockers == a).all(1) | (blockers == b).all(1) | (blockers == c).all(1))]
        inside = (_cross2(b - a, other - a) >= 0) & (_cross2(c - b, other - b) >= 0) & (_cross2(a - c, other - c) >= 0)
        if not inside.any():
            return int(i)
    if flat.any():
        return int(np.argmax(flat))
    return None


def has_area(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Which triangles ``[t, 3]`` have three distinct corners and an area that is more than rounding."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    ab, ac, bc = b - a, c - a, c - b
    area = np.cross(ab, ac)
    longest = np.maximum.reduce([np.einsum("tk,tk->t", e, e) for e in (ab, ac, bc)])
    distinct = (
        (triangles[:, 0] != triangles[:, 1])
        & (triangles[:, 1] != triangles[:, 2])
        & (triangles[:, 2] != triangles[:, 0])
    )
    return distinct & (np.einsum("tk,tk->t", area, area) > SLIVER**2 * longest**2)

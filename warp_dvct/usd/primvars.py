"""Primvars: checked, un-indexed and spread over triangle corners."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.errors import StageError

if TYPE_CHECKING:
    from pxr import UsdGeom

    from warp_dvct.usd.context import Context
    from warp_dvct.usd.subdivision import Refinement


@dataclass(frozen=True)
class Topology:
    """How triangle corners refer to the elements of a mesh.

    Attributes:
        triangles: Points of each triangle, int64 ``[t, 3]``.
        corners: Face-vertices of each triangle, int64 ``[t, 3]``.
        faces: Face of each triangle, int64 ``[t]``.
        point_count, corner_count, face_count: Sizes that vertex, faceVarying and uniform values must have.
        refined: Of a subdivision surface: brings such values to the points and face-vertices that triangles refer to.
    """

    triangles: np.ndarray
    corners: np.ndarray
    faces: np.ndarray
    point_count: int
    corner_count: int
    face_count: int
    refined: Refinement | None = None


def flat_values(primvar: UsdGeom.Primvar, ctx: Context, width: int) -> np.ndarray | None:
    """Values ``[n, width]`` of a primvar with its indices resolved, float64; None where it holds none of that width.

    Raises:
        StageError: An index is out of range.
    """
    value = primvar.Get(ctx.time)
    if value is None:
        return None
    values = np.array(value, dtype=np.float64) if _is_numeric(value) else None
    if values is None or values.size % width or (values.ndim > 1 and values.shape[-1] != width):
        return None
    if width == 1 or values.ndim > 1:
        values = values.reshape(-1, width)
    elif values.size == width:  # a single vector, not an array of them
        values = values.reshape(1, width)
    else:
        return None
    indices = primvar.GetIndices(ctx.time) if primvar.IsIndexed() else None
    if indices is None or len(indices) == 0:
        return values
    index = np.array(indices, dtype=np.int64)
    if index.min() < 0 or index.max() >= len(values):
        bad = index[(index < 0) | (index >= len(values))][0]
        raise StageError(
            f"{primvar.GetAttr().GetPath()}:indices has the index {bad}, outside of its {len(values)} values;"
            " write valid indices"
        )
    return values[index]


def _is_numeric(value: Any) -> bool:
    try:
        np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    return True


def spread(values: np.ndarray, interpolation: str, topology: Topology) -> np.ndarray | None:
    """Values ``[n, w]`` at triangle corners ``[t, 3, w]``; None where their number does not fit the interpolation."""
    t = topology
    if interpolation == "constant":
        return np.broadcast_to(values[0], (*t.triangles.shape, values.shape[1])) if len(values) == 1 else None
    if interpolation == "uniform":
        return np.repeat(values[t.faces][:, None], 3, 1) if len(values) == t.face_count else None
    if interpolation in ("vertex", "varying"):
        if len(values) != t.point_count:
            return None
        if t.refined is None:
            return values[t.triangles]
        if interpolation == "vertex":
            return t.refined.vertices(values)[t.triangles]
        return t.refined.corners(values[t.refined.cage.indices])[t.corners]
    if len(values) != t.corner_count:
        return None
    return (values if t.refined is None else t.refined.corners(values))[t.corners]


def corner_values(
    primvar: UsdGeom.Primvar, ctx: Context, topology: Topology, width: int, path: str
) -> np.ndarray | None:
    """A primvar at triangle corners ``[t, 3, width]``; None, and a notice, where it does not fit the mesh."""
    values = flat_values(primvar, ctx, width)
    if values is None or len(values) == 0:
        return None
    interpolation = str(primvar.GetInterpolation())
    if not np.isfinite(values).all():
        ctx.notices.add(path, f"{primvar.GetName()} has NaN or infinite values and is not used")
        return None
    corners = spread(values, interpolation, topology)
    if corners is None:
        ctx.notices.add(
            path, f"{primvar.GetName()} has {len(values)} values, which does not fit '{interpolation}', and is not used"
        )
    return corners

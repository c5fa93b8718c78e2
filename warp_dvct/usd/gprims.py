"""The intrinsic shapes of UsdGeom as triangles with exact normals and texture coordinates.

The vertices lie on the true surface, so a round shape with ``SEGMENTS`` sides has its area and silhouette a little
too small: a fraction of (pi / SEGMENTS)^2, about 0.1 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warp_dvct.errors import StageError

if TYPE_CHECKING:
    from pxr import Usd

SEGMENTS = 96  # around the axis; half as many from pole to pole


@dataclass(frozen=True)
class Shape:
    """A tessellated shape in its prim's space, counter-clockwise from outside.

    Attributes:
        points: float64 ``[v, 3]``.
        triangles: int64 ``[t, 3]``.
        normals: float64 ``[t, 3, 3]`` per corner, or None for faceted.
        uvs: float64 ``[t, 3, 2]`` per corner.
    """

    points: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray


def read_gprim(prim: Usd.Prim, time: Usd.TimeCode) -> Shape | None:
    """Tessellate a Cube, Sphere, Cylinder(_1), Cone, Capsule(_1) or Plane; None for any other type.

    Raises:
        StageError: A size is not positive and finite, or ``axis`` is none of X, Y, Z.
    """
    kind = str(prim.GetTypeName())
    if kind not in ("Cube", "Sphere", "Cylinder", "Cylinder_1", "Cone", "Capsule", "Capsule_1", "Plane"):
        return None

    def size(name: str, allow_zero: bool = False) -> float:
        value = float(prim.GetAttribute(name).Get(time))
        if not np.isfinite(value) or value < 0.0 or (value == 0.0 and not allow_zero):
            raise StageError(f"{prim.GetPath()}: {name} is {value}; give the {kind} a positive size")
        return value

    if kind == "Cube":
        return _box(size("size"))
    if kind == "Sphere":
        return _revolve([_arc(size("radius"), 0.0, -90.0, 90.0)])
    axis = str(prim.GetAttribute("axis").Get(time))
    if axis not in ("X", "Y", "Z"):
        raise StageError(f"{prim.GetPath()}: axis is '{axis}'; it must be X, Y or Z")
    if kind == "Plane":
        return _plane(size("width"), size("length"), axis)
    if kind in ("Cylinder_1", "Capsule_1"):
        bottom, top = size("radiusBottom", True), size("radiusTop", True)
        if bottom == top == 0.0:
            raise StageError(f"{prim.GetPath()}: both radii are 0; give the {kind} a positive size")
    else:
        bottom = size("radius")
        top = 0.0 if kind == "Cone" else bottom
    round_ends = kind.startswith("Capsule")
    return _turn(_revolve(_profile(size("height", round_ends), bottom, top, round_ends)), axis)


def _profile(height: float, bottom: float, top: float, round_ends: bool) -> list[np.ndarray]:
    """Strips ``[k, 4]`` of (radius, z, normal radius, normal z) from the lowest point to the highest."""
    half = 0.5 * height
    slope = np.hypot(height, bottom - top)
    side = np.array([height / slope, (bottom - top) / slope]) if slope > 0.0 else np.array([1.0, 0.0])
    strips = []
    if round_ends and bottom > 0.0:
        strips.append(_arc(bottom, -half, -90.0, 0.0))
    elif bottom > 0.0:
        strips.append(np.array([[0.0, -half, 0.0, -1.0], [bottom, -half, 0.0, -1.0]]))
    if slope > 0.0:
        strips.append(np.array([[bottom, -half, *side], [top, half, *side]]))
    if round_ends and top > 0.0:
        strips.append(_arc(top, half, 0.0, 90.0))
    elif top > 0.0:
        strips.append(np.array([[top, half, 0.0, 1.0], [0.0, half, 0.0, 1.0]]))
    return strips


def _arc(radius: float, centre: float, low: float, high: float) -> np.ndarray:
    angle = np.radians(np.linspace(low, high, 1 + round(SEGMENTS / 2 * (high - low) / 180.0)))
    cos, sin = np.cos(angle), np.sin(angle)
    cos[np.abs(angle) > np.pi / 2 - 1e-9] = 0.0  # the poles are points, not small circles
    return np.stack([radius * cos, centre + radius * sin, cos, sin], 1)


def _revolve(strips: list[np.ndarray]) -> Shape:
    """Turn profile strips about z; u runs around the axis, v from the lowest point to the highest along the profile."""
    lengths = [np.hypot(*np.diff(s[:, :2], axis=0).T) for s in strips]
    total = sum(x.sum() for x in lengths)
    phi = np.arange(SEGMENTS + 1) / SEGMENTS * 2.0 * np.pi
    cos, sin = np.cos(phi), np.sin(phi)
    cos[-1], sin[-1] = cos[0], sin[0]  # close the seam exactly
    points, triangles, normals, uvs = [], [], [], []
    base, run = 0, 0.0
    for strip, length in zip(strips, lengths, strict=True):
        r, z, nr, nz = strip.T
        v = (run + np.concatenate([[0.0], np.cumsum(length)])) / total
        run += length.sum()
        ring = [np.outer(r, cos), np.outer(r, sin), np.repeat(z[:, None], SEGMENTS + 1, 1)]
        around = [np.outer(nr, cos), np.outer(nr, sin), np.repeat(nz[:, None], SEGMENTS + 1, 1)]
        points.append(np.stack(ring, -1).reshape(-1, 3))
        normals.append(np.stack(around, -1).reshape(-1, 3))
        grid_u, grid_v = np.meshgrid(phi / (2.0 * np.pi), v)
        uvs.append(np.stack([grid_u, grid_v], -1).reshape(-1, 2))
        index = base + np.arange(len(strip) * (SEGMENTS + 1)).reshape(len(strip), SEGMENTS + 1)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
        triangles.append(np.stack([a, b, c], -1)[r[:-1] > 0.0].reshape(-1, 3))
        triangles.append(np.stack([a, c, d], -1)[r[1:] > 0.0].reshape(-1, 3))
        base += len(points[-1])
    corners = np.concatenate(triangles)
    shape_normals, shape_uvs = np.concatenate(normals)[corners], np.concatenate(uvs)[corners]
    _centre_poles(shape_uvs, np.concatenate(points)[corners])
    return Shape(*_weld(np.concatenate(points), corners), shape_normals, shape_uvs)


def _centre_poles(uvs: np.ndarray, corners: np.ndarray) -> None:
    """Give a corner on the axis the u in the middle of its triangle: there u has no value of its own."""
    on_axis = (corners[..., :2] == 0.0).all(-1)
    for k in range(3):
        other = 0.5 * (uvs[:, (k + 1) % 3, 0] + uvs[:, (k + 2) % 3, 0])
        uvs[on_axis[:, k], k, 0] = other[on_axis[:, k]]


def _weld(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share equal points; the seam and the strips then have no cracks."""
    unique, inverse = np.unique(points, axis=0, return_inverse=True)
    return unique, inverse.reshape(-1)[triangles]


def _turn(shape: Shape, axis: str) -> Shape:
    """Move the z axis to ``axis`` by a cyclic exchange, which keeps the handedness."""
    order = {"X": [2, 0, 1], "Y": [1, 2, 0], "Z": [0, 1, 2]}[axis]
    normals = None if shape.normals is None else shape.normals[..., order]
    return Shape(shape.points[:, order], shape.triangles, normals, shape.uvs)


def _box(size: float) -> Shape:
    """Six faces, each with the whole unit square of texture coordinates."""
    points = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * size
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    corners = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    uvs = np.concatenate([np.tile(square[[0, 1, 2]], (6, 1, 1)), np.tile(square[[0, 2, 3]], (6, 1, 1))])
    return Shape(points, corners, None, uvs)


def _plane(width: float, length: float, axis: str) -> Shape:
    """Width lies along x (z for axis X), length along y (z for axis Y), as UsdGeomPlane says; it faces along +axis."""
    across, along = {"Z": (0, 1), "X": (2, 1), "Y": (0, 2)}[axis]
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    points = np.zeros((4, 3))
    points[:, across] = (square[:, 0] - 0.5) * width
    points[:, along] = (square[:, 1] - 0.5) * length
    corners = np.array([[0, 1, 2], [0, 2, 3]])
    if axis != "Z":  # width x length points along -axis there
        corners = corners[:, ::-1]
    return Shape(points, corners, None, square[corners])

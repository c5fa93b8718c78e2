"""Bringing depth and colour images together: by their extrinsic and intrinsics, never by equal pixels.

All images are NumPy arrays, row 0 on top; depth is in metres, 0 where nothing was measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.capture.stage import CaptureRig

OCCLUSION = 0.05  # of depth: what lies that far behind the nearest point of a pixel of the photograph is hidden in it


@dataclass(frozen=True)
class Registered:
    """A photograph as the depth camera would have taken it.

    Attributes:
        color: As the photograph's values, ``[h, w, 3]``; 0 where it shows nothing.
        visible: bool ``[h, w]``: the pixel has depth, lies in the photograph, and nothing hides it there.
        uv: Where each pixel lies in the photograph, ``[h, w, 2]``; NaN where it has no depth.
    """

    color: np.ndarray
    visible: np.ndarray
    uv: np.ndarray


def register_color(depth: np.ndarray, color: np.ndarray, rig: CaptureRig) -> Registered:
    """Give each depth pixel its colour, by bilinear interpolation of the photograph.

    Args:
        depth: ``[h, w]`` of ``rig.depth``.
        color: ``[h, w, 3]`` of ``rig.color``, uint8 or float; its type is kept.
        rig: Cameras and extrinsic.
    Raises:
        ValueError: The capture has no colour camera.
    """
    uv, distance = place_in_color(depth, rig)
    assert rig.color is not None
    sampled, inside = sample(color.astype(np.float32), uv)
    visible = inside & ~_hidden(uv, distance, rig)
    sampled[~visible] = 0.0
    if color.dtype == np.uint8:
        sampled = np.rint(sampled).astype(np.uint8)
    return Registered(sampled, visible, uv)


def place_in_color(depth: np.ndarray, rig: CaptureRig) -> tuple[np.ndarray, np.ndarray]:
    """Where depth pixels lie in the photograph ``[h, w, 2]``, and how far in front of its camera ``[h, w]`` [m]; NaN
    where there is no depth.

    Raises:
        ValueError: The capture has no colour camera.
    """
    if rig.color is None:
        raise ValueError("the capture has no colour camera")
    z = np.where(depth > 0.0, depth, np.nan)
    points = rig.depth.rays() * z[..., None] @ rig.depth_to_color[:3, :3].T + rig.depth_to_color[:3, 3]
    return rig.color.project(points), points[..., 2]


def sample(image: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bilinear samples ``[..., c]`` of an image at pixel coordinates, and whether they lie in it; 0 where not."""
    height, width = image.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (
            (uv[..., 0] >= -0.5) & (uv[..., 0] <= width - 0.5) & (uv[..., 1] >= -0.5) & (uv[..., 1] <= height - 0.5)
        )
    u = np.clip(np.where(inside, uv[..., 0], 0.0), 0.0, width - 1.0)
    v = np.clip(np.where(inside, uv[..., 1], 0.0), 0.0, height - 1.0)
    x = np.minimum(u.astype(np.int64), max(width - 2, 0))
    y = np.minimum(v.astype(np.int64), max(height - 2, 0))
    x1, y1 = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    a, b = (u - x)[..., None], (v - y)[..., None]
    top = image[y, x] * (1.0 - a) + image[y, x1] * a
    bottom = image[y1, x] * (1.0 - a) + image[y1, x1] * a
    return np.where(inside[..., None], top * (1.0 - b) + bottom * b, 0.0).astype(np.float32), inside


def _hidden(uv: np.ndarray, distance: np.ndarray, rig: CaptureRig) -> np.ndarray:
    """Which points lie behind others in the photograph: the nearest point of each cell hides what is far behind it.

    Cells are so large that a surface as near as this one has a point in each: pixels, of the coarser of both images.
    """
    assert rig.color is not None
    scale = min(1.0, rig.depth.fx / rig.color.fx)
    width, height = int(rig.color.width * scale) + 1, int(rig.color.height * scale) + 1
    known = np.isfinite(distance) & np.isfinite(uv).all(-1)
    x = np.floor((np.where(known, uv[..., 0], -9.0) + 0.5) * scale).astype(np.int64)
    y = np.floor((np.where(known, uv[..., 1], -9.0) + 0.5) * scale).astype(np.int64)
    known &= (x >= 0) & (x < width) & (y >= 0) & (y < height)
    nearest = np.full((height, width), np.inf)
    np.minimum.at(nearest, (y[known], x[known]), distance[known])
    hidden = np.zeros(distance.shape, bool)
    hidden[known] = distance[known] > nearest[y[known], x[known]] * (1.0 + OCCLUSION)
    return hidden


def undistorted_depth(depth: np.ndarray, lens: Intrinsics) -> tuple[np.ndarray, Intrinsics]:
    """Depth as the same camera without distortion would measure it: the nearest pixel's, so that no depth is made up.

    Returns:
        The image, and its lens.
    """
    plain = Intrinsics(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
    if not lens.is_distorted:
        return depth, plain
    uv = lens.project(plain.rays())
    x, y = (np.rint(np.nan_to_num(uv[..., k], nan=-9.0)).astype(np.int64) for k in (0, 1))
    inside = (x >= 0) & (x < lens.width) & (y >= 0) & (y < lens.height)
    return np.where(inside, depth[np.where(inside, y, 0), np.where(inside, x, 0)], np.float32(0.0)), plain

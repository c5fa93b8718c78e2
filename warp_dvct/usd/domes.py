"""Environment images of dome lights, brought to the lat-long layout of UsdLux."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_dvct.errors import StageError
from warp_dvct.usd.context import Context
from warp_dvct.usd.textures import ImageCache, as_rgb, asset_file

if TYPE_CHECKING:
    from pxr import Usd


def read_dome_texture(prim: Usd.Prim, path: str, ctx: Context, images: ImageCache) -> np.ndarray | None:
    """Radiance ``[h, w, 3]`` float32 in lat-long layout; None for a dome of one colour.

    Raises:
        StageError: The file is missing, cannot be read, or holds NaN, infinite or negative values.
    """
    attribute = prim.GetAttribute("inputs:texture:file")
    value = attribute.Get(ctx.time) if attribute else None
    if value is None or not value.path:
        return None
    file = asset_file(attribute, value, "texture")
    pixels = np.ascontiguousarray(as_rgb(images.read(file, "auto", path)))
    if not np.isfinite(pixels).all() or (pixels < 0.0).any():
        raise StageError(f"{path}: '{file}' has NaN, infinite or negative values; repair the image")
    layout = str(prim.GetAttribute("inputs:texture:format").Get(ctx.time))
    if layout in ("automatic", "latlong"):
        return pixels
    if layout in ("angular", "mirroredBall"):
        return _unroll(pixels, layout)
    ctx.notices.add(path, f"texture:format {layout} is not supported; the mean of the image lights evenly")
    return pixels.mean((0, 1), keepdims=True)


def latlong_directions(height: int, width: int) -> np.ndarray:
    """Directions ``[h, w, 3]`` in the light's space of a lat-long image's pixel centres, as UsdLux lays it out.

    The centre looks along +z, a quarter in from the left along +x, the top row along +y.
    """
    theta = (np.arange(height) + 0.5) / height * np.pi
    phi = (0.5 - (np.arange(width) + 0.5) / width) * 2.0 * np.pi  # from +z towards +x
    sine = np.sin(theta)[:, None]
    y = np.broadcast_to(np.cos(theta)[:, None], (height, width))
    return np.stack([sine * np.sin(phi), y, sine * np.cos(phi)], -1)


def _unroll(ball: np.ndarray, layout: str) -> np.ndarray:
    """A mirror ball or an angular map, both seen with the camera looking along -z, resampled to lat-long.

    ``mirroredBall``: radius sin(a / 2); ``angular``: radius a / pi, for the angle a between a direction and the
    image's centre. The centre of a mirror ball shows what is behind the camera, +z.
    """
    height = max(2, min(ball.shape[:2]))
    direction = latlong_directions(height, 2 * height)
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    angle = np.arccos(np.clip(z, -1.0, 1.0))
    radius = np.sin(0.5 * angle) if layout == "mirroredBall" else angle / np.pi
    flat = np.maximum(np.hypot(x, y), 1e-12)
    u, v = 0.5 + 0.5 * radius * x / flat, 0.5 - 0.5 * radius * y / flat
    return _bilinear(ball, u, v)


def _bilinear(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Sample at u (left to right) and v (top to bottom) in [0, 1], clamped at the border."""
    height, width = image.shape[:2]
    x, y = np.clip(u * width - 0.5, 0, width - 1), np.clip(v * height - 0.5, 0, height - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = (x - left)[..., None], (y - top)[..., None]
    upper = image[top, left] * (1 - fx) + image[top, right] * fx
    lower = image[bottom, left] * (1 - fx) + image[bottom, right] * fx
    return (upper * (1 - fy) + lower * fy).astype(np.float32)

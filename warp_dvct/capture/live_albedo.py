"""Albedo of a photographed surface, pixel by pixel, from its one photograph and the light that is known.

The photograph is albedo times irradiance over pi. Rendered small, the real scene tells the irradiance; the quotient is
smooth where light is, so that few pixels do, and its error at the edge of a shadow is one of that shadow's depth alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warp_dvct.image import srgb_to_linear
from warp_dvct.launch import Launcher
from warp_dvct.relighter import Relighter
from warp_dvct.scene import LightRole, Role, Scene, Texture, Wrap

MOST_ALBEDO = 0.95  # nothing reflects more
MOST_GAIN = 4.0  # that photographs are made brighter or darker to have albedo
CLIPPED = 0.98  # of a photograph's white: what is brighter may have been anything
SRGB = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
WIDTH = 128  # pixels of the picture that tells how bright the known lights make the real scene
SETTINGS = {
    "volume.resolution": 48,
    "volume.coarse": 0,
    "bounces": 24,
}  # light that bounces is smooth, and summed over many pixels
RADIUS = 2  # of these pixels to each side that are averaged: noise of few samples


def albedo_texture(photo: np.ndarray, gain: np.ndarray, name: str) -> Texture:
    """The photograph times ``gain``: a pixel's albedo goes by its own colour, so that it never loses more light than it
    had.

    Args:
        photo: Linear, float32 ``[h, w, 3]``. gain: ``[3]``, or ``[h', w', 3]`` over the whole picture.
    """
    if gain.ndim == 3:
        gain = _enlarged(gain, *photo.shape[:2])
    pixels = np.minimum(photo * gain.astype(np.float32), np.float32(MOST_ALBEDO))
    return Texture(pixels, Wrap.CLAMP, Wrap.CLAMP, f"{name} (albedo)")


def light_ratio(scene: Scene, photo: np.ndarray, launcher: Launcher, share: float) -> np.ndarray:
    """What to multiply albedo by so that the rendered real scene is as bright as the photograph, ``[h, w, 3]`` over the
    picture, in [1 / MOST_GAIN, MOST_GAIN]; clipped pixels and those without a surface take it from around.

    Args:
        photo: Linear, float32 ``[h, w, 3]``.
        share: Of the logarithm of the picture's mean ratio that is made up for. In a room light that bounces follows
            the albedo, so brightness goes about with its square and 0.5 is Newton's step; 0 leaves the mean alone.
    """
    photo, rendered, compared = _compared(scene, photo, launcher)
    if not compared.any() or (rendered[compared].sum(0) <= 0.0).any():
        return np.ones((1, 1, 3), np.float32)
    around = [_box_sum(values * compared[..., None]) for values in (photo, rendered)]
    known = around[1] > 1e-3 * rendered[compared].mean()
    ratio = np.where(known, around[0] / np.maximum(around[1], 1e-9), 0.0)
    mean = np.exp([np.log(np.maximum(ratio[..., k], 1e-6))[known[..., k]].mean() for k in range(3)])
    ratio = np.where(known, ratio / mean, 1.0) * mean**share
    return np.clip(ratio, 1.0 / MOST_GAIN, MOST_GAIN).astype(np.float32)


def brightness_ratio(scene: Scene, photo: np.ndarray, launcher: Launcher) -> float:
    """How many times brighter the photograph is than the rendered real scene, over all pixels that can be compared."""
    photo, rendered, compared = _compared(scene, photo, launcher)
    total = float(rendered[compared].sum())
    if total <= 0.0:
        return 1.0
    return float(np.clip(photo[compared].sum() / total, 1.0 / MOST_GAIN, MOST_GAIN))


def nearest(pixels: np.ndarray, uvs: np.ndarray) -> np.ndarray:
    """The pixels at texture coordinates ``[v, 2]``, the nearest ones, ``[v, 3]``."""
    height, width = pixels.shape[:2]
    x = np.clip(uvs[:, 0] * width, 0, width - 1).astype(np.int64)
    y = np.clip((1.0 - uvs[:, 1]) * height, 0, height - 1).astype(np.int64)
    return pixels[y, x]


def _compared(scene: Scene, photo: np.ndarray, launcher: Launcher) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The photograph and the rendered real scene, small, ``[h, w, 3]``, and where both are known, bool ``[h, w]``."""
    real = replace(
        scene,
        meshes=tuple(mesh for mesh in scene.meshes if mesh.role == Role.REAL),
        point_clouds=(),
        lights=tuple(light for light in scene.lights if light.role == LightRole.PLATE),
    )
    relighter = Relighter(
        real,
        width=WIDTH,
        quality="draft",
        settings=SETTINGS,
        device=launcher.device.alias,
        threads=launcher.threads,
    )
    layers = relighter.render()
    photo = _reduced(photo, *layers.depth.shape)
    return photo, layers.comp.astype(np.float64), (layers.mask_real == 1.0) & (photo.max(-1) < CLIPPED)


def _reduced(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Means over the pixels that each of ``height`` x ``width`` ones covers, ``[height, width, 3]``."""
    rows, columns = (np.arange(n) * m // n for n, m in ((height, image.shape[0]), (width, image.shape[1])))
    sums = np.add.reduceat(np.add.reduceat(image.astype(np.float64), rows, 0), columns, 1)
    counts = [np.diff([*first, size]) for first, size in ((rows, image.shape[0]), (columns, image.shape[1]))]
    return sums / (counts[0][:, None] * counts[1])[..., None]


def _enlarged(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Bilinear samples of the image at ``height`` x ``width`` pixels, float32."""
    for axis, size in ((0, height), (1, width)):
        at = np.clip((np.arange(size) + 0.5) * image.shape[axis] / size - 0.5, 0.0, image.shape[axis] - 1.0)
        first = np.minimum(at.astype(np.int64), max(image.shape[axis] - 2, 0))
        share = np.expand_dims((at - first).astype(np.float32), tuple(k for k in range(3) if k != axis))
        second = np.take(image, np.minimum(first + 1, image.shape[axis] - 1), axis)
        image = np.take(image, first, axis) * (1.0 - share) + second * share
    return image


def _box_sum(values: np.ndarray) -> np.ndarray:
    """Sums over ``2 RADIUS + 1`` pixels both ways, ``[h, w, c]``."""
    edge = 2 * RADIUS + 1
    padded = np.pad(values, ((RADIUS, RADIUS), (RADIUS, RADIUS), (0, 0)))
    return np.lib.stride_tricks.sliding_window_view(padded, (edge, edge), (0, 1)).sum((-2, -1))

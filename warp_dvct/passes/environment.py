"""Gather the scene's domes into one prefiltered lat-long map."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_dvct.kernels.environment import Environment
from warp_dvct.launch import Launcher
from warp_dvct.scene import Light, LightKind, LightRole

MAX_WIDTH = 1024


def build_environment(launcher: Launcher, lights: tuple[Light, ...]) -> Any:
    """Resample every dome to one map in world axes and average it down, weighted by solid angle.

    Returns:
        An ``Environment`` struct; ``levels`` is 0 where the scene has no dome.
    """
    domes = [light for light in lights if light.kind == LightKind.DOME]
    env = Environment()
    if not domes:
        env.levels = 0
        env.level_first = launcher.zeros(1, wp.int32)
        env.before = launcher.zeros(1, wp.vec3)
        env.after = env.before
        return env
    width = max([8, *(_power_of_two(d.texture.shape[1]) for d in domes if d.texture is not None)])
    before = np.zeros((width // 2, width, 3))
    after = np.zeros_like(before)
    for dome in domes:
        radiance = _resample(dome, width)
        after += radiance
        if dome.role == LightRole.PLATE:
            before += radiance
    chains = [_chain(before), _chain(after)]
    env.levels = len(chains[0])
    env.width, env.height = width, width // 2
    sizes = [level.shape[0] * level.shape[1] for level in chains[0]]
    env.level_first = launcher.array(np.cumsum([0, *sizes])[:-1].astype(np.int32), wp.int32)
    env.before, env.after = (
        launcher.array(np.concatenate([level.reshape(-1, 3) for level in chain]).astype(np.float32), wp.vec3)
        for chain in chains
    )
    return env


def _power_of_two(width: int) -> int:
    return min(MAX_WIDTH, 1 << max(0, width - 1).bit_length())


def _resample(dome: Light, width: int) -> np.ndarray:
    """The dome's radiance at the map's texels, float64 ``[width / 2, width, 3]``."""
    radiance = np.asarray(dome.radiance, np.float64)
    if dome.texture is None:
        return np.broadcast_to(radiance, (width // 2, width, 3))
    texture = np.asarray(dome.texture, np.float64)
    factor = max(1, texture.shape[1] // width)
    if factor > 1:  # average first, or a small bright sun falls between the samples
        h, w = (texture.shape[0] // factor) * factor, (texture.shape[1] // factor) * factor
        texture = texture[:h, :w].reshape(h // factor, factor, w // factor, factor, 3).mean((1, 3))
    rotation = np.asarray(dome.rotation, np.float64)
    # About y the two grids agree. Otherwise a single sample per texel may miss a sun of one texel, or meet it twice.
    places = (0.5,) if abs(rotation[1, 1]) > 1.0 - 1e-9 else (0.25, 0.75)
    total, weight = np.zeros((width // 2, width, 3)), np.zeros((width // 2, 1, 1))
    for y in places:
        theta = (np.arange(width // 2) + y) / (width // 2) * np.pi
        sin = np.sin(theta)[:, None]
        for x in places:
            phi = (0.5 - (np.arange(width) + x) / width) * 2.0 * np.pi
            world = np.stack([sin * np.sin(phi), np.cos(theta)[:, None] * np.ones_like(phi), sin * np.cos(phi)], -1)
            total += _look_up(texture, world @ rotation) * sin[..., None]
            weight += sin[..., None]
    return total / weight * radiance


def _look_up(texture: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """A lat-long texture in unit directions of its own space: bilinear, periodic around, clamped at the poles."""
    height, width = texture.shape[:2]
    x = (0.5 - np.arctan2(direction[..., 0], direction[..., 2]) / (2 * np.pi)) * width - 0.5
    y = np.arccos(np.clip(direction[..., 1], -1, 1)) / np.pi * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    left, right = x0 % width, (x0 + 1) % width
    top, bottom = np.clip(y0, 0, height - 1), np.clip(y0 + 1, 0, height - 1)
    upper = texture[top, left] * (1 - fx) + texture[top, right] * fx
    lower = texture[bottom, left] * (1 - fx) + texture[bottom, right] * fx
    return upper * (1 - fy) + lower * fy


def _chain(image: np.ndarray) -> list[np.ndarray]:
    """The image and its halvings, each the solid-angle weighted mean of four texels."""
    levels = [image]
    while levels[-1].shape[0] > 1:
        fine = levels[-1]
        edges = np.cos(np.linspace(0, np.pi, fine.shape[0] + 1))
        band = (edges[:-1] - edges[1:])[:, None, None]
        weighted = (fine * band).reshape(fine.shape[0] // 2, 2, fine.shape[1] // 2, 2, 3).sum((1, 3))
        levels.append(weighted / (2.0 * band.reshape(-1, 2, 1, 1).sum(1)))
    return levels

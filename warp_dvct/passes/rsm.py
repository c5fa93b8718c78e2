"""A pair of reflective shadow maps per light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import rsm as kernels
from warp_dvct.launch import Launcher


@dataclass(frozen=True)
class ShadowMaps:
    """Rµ (before: real surfaces alone) and Rρ (after: all surfaces) of one light, flat, ``size * size`` texels.

    Attributes:
        position_*, normal_*: vec3, volume space; the normal faces the light.
        flux_*: vec3, reflected flux [W, in volume units] of the texel's beam.
        role_*: int, 0 real, 1 synthetic, -1 where the beam meets nothing (or the light has no before).
    """

    size: int
    position_after: Any
    normal_after: Any
    flux_after: Any
    role_after: Any
    position_before: Any
    normal_before: Any
    flux_before: Any
    role_before: Any


def render_rsm(
    launcher: Launcher,
    scene: DeviceScene,
    light: int,
    size: int,
    *,
    center: tuple[float, float, float],
    radius: float,
    start: float,
    seed: int = 0,
) -> ShadowMaps:
    """Follow ``size * size`` beams of a light that cover the sphere at ``center``.

    Args:
        light: Index into the scene's lights.
        size: Texels an edge, at least 1.
        center, radius: The target sphere in volume space.
        start: Distance from the centre at which parallel beams start; beyond everything that casts shadows.

    Franke 2014, section 3.2 (RSM pair); the flux of a texel does not depend on ``size``.
    """
    target = kernels.Target()
    target.center = wp.vec3(*center)
    target.radius = radius
    target.start = start
    count = size * size
    arrays = [launcher.empty(count, dtype) for dtype in (wp.vec3, wp.vec3, wp.vec3, wp.int32) * 2]
    launcher.launch(
        kernels._render_rsm, count, [scene.geometry, scene.materials, scene.lights, target, light, size, seed], arrays
    )
    return ShadowMaps(size, *arrays)

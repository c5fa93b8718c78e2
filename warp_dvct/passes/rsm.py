"""A pair of reflective shadow maps per light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import rsm as kernels
from warp_dvct.launch import Launcher
from warp_dvct.scene import LightRole


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


@dataclass(frozen=True)
class RealMap:
    """What a light's beams meet in the real scene: as in :class:`ShadowMaps`; ``origin`` and ``direction`` of
    the beams, vec3, and ``reach``, float, how far they go."""

    size: int
    origin: Any
    direction: Any
    reach: Any
    position: Any
    normal: Any
    flux: Any
    role: Any


def render_real(
    launcher: Launcher,
    scene: DeviceScene,
    light: int,
    size: int,
    *,
    center: tuple[float, float, float],
    radius: float,
    start: float,
    seed: int = 0,
) -> RealMap:
    """The part of :func:`render_rsm` that does not depend on synthetic objects; the arguments are the same."""
    target = _target(center, radius, start)
    count = size * size
    dtypes = (wp.vec3, wp.vec3, wp.float32, wp.vec3, wp.vec3, wp.vec3, wp.int32)
    arrays = [launcher.empty(count, dtype) for dtype in dtypes]
    shared = [scene.geometry, scene.materials, scene.lights, target, light, size, seed]
    launcher.launch(kernels._render_real, count, shared, arrays)
    return RealMap(size, *arrays)


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
    real: RealMap | None = None,
) -> ShadowMaps:
    """Follow ``size * size`` beams of a light that cover the sphere at ``center``.

    Args:
        light: Index into the scene's lights.
        size: Texels an edge, at least 1.
        center, radius: The target sphere in volume space.
        start: Distance from the centre at which parallel beams start; beyond everything that casts shadows.
        real: What :func:`render_real` gave for the same arguments, where that is at hand; it is not written to.

    Franke 2014, section 3.2 (RSM pair); the flux of a texel does not depend on ``size``.
    """
    if real is None:
        real = render_real(launcher, scene, light, size, center=center, radius=radius, start=start, seed=seed)
    count = size * size
    alone = [real.position, real.normal, real.flux, real.role]
    before, after = alone, alone
    if int(scene.lights.role.numpy()[light]) == LightRole.ADDED:  # it has no before
        before = [*alone[:3], launcher.full(count, -1, wp.int32)]
    if scene.synthetic is not None:
        after = [launcher.empty(count, dtype) for dtype in (wp.vec3, wp.vec3, wp.vec3, wp.int32)]
        shared = [scene.geometry, scene.materials, scene.lights, _target(center, radius, start), light, size, seed]
        launcher.launch(kernels._render_after, count, [*shared, real.origin, real.direction, real.reach, *alone], after)
    return ShadowMaps(size, *after, *before)


def _target(center: tuple[float, float, float], radius: float, start: float) -> Any:
    target = kernels.Target()
    target.center = wp.vec3(*center)
    target.radius = radius
    target.start = start
    return target

"""Specular reflections at shading points."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import specular as kernels
from warp_dvct.launch import Launcher
from warp_dvct.passes.gbuffer import compact
from warp_dvct.passes.lobe_smoothing import Smoothing, add_reflected, new_reflected


def find_glossy(launcher: Launcher, points: Any, count: int, alpha_max: float) -> tuple[Any, Any, int]:
    """Points whose specular lobe has a GGX alpha up to ``alpha_max``: each one's rank among them (-1 elsewhere), their
    indices, and their number."""
    mark = launcher.zeros(max(1, count), wp.int32)
    launcher.launch(kernels._mark_glossy, count, [points, alpha_max], [mark])
    return compact(launcher, mark)


def shade_specular(
    launcher: Launcher,
    scene: DeviceScene,
    points: Any,
    index: Any,
    count: int,
    world: Any,
    bounces: Any,
    focuses: Any,
    *,
    glossy: Any,
    cone: Any,
    light: Any,
    before: Any,
    with_before: bool,
    smoothing: Smoothing,
) -> None:
    """Add specular reflections at the ``count`` points listed in ``index``: eqs. 6 and 8, second terms.

    By exact visible-normal rays, whose hits are shaded by the lights themselves, or by one cone as wide as the lobe
    where ``cone`` is given.

    Args:
        focuses: int ``[materials]``, as ``kernels.glossy_hits.GlossyHits`` has it.
    """
    if cone is None:
        reflected = new_reflected(launcher, count)
        launcher.launch(
            kernels._shade_specular_rays,
            count,
            [points, index, scene.geometry, scene.materials, world, bounces, scene.lights, glossy, focuses],
            [reflected],
        )
        to = {"light": light, "before": before, "with_before": with_before}
        add_reflected(launcher, scene, points, index, count, reflected, smoothing, **to)
    else:
        launcher.launch(
            kernels._shade_specular_cones,
            count,
            [points, index, scene.geometry, world, cone, int(with_before)],
            [light, before],
        )

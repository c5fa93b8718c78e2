"""Specular reflections at shading points."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import lobe_smoothing
from warp_dvct.kernels import specular as kernels
from warp_dvct.launch import Launcher
from warp_dvct.passes.gbuffer import compact


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
    *,
    glossy: Any,
    cone: Any,
    light: Any,
    before: Any,
    with_before: bool,
    grid: Any = None,
    smoothing: float = 0.0,
) -> None:
    """Add specular reflections at the ``count`` points listed in ``index``: eqs. 6 and 8, second terms.

    By exact visible-normal rays, whose hits are shaded by the lights themselves, or by one cone as wide as the lobe
    where ``cone`` is given.

    Args:
        grid: ``kernels.lobe_smoothing.Grid``; without one, points are not averaged.
        smoothing: Width over which neighbouring pixels' rays are averaged, over that of the lobe's blur.
    """
    if cone is None:
        reflected = lobe_smoothing.Reflected()
        reflected.change, reflected.before = (launcher.empty(max(1, count), wp.vec3) for _ in range(2))
        reflected.nearness = launcher.empty(max(1, count), wp.float32)
        launcher.launch(
            kernels._shade_specular_rays,
            count,
            [points, index, scene.geometry, scene.materials, world, bounces, scene.lights, glossy],
            [reflected],
        )
        if grid is None:
            grid = lobe_smoothing.Grid()
            grid.rank = launcher.empty(1, wp.int32)
        launcher.launch(
            lobe_smoothing._smooth_lobes,
            count,
            [points, index, grid, scene.camera.origin, smoothing, reflected, int(with_before)],
            [light, before],
        )
    else:
        launcher.launch(
            kernels._shade_specular_cones,
            count,
            [points, index, scene.geometry, world, cone, int(with_before)],
            [light, before],
        )


def lobe_grid(rank: Any, width: int, height: int) -> Any:
    """``kernels.lobe_smoothing.Grid`` of a picture, the centres of whose pixels are its first points."""
    grid = lobe_smoothing.Grid()
    grid.columns, grid.rows, grid.rank = width, height, rank
    return grid

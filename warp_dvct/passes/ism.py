"""Imperfect shadow maps of all VPLs."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_dvct.kernels import ism as kernels
from warp_dvct.kernels.ism import Ism, Sight
from warp_dvct.launch import Launcher
from warp_dvct.passes.point_cloud import SurfacePoints
from warp_dvct.passes.vpl_memory import check_isms, map_texels, pyramid_levels


def new_isms(launcher: Launcher, count: int, *, size: int, bias: float, first: int = 0, single: bool = False) -> Any:
    """Empty maps for ``count`` VPLs.

    Args:
        first: The first of them: those on the sky, before it, have no maps.
        size: Texels an edge; holes are filled best in maps of a size that halves well.
        bias: Relative depth by which a blocker has to be nearer than what it shadows.
        single: Answer as one map of the nearest surface of either role would (the method of 2010).
    Returns:
        ``kernels.ism.Sight``.
    Raises:
        DeviceError: The maps do not fit into memory; the message says what would.
    """
    check_isms(launcher, count, size)
    ism = Ism()
    ism.first, ism.size, ism.levels, ism.stride = first, size, pyramid_levels(size), map_texels(size)
    ism.bias = bias
    ism.inverse = launcher.zeros(max(1, 2 * count * ism.stride), wp.float32)
    return _sight(ism, rays=False, single=single)


def draw_isms(
    launcher: Launcher, sight: Any, vpls: Any, points: SurfacePoints, start: int, count: int, *, grow: float
) -> None:
    """Draw the two maps of each of ``count`` VPLs from ``start`` on, none of them on the sky.

    Ritschel et al. 2008, Knecht et al. 2012.

    Args:
        grow: Radius of a splat, over that of the disc that a point stands for.
    """
    ism = sight.ism
    maps, first = 2 * count, 2 * (start - ism.first)
    parts, clouds = launcher.parts(maps), [points.real, points.synthetic]
    launcher.launch(kernels._splat_points, maps * parts, [first, parts, vpls, *clouds, grow, ism])
    for level in range(1, ism.levels):
        launcher.launch(kernels._pull, maps * (ism.size >> level) ** 2, [first, ism, level], [ism.inverse])
    for level in range(ism.levels - 2, -1, -1):
        launcher.launch(kernels._push, maps * (ism.size >> level) ** 2, [first, ism, level], [ism.inverse])


def ray_sight(launcher: Launcher, *, single: bool = False) -> Any:
    """``kernels.ism.Sight`` that asks exact rays and needs no maps."""
    ism = Ism()
    ism.inverse = launcher.zeros(1, wp.float32)
    return _sight(ism, rays=True, single=single)


def _sight(ism: Any, *, rays: bool, single: bool) -> Any:
    sight = Sight()
    sight.rays, sight.single, sight.ism = int(rays), int(single), ism
    return sight

"""Imperfect shadow maps of all VPLs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import warp as wp

from warp_dvct.errors import DeviceError
from warp_dvct.kernels import ism as kernels
from warp_dvct.kernels.ism import Ism, Sight
from warp_dvct.launch import Launcher
from warp_dvct.passes.point_cloud import SurfacePoints
from warp_dvct.passes.vpls import Region

SKY_REGION = 4.0  # radius of what the maps of the sky show, over that of the synthetic objects
FILL_LEVELS = 2


def map_texels(size: int) -> int:
    """Texels of one map with the coarser levels that pull-push uses."""
    return sum((size >> level) ** 2 for level in range(_levels(size)))


def _levels(size: int) -> int:
    return min(FILL_LEVELS, max(0, (size & -size).bit_length() - 1)) + 1


def new_isms(launcher: Launcher, count: int, *, size: int, bias: float, region: Region, single: bool = False) -> Any:
    """Empty maps for ``count`` VPLs.

    Args:
        size: Texels an edge; holes are filled best in maps of a size that halves well.
        bias: Relative depth by which a blocker has to be nearer than what it shadows.
        single: Answer as one map of the nearest surface of either role would (the method of 2010).
    Returns:
        ``kernels.ism.Sight``.
    Raises:
        DeviceError: The maps do not fit into memory; the message says what would.
    """
    _check_memory(launcher, count, size)
    ism = Ism()
    ism.size, ism.levels, ism.stride = size, _levels(size), map_texels(size)
    ism.bias = bias
    # Maps of the sky show what is around the synthetic objects: farther off nothing changes by them.
    ism.center, ism.radius = wp.vec3(*region.focus), min(region.radius, SKY_REGION * region.focus_radius)
    ism.far = 1.0 + 2.0 * region.radius / ism.radius
    ism.inverse = launcher.zeros(max(1, 2 * count * ism.stride), wp.float32)
    return _sight(ism, rays=False, single=single)


def draw_isms(
    launcher: Launcher, sight: Any, vpls: Any, points: SurfacePoints, start: int, count: int, *, grow: float
) -> None:
    """Draw the two maps of each of ``count`` VPLs from ``start`` on (Ritschel et al. 2008, Knecht et al. 2012).

    Args:
        grow: Radius of a splat, over that of the disc that a point stands for.
    """
    ism = sight.ism
    maps, first = 2 * count, 2 * start
    launcher.launch(kernels._splat_points, maps, [first, vpls, points.real, points.synthetic, grow, ism])
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


def _check_memory(launcher: Launcher, count: int, size: int) -> None:
    each = 2 * 4 * map_texels(size)
    free = _free_bytes(launcher)
    needed = count * each
    # Warp indexes with 32 bits.
    if needed > free or 2 * count * map_texels(size) >= 2**31:
        fits = min(free // each, 2**30 // map_texels(size))
        raise DeviceError(
            f"imperfect shadow maps of {count} VPLs at ism.size={size} need {needed / 2**20:.0f} MiB and"
            f" {free / 2**20:.0f} MiB are free; {fits} VPLs would fit: lower vpls.count, vpls.further, vpls.sky,"
            " bounces or ism.size, or take visibility=ray, which needs no maps"
        )


def _free_bytes(launcher: Launcher) -> int:
    if launcher.device.is_cuda:
        return int(launcher.device.free_memory)
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return 2**63 - 1  # not known: the allocation will say

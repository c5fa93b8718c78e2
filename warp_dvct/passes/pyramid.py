"""The lit field of level 0 and its filtered pyramid."""

from __future__ import annotations

from typing import Any

from warp_dvct.errors import OptionError
from warp_dvct.kernels import pyramid as kernels
from warp_dvct.launch import Launcher
from warp_dvct.passes.voxels import Voxels

FILTERS = {"directional": 0, "isotropic": 1}


def light_faces(launcher: Launcher, voxels: Voxels, flux: Any, *, filter: str = "directional") -> None:
    """Turn areas and flux into the level-0 field (radiosity * alpha, alpha), in place.

    Args:
        filter: ``directional`` or, as in the paper, ``isotropic``: wholly occupied voxels without orientation.
    """
    launcher.launch(
        kernels._light_faces,
        voxels.level_records[0],
        [voxels.volume, voxels.area, flux, _mode(filter)],
        [voxels.volume.field],
    )


def build_pyramid(launcher: Launcher, voxels: Voxels, *, filter: str = "directional") -> None:
    """Filter level 0 into all coarser levels, in place.

    A directional face of the next level composites its four pairs of voxels along the axis, front to back, and averages
    them; ``isotropic`` averages all eight, as in the paper (walls then turn transparent with every level).
    """
    start = voxels.level_records[0]
    for level in range(1, len(voxels.level_records)):
        count = voxels.level_records[level]
        launcher.launch(
            kernels._filter_level,
            count,
            [voxels.level_keys[level], voxels.volume, level, start, _mode(filter)],
            [voxels.volume.field],
        )
        start += count


def _mode(name: str) -> int:
    if name not in FILTERS:
        raise OptionError(f"cones.filter is '{name}'; choose one of {', '.join(FILTERS)}")
    return FILTERS[name]

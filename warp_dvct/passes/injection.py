"""Split-injection of reflective shadow maps into the faces of level-0 voxels."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_dvct.kernels import injection as kernels
from warp_dvct.launch import Launcher
from warp_dvct.passes.rsm import ShadowMaps
from warp_dvct.passes.sorting import count_below, sort_by_key, unique_runs
from warp_dvct.passes.voxels import Voxels


def empty_flux(launcher: Launcher, voxels: Voxels) -> Any:
    """Zero reflected flux: vec3 ``[level-0 records * 12]``, slot ``(record * 6 + face) * 2 + solution``."""
    return launcher.zeros(max(1, voxels.level_records[0] * 12), wp.vec3)


def inject(launcher: Launcher, voxels: Voxels, maps: ShadowMaps, flux: Any) -> None:
    """Add a light's reflected flux to ``flux``, per voxel face and divided by the area of a voxel's face.

    Divided by ``voxels.area`` it is radiosity [W m^-2], whatever the resolution of maps and volume.

    Franke 2014, section 3.2, eq. 2. Flux that lands where the grid holds no surface of that orientation is dropped.
    """
    texels = maps.size * maps.size
    key = launcher.empty(4 * texels, wp.int32)
    order = launcher.empty(4 * texels, wp.int32)
    launcher.launch(
        kernels._find_targets,
        texels,
        [
            voxels.volume,
            voxels.area,
            maps.position_after,
            maps.normal_after,
            maps.role_after,
            maps.position_before,
            maps.normal_before,
            maps.role_before,
            texels,
        ],
        [key],
    )
    sort_by_key(launcher, key, order, 2 * texels)
    records, starts = unique_runs(launcher, key, 2 * texels)
    entries = count_below(launcher, key, 2 * texels)
    runs = records.shape[0]
    launcher.launch(
        kernels._inject,
        runs,
        [
            records,
            starts,
            order,
            maps.normal_after,
            maps.flux_after,
            maps.normal_before,
            maps.flux_before,
            maps.role_after,
            maps.role_before,
            texels,
            runs,
            entries,
            1.0 / voxels.box.voxel**2,
        ],
        [flux],
    )

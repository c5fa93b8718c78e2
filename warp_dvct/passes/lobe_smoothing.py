"""Reflections that rays brought, averaged over neighbouring pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import lobe_smoothing as kernels
from warp_dvct.launch import Launcher


@dataclass(frozen=True)
class Smoothing:
    """Which points may be averaged, and how widely.

    Attributes:
        grid: ``kernels.lobe_smoothing.Grid``, by :func:`lobe_grid`.
        width: Width of the mean, over that of the lobe's blur; 0 for none.
    """

    grid: Any
    width: float


def lobe_grid(rank: Any, columns: int, rows: int) -> Any:
    """``kernels.lobe_smoothing.Grid`` of a picture, the centres of whose pixels are its first points; without columns
    and rows points have no neighbours.

    Args:
        rank: int per point, its rank among those that reflect, or -1.
    """
    grid = kernels.Grid()
    grid.columns, grid.rows, grid.rank = columns, rows, rank
    return grid


def new_reflected(launcher: Launcher, count: int) -> Any:
    """``kernels.lobe_smoothing.Reflected`` of ``count`` points, which a kernel has yet to write."""
    reflected = kernels.Reflected()
    reflected.change, reflected.before = (launcher.empty(max(1, count), wp.vec3) for _ in range(2))
    reflected.nearness = launcher.empty(max(1, count), wp.float32)
    return reflected


def add_reflected(
    launcher: Launcher,
    scene: DeviceScene,
    points: Any,
    index: Any,
    count: int,
    reflected: Any,
    smoothing: Smoothing,
    *,
    light: Any,
    before: Any,
    with_before: bool,
) -> None:
    """Add what rays brought the ``count`` points listed in ``index``, and their neighbours, to ``light`` and, where it
    is wanted, ``before``."""
    launcher.launch(
        kernels._smooth_lobes,
        count,
        [points, index, smoothing.grid, scene.camera.origin, smoothing.width, reflected, int(with_before)],
        [light, before],
    )

"""G-buffer: shading points of the whole scene, and of the real scene alone where the two differ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import gbuffer as kernels
from warp_dvct.kernels.gbuffer import Points
from warp_dvct.launch import Launcher
from warp_dvct.passes.sorting import scan

SPHERE_MARGIN = 1.001  # of a radius: keeps rounding from culling a ray that barely meets what is in the sphere
EDGE_SHARE = 8  # room for one edge point in so many pixels is there from the start, and saves most pictures a copy


@dataclass(frozen=True)
class GBuffer:
    """Shading points of one picture.

    Attributes:
        points: ``Points``: entry ``p`` is pixel ``p``'s centre; then ``edge_samples`` points per edge pixel.
        count: Points in all.
        edge_rank: int ``[width * height]``, rank of an edge pixel or -1. Edge pixel of rank ``r`` owns points
            ``width * height + r * edge_samples`` and on; a pixel without an edge is its centre alone.
        behind: ``Points``: real surfaces behind the synthetic points, or None where they were not asked for.
        behind_index: int, the entry of ``points`` in front of each of ``behind``.
        behind_rank: int ``[count]``, the entry of ``behind`` for a point, or -1.
        behind_count: Entries of ``behind``.
    """

    width: int
    height: int
    edge_samples: int
    points: Any
    count: int
    edge_rank: Any
    edge_pixel: Any
    behind: Any
    behind_index: Any
    behind_rank: Any
    behind_count: int


def see_real(launcher: Launcher, scene: DeviceScene, width: int, height: int) -> tuple[Any, Any]:
    """``Points`` of the real scene alone at the pixels' centres, and float ``[pixels]``, where their rays end."""
    pixels = width * height
    points, reach = new_points(launcher, pixels), launcher.empty(pixels, wp.float32)
    launcher.launch(
        kernels._see_real, pixels, [scene.geometry, scene.materials, scene.camera, width, height], [points, reach]
    )
    return points, reach


def render_gbuffer(
    launcher: Launcher,
    scene: DeviceScene,
    width: int,
    height: int,
    *,
    edge_samples: int,
    behind: bool,
    paint: bool = True,
    seed: int = 0,
    real: tuple[Any, Any] | None = None,
) -> GBuffer:
    """Trace the camera's rays.

    Args:
        edge_samples: Points per edge pixel, spread over its area (box filter); 0 for no anti-aliasing.
        behind: Whether the real surfaces hidden by synthetic ones are needed (where there is no plate).
        paint: Whether colours make edges on real surfaces. A photograph that is their albedo holds means over pixels.
        real: What :func:`see_real` gave, where that is at hand; it is not written to.
    """
    pixels = width * height
    shared = [scene.geometry, scene.materials, scene.camera]
    centers, reach = real or see_real(launcher, scene, width, height)
    if scene.synthetic is not None:
        low, high = scene.synthetic_bounds
        sphere = wp.vec3(*(0.5 * (low + high))), 0.5 * float(np.linalg.norm(high - low)) * SPHERE_MARGIN
        seen = new_points(launcher, pixels + pixels // EDGE_SHARE)
        launcher.launch(kernels._see_synthetic, pixels, [*shared, *sphere, centers, reach, width, height], [seen])
        centers = seen
    mark = launcher.zeros(pixels, wp.int32)
    if edge_samples > 0:
        launcher.launch(kernels._mark_edges, pixels, [centers, width, height, int(paint)], [mark])
    edge_rank, edge_pixel, edges = compact(launcher, mark)
    count = pixels + edges * edge_samples
    points = extended(launcher, centers, pixels, count)
    launcher.launch(
        kernels._see_edges, edges * edge_samples, [*shared, edge_pixel, width, height, edge_samples, seed], [points]
    )
    hidden: tuple[Any, Any, Any, int] = (None, None, None, 0)
    if behind:
        hidden = _look_behind(launcher, scene, points, count, width)
    return GBuffer(width, height, edge_samples, points, count, edge_rank, edge_pixel, *hidden)


def compact(launcher: Launcher, mark: Any) -> tuple[Any, Any, int]:
    """Rank of each marked element (-1 elsewhere), the marked elements in order, and their number."""
    ends, total = scan(launcher, mark)
    rank = launcher.empty(mark.shape[0], wp.int32)
    listed = launcher.empty(max(total, 1), wp.int32)
    launcher.launch(kernels._list_edges, mark.shape[0], [mark, ends], [rank, listed])
    return rank, listed, total


def new_points(launcher: Launcher, count: int) -> Any:
    """``Points`` with room for ``count`` entries, which a kernel has yet to write."""
    points = Points()
    for name, variable in Points.vars.items():
        # Cleared, the pages would be touched by one thread alone.
        setattr(points, name, launcher.empty(max(count, 1), variable.type.dtype))
    return points


def extended(launcher: Launcher, points: Any, old: int, count: int) -> Any:
    """The first ``old`` entries of ``points`` in arrays of ``count`` entries: the same ones where those have room."""
    if count <= points.role.shape[0]:
        return first_points(points, count)
    larger = new_points(launcher, count)
    launcher.launch(kernels._copy_points, old, [points], [larger])
    return larger


def first_points(points: Any, count: int) -> Any:
    """The first ``count`` of ``points``, on the same memory."""
    if count == points.role.shape[0]:
        return points
    fewer = Points()
    for name in Points.vars:
        setattr(fewer, name, getattr(points, name)[: max(count, 1)])
    return fewer


def _look_behind(
    launcher: Launcher, scene: DeviceScene, points: Any, count: int, width: int
) -> tuple[Any, Any, Any, int]:
    mark = launcher.zeros(count, wp.int32)
    launcher.launch(kernels._mark_synthetic, count, [points], [mark])
    rank, index, hidden = compact(launcher, mark)
    behind = new_points(launcher, hidden)
    launcher.launch(
        kernels._see_behind, hidden, [scene.geometry, scene.materials, scene.camera, points, index, width], [behind]
    )
    return behind, index, rank, hidden

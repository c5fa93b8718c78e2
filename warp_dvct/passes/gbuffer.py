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

EDGE_SHARE = 20  # room for one edge pixel in so many is there from the start, and saves most pictures a copy
WINDOW_MARGIN = 1e-6  # of the farthest corner of a box: depths below are not told from 0


@dataclass(frozen=True)
class GBuffer:
    """Shading points of one picture.

    Attributes:
        points: ``Points``: entry ``p`` is pixel ``p``'s centre; then ``edge_samples`` points per edge pixel.
        count: Points in all.
        window: First and last column, first and last row that may show synthetic surfaces.
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
    window: tuple[int, int, int, int]
    edge_rank: Any
    edge_pixel: Any
    behind: Any
    behind_index: Any
    behind_rank: Any
    behind_count: int


@dataclass
class View:
    """What one camera sees, from frame to frame of a shot.

    Attributes:
        points: ``Points``, entry ``p`` is pixel ``p``: of the real scene alone at first, then with the last frame's
            objects in it, which the next frame takes out again. Behind pixels are the last frame's edge points, and
            room for more.
        reach: float ``[pixels]``, where rays into the real scene end.
        marks: int ``[pixels]``, the last frame's edge pixels. painted: Whether colours made edges then; None before.
        rows: First and last row that the objects of the last frame may have reached.
        edges: Points an edge pixel had, and the seed of where they were; None before.
    """

    points: Any
    reach: Any
    marks: Any = None
    painted: bool | None = None
    rows: tuple[int, int] = (0, -1)
    edges: tuple[int, int] | None = None


def see_real(launcher: Launcher, scene: DeviceScene, width: int, height: int, *, edge_room: int = 0) -> View:
    """The real scene alone at the pixels' centres, with room for ``edge_room`` more points behind them."""
    pixels = width * height
    view = View(new_points(launcher, pixels + edge_room), launcher.empty(pixels, wp.float32))
    launcher.launch(
        kernels._see_real,
        pixels,
        [scene.geometry, scene.materials, scene.camera, width, height],
        [view.points, view.reach],
    )
    return view


def objects_window(scene: DeviceScene, width: int, height: int) -> tuple[int, int, int, int]:
    """First and last column, first and last row of a picture that the box around the synthetic objects may reach; all
    of them where the box is not wholly in front of the camera."""
    geometry, cam = scene.geometry, scene.camera
    if not geometry.has_synthetic:
        return 0, -1, 0, -1
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    corners = np.array(geometry.center) + signs * np.array(geometry.extent) - np.array(cam.origin)
    depth = corners @ np.array(cam.forward)
    if depth.min() <= WINDOW_MARGIN * np.abs(corners).max():
        return 0, width - 1, 0, height - 1
    x = (corners @ np.array(cam.right) / depth - cam.tan_left) / (cam.tan_right - cam.tan_left) * width
    y = (corners @ np.array(cam.up) / depth - cam.tan_top) / (cam.tan_bottom - cam.tan_top) * height
    # A pixel more on each side than the box meets: rounding moves no ray that far.
    columns = np.clip([x.min() - 2.0, x.max() + 1.0], -1, width)
    rows = np.clip([y.min() - 2.0, y.max() + 1.0], -1, height)
    return int(columns[0]), int(columns[1]), int(rows[0]), int(rows[1])


def new_view(launcher: Launcher, scene: DeviceScene, width: int, height: int, edge_samples: int) -> View:
    """The real scene alone, with room for the edges of most pictures at ``edge_samples`` points an edge pixel."""
    return see_real(launcher, scene, width, height, edge_room=width * height * edge_samples // EDGE_SHARE)


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
    view: View | None = None,
) -> GBuffer:
    """Trace the camera's rays.

    Args:
        edge_samples: Points per edge pixel, spread over its area (box filter); 0 for no anti-aliasing.
        behind: Whether the real surfaces hidden by synthetic ones are needed (where there is no plate).
        paint: Whether colours make edges on real surfaces. A photograph that is their albedo holds means over pixels.
        view: What this camera saw of this real scene (:func:`new_view`) up to the last frame; this frame's objects are
            put into it, and its points are those of the result.
    """
    pixels = width * height
    shared = [scene.geometry, scene.materials, scene.camera]
    view = view or new_view(launcher, scene, width, height, edge_samples)
    window = objects_window(scene, width, height)
    low, high = _changed_rows(view, height, window, paint if edge_samples > 0 else None)
    changed, start = (high - low + 1) * width, low * width
    inputs = [*shared, view.reach, wp.vec4i(*window), width, height, start]
    launcher.launch(kernels._see_synthetic, changed, inputs, [view.points])
    if view.marks is None:
        view.marks = launcher.zeros(pixels, wp.int32)
    if edge_samples > 0:
        launcher.launch(kernels._mark_edges, changed, [view.points, width, height, int(paint), start], [view.marks])
    else:
        view.marks.zero_()
    edge_rank, edge_pixel, edges = compact(launcher, view.marks)
    # Points of the edges above those rows are where they were: they come first in both frames.
    same = view.edges == (edge_samples, seed)
    kept = int(np.searchsorted(edge_pixel.numpy()[:edges], start)) if same else 0
    view.edges = edge_samples, seed
    count = pixels + edges * edge_samples
    view.points = extended(launcher, view.points, pixels + kept * edge_samples, count)
    points = first_points(view.points, count)
    how = [edge_pixel, kept, width, height, edge_samples, seed]
    launcher.launch(kernels._see_edges, (edges - kept) * edge_samples, [*shared, *how], [points])
    hidden: tuple[Any, Any, Any, int] = (None, None, None, 0)
    if behind:
        hidden = _look_behind(launcher, scene, points, count, width)
    return GBuffer(width, height, edge_samples, points, count, window, edge_rank, edge_pixel, *hidden)


def _changed_rows(view: View, height: int, window: tuple[int, int, int, int], painted: bool | None) -> tuple[int, int]:
    """First and last row in which objects or edges may have changed: those in which objects are, or were in the last
    frame, and those beside; all where edges were marked by other rules than ``painted``, which is None for no edges."""
    rows = (window[2], window[3]) if window[0] <= window[1] else (height, -1)
    low, high = max(min(rows[0], view.rows[0]) - 1, 0), min(max(rows[1], view.rows[1]) + 1, height - 1)
    if painted is None or view.painted != painted:
        low, high = 0, height - 1
    view.painted, view.rows = painted, rows
    return low, high


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
    """``points``, or their first ``old`` entries in larger arrays where there is no room for ``count``."""
    if count <= points.role.shape[0]:
        return points
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

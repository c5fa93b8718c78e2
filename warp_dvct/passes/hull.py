"""Which synthetic triangles lie on the convex hull of their object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.boxes import around_runs, middle_and_half
from warp_dvct.kernels import hull as kernels
from warp_dvct.launch import Launcher

MOST_BODIES = 8  # objects with a box of their own, which rays are tested against one after the other
MOST_TRIANGLES = 2**16  # of a body: all of its vertices are looked at for each, which takes longer than it saves then
MOST_REAL_TRIANGLES = 2**14  # rooms that were modelled; of scans hardly a triangle is on the hull
CELLS = 32  # an edge of the grid by which vertices are grouped


@dataclass
class Hulls:
    """The synthetic objects as ``kernels.geometry.Geometry`` holds them.

    Attributes:
        count: Bodies. center, extent: vec3 ``[bodies]``, of their boxes.
        marks: int ``[synthetic triangles]``: on whose hull a triangle lies that shows ``eye`` its outer side.
        bodies: ``kernels.Bodies``. corners: vec3 ``[3 * synthetic triangles]``.
    """

    count: int
    center: Any
    extent: Any
    marks: Any
    bodies: Any
    corners: Any
    eye: tuple[float, ...] | None = None

    def set(self, geometry: Any) -> None:
        """Fill in what ``geometry`` says of bodies and hulls."""
        geometry.bodies, geometry.hull = self.count, self.marks
        geometry.body_center, geometry.body_extent, geometry.body_middle = self.center, self.extent, self.bodies.middle

    def look_from(self, launcher: Launcher, eye: Any) -> None:
        """Mark what a camera at ``eye`` sees; triangles that it does not see need no marks, and marking takes time."""
        if self.eye != tuple(eye):
            self.eye = tuple(eye)
            inputs = [self.corners, self.bodies, 1, wp.vec3(*eye)]
            launcher.launch(kernels._mark_hull, self.marks.shape[0], inputs, [self.marks])


def new_hulls(
    launcher: Launcher, corners: Any, boxes: np.ndarray, vertices: Sequence[np.ndarray], counts: Sequence[int]
) -> Hulls:
    """The hulls of synthetic meshes, or of all of them together where they are many; not marked yet.

    Args:
        corners: vec3 ``[3 * triangles]`` in volume space, in the order of the meshes.
        boxes: Low and high corners of each mesh's box, ``[m, 2, 3]``.
        vertices: Of each, float32 ``[v, 3]``. counts: Its triangles.
    """
    if len(counts) > MOST_BODIES:
        boxes = np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])[None]
        vertices, counts = [np.concatenate(vertices)], [sum(counts)]
    center, extent = (launcher.array(v, wp.vec3) for v in middle_and_half(boxes))
    marks = launcher.empty(sum(counts), wp.int32)
    return Hulls(len(counts), center, extent, marks, _bodies(launcher, vertices, counts), corners)


def real_hull(launcher: Launcher, corners: Any, vertices: Sequence[np.ndarray], count: int) -> np.ndarray:
    """Indices of the ``count`` real triangles that lie on the convex hull of them all; none where they are many."""
    if not 0 < count <= MOST_REAL_TRIANGLES:
        return np.zeros(0, np.int64)
    marks = launcher.empty(count, wp.int32)
    bodies = _bodies(launcher, [np.concatenate(vertices)], [count])
    launcher.launch(kernels._mark_hull, count, [corners, bodies, 0, wp.vec3()], [marks])
    return np.flatnonzero(marks.numpy() != kernels.NO_BODY)


def _bodies(launcher: Launcher, vertices: Sequence[np.ndarray], counts: Sequence[int]) -> Any:
    """``Bodies`` of objects by their vertices, float32 ``[v, 3]`` each, and their numbers of triangles."""
    small, large = int(kernels.SMALL), int(kernels.SMALL * kernels.IN_LARGE)
    vertices = [v if n <= MOST_TRIANGLES else v[:1] for v, n in zip(vertices, counts, strict=True)]
    # The last vertex fills a body's last boxes.
    blocks = [np.pad(v[_along_z_curve(v)], ((0, -len(v) % large), (0, 0)), "edge") for v in vertices]
    ordered = np.concatenate([np.zeros((0, 3), np.float32), *blocks])
    asked = np.array([k if n <= MOST_TRIANGLES else kernels.NO_BODY for k, n in enumerate(counts)], np.int32)
    middle = np.array([v.mean(0, dtype=np.float64) for v in vertices], np.float32).reshape(-1, 3)
    bodies = kernels.Bodies()
    bodies.of_triangle = launcher.array(np.repeat(asked, counts), wp.int32)
    bodies.middle = launcher.array(middle, wp.vec3)
    bodies.first = launcher.array(np.cumsum([0, *(len(b) // large for b in blocks)]).astype(np.int32), wp.int32)
    bodies.vertex = launcher.array(ordered, wp.vec3)
    center, extent = middle_and_half(around_runs(ordered, np.arange(0, len(ordered), small)))
    bodies.center, bodies.extent = launcher.array(center, wp.vec3), launcher.array(extent, wp.vec3)
    center, extent = middle_and_half(around_runs(ordered, np.arange(0, len(ordered), large)))
    bodies.large_center, bodies.large_extent = launcher.array(center, wp.vec3), launcher.array(extent, wp.vec3)
    return bodies


def _along_z_curve(points: np.ndarray) -> np.ndarray:
    """An order in which neighbours follow one another."""
    low = points.min(0)
    size = max(float(np.max(points.max(0) - low)), 1e-30)
    cell = np.minimum((points - low) * (CELLS / size), CELLS - 1).astype(np.int16)
    spread = np.array([sum(((i >> b) & 1) << (3 * b) for b in range(5)) for i in range(CELLS)], np.int16)
    return np.argsort(spread[cell[:, 0]] | spread[cell[:, 1]] << 1 | spread[cell[:, 2]] << 2, kind="stable")

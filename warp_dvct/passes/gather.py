"""Indirect light at shading points: sparse gathering, reconstruction, and specular reflections."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import changed_detail, gather_cones, reconstruction
from warp_dvct.kernels import gather as kernels
from warp_dvct.kernels.glossy_hits import FOCUSING, GlossyHits
from warp_dvct.launch import Launcher
from warp_dvct.passes.gbuffer import GBuffer, compact
from warp_dvct.scene import Material, Role, Scene
from warp_dvct.structs import with_fields

PLANE_TOLERANCE = 0.5  # distance off the tangent plane, in gather strides, at which a gathered point counts 1/e
FINEST = 2  # pixels to which details halve the stride
SMOOTH_REACH = 0.25  # smoothing distance over the harmonic mean distance to the surfaces around
# What is gathered, in this order: one point of each block of pixels, more at halved strides, points that no other tells
# of; and the real surfaces behind objects, point by point.
KINDS = ("blocks", "halved", "alone")
REAL_PARTS = tuple(f"real {kind}" for kind in KINDS)
OBJECT_PARTS = tuple(f"object {kind}" for kind in KINDS)
HIDDEN = "hidden"
GATHER_PARTS = (*OBJECT_PARTS, *REAL_PARTS, HIDDEN)
# By part, how many times fewer rays its points have: halved strides come in numbers, and noise that fine shows less
# (docs/accuracy.md).
FEWER = {OBJECT_PARTS[1]: 2, REAL_PARTS[1]: 2, HIDDEN: 4}


def rays_of(part: str, rays: int) -> int:
    """Of a point of a part, where others have ``rays``."""
    return max(1, rays // FEWER.get(part, 1))


def strides(stride: int, detail: float) -> list[int]:
    """Pixels between the gathered points: of the blocks, then each halved one of details."""
    found = [stride]
    while detail > 0.0 and found[-1] > FINEST and found[-1] % 2 == 0:
        found.append(found[-1] // 2)
    return found


@dataclass(frozen=True)
class Turn:
    """A share of the points of a part, runs of neighbours that lie evenly over all of them: the ``number``-th of ``of``
    such shares. ``rays``: Of a point, which :func:`rays_of` may lessen."""

    number: int
    of: int
    rays: int


class Turns(Protocol):
    """Says how many rays each turn gathers."""

    def take(self, launcher: Launcher, part: str, count: int) -> Iterator[Turn]:
        """The turns in which ``count`` points of one of ``GATHER_PARTS`` are gathered. Each is launched before the
        next is asked for."""
        ...


@dataclass(frozen=True)
class Gatherer:
    """How irradiance is gathered at a list of points: exact rays, or cones where ``cone`` is given.

    ``hits``: ``GlossyHits`` (:func:`glossy_hits`), for rays; None where surfaces met are taken as Lambertian.
    ``edge_samples``: Points of an edge pixel, which share its rays out. ``aimed``: Share of a point's rays that go
    towards synthetic objects, where these take up little of its view; for points on real surfaces. ``turns``: Decide
    on the rays instead of ``rays``, turn by turn; what was met is then not kept.
    """

    scene: DeviceScene
    world: Any
    rays: int
    seed: int
    cones: int = 0
    cone: Any = None
    with_before: bool = True
    hits: Any = None
    edge_samples: int = 1
    aimed: float = 0.0
    turns: Turns | None = None

    def run(
        self,
        launcher: Launcher,
        points: Any,
        index: Any,
        count: int,
        nearness: Any = None,
        kept: Any = None,
        *,
        stride: int = 1,
        part: str = "",
        beside: ExitStack | None = None,
    ) -> tuple[Any, Any]:
        """Irradiance [W m^-2] before and after at points ``index`` (-1 gives 0): two vec3 ``[count]``.

        ``nearness``, float ``[count]``, receives the mean inverse distance of what rays met (cones leave it alone).
        ``stride``: Spacing of the points in pixels. ``part``: One of ``GATHER_PARTS``, for turns and :func:`rays_of`.
        ``kept``: ``KeptRays`` (:func:`keep_rays`) of blocks of that stride, for centres of pixels on real surfaces, one
        of a block at most.
        ``beside``: Until it closes other work may go on beside the rays (:meth:`Launcher.beside`), and what is returned
        is not all there; without ``turns`` and ``cone``.
        """
        if nearness is None:
            nearness = launcher.empty(max(1, count), wp.float32)
        before = launcher.empty(max(1, count), wp.vec3)
        after = launcher.empty(max(1, count), wp.vec3)
        shared = [points, index, self.scene.geometry, self.world]
        if self.cone is not None:
            how = [self.cones, self.cone, int(self.with_before), self.seed]
            launcher.launch(gather_cones._gather_cones, count, [*shared, *how], [before, after])
            return before, after
        kernel = kernels._gather_rays if self.hits is None else kernels._gather_rays_glossy
        if self.hits is not None:
            shared.append(self.hits)
        if kept is None or self.turns is not None:
            kept = keep_rays(launcher, 0, 0, 0)
        parts = launcher.parts(kept.slots or count)  # the same in all frames that keep rays: each part keeps its own
        outputs = [before, after, nearness]
        if parts > 1:
            outputs = [launcher.empty(max(1, count * parts), array.dtype) for array in outputs]
        turns = [Turn(0, 1, self.rays)] if self.turns is None else self.turns.take(launcher, part, count)
        for turn in turns:
            how = [
                self.scene.targets,
                wp.vec4i(turn.number, turn.of, count, parts),
                rays_of(part, turn.rays),
                self.aimed,
                self.edge_samples,
                stride,
                self.seed,
                kept,
            ]
            runs = -(-count // kernels.RUN)
            elements = -(-runs // turn.of) * kernels.RUN * parts
            if beside is None:
                launcher.launch(kernel, elements, [*shared, *how], outputs)
            else:
                beside.enter_context(launcher.beside(kernel, elements, [*shared, *how], outputs))
        if parts > 1:
            launcher.launch(kernels._sum_parts, count, [parts, *outputs], [before, after, nearness])
        return before, after


def keep_rays(launcher: Launcher, columns: int, rows: int, rays: int, *, whole: bool = False) -> Any:
    """Empty ``KeptRays`` for ``rays`` of each block's point; with no blocks, the one that keeps nothing.

    Args:
        whole: Keep what rays meet on objects as well, which must stay, and not on real surfaces alone.
    """
    kept = kernels.KeptRays()
    slots = columns * rows
    kept.slots, kept.columns, kept.whole = slots, columns, rays if whole else 0
    kept.point = launcher.full(max(1, slots * launcher.parts(slots)), -1, wp.int32)
    kept.count = launcher.zeros(max(1, slots * launcher.parts(slots)), wp.int32)
    kept.hits = launcher.empty(max(1, slots * rays * (1 + whole)), wp.vec2i)
    return kept


def real_alone(kept: Any) -> Any:
    """What whole ``KeptRays`` keep of the real scene, on the same arrays, which are not whole any more once it is
    written to."""
    return with_fields(kernels.KeptRays, kept, whole=0)


def glossy_hits(launcher: Launcher, scene: Scene, device_scene: DeviceScene, bounces: Any, seed: int) -> Any:
    """``GlossyHits``, or None where no material sends light to places rather than all around.

    Args:
        bounces: ``BounceField``.
    """
    focuses = focusing_materials(scene)
    if not focuses.any():
        return None
    hits = GlossyHits()
    hits.seed = seed
    hits.mats, hits.lights, hits.bounces = device_scene.materials, device_scene.lights, bounces
    hits.focuses = launcher.array(focuses, wp.int32)
    return hits


def focusing_materials(scene: Scene) -> np.ndarray:
    """Whether a lobe may be too narrow for radiosity to stand for what it sends: int32 ``[materials]``."""

    def focuses(material: Material) -> bool:
        narrow = material.roughness_texture is not None or material.roughness**2 <= FOCUSING
        return narrow and material.reflects

    return np.array([focuses(material) for material in scene.materials], np.int32)


@dataclass(frozen=True)
class _Grid:
    """Gathered points: one of each block of ``stride`` x ``stride`` pixels.

    Attributes:
        gathered: ``Gathered``, the point of each block.
        nearness: float, mean inverse distance of what the point saw.
        before, after: vec3, irradiance.
    """

    stride: int
    columns: int
    rows: int
    gathered: Any
    nearness: Any
    before: Any
    after: Any

    @property
    def count(self) -> int:
        return self.columns * self.rows

    def guide(self, radius: int) -> Any:
        guide = reconstruction.Guide()
        guide.stride, guide.columns, guide.rows, guide.radius = self.stride, self.columns, self.rows, radius
        guide.plane, guide.reach = PLANE_TOLERANCE, SMOOTH_REACH
        return guide


@dataclass(frozen=True)
class SparseGather:
    """Irradiance, before and after, at every shading point of a role.

    One pixel of each ``stride`` x ``stride`` block is gathered; ``smoothing`` a-trous steps average the gathered values
    as far as the distance to what they see allows; the others are reconstructed from the blocks within
    ``radius`` that lie on the same surface. Points without any such block are gathered themselves.

    Attributes:
        detail: Bound on the relative change of irradiance within a block (Ward et al. 1988) beyond which it is gathered
            at half the stride; 0 for never.
        change: Least change around a block, as a share of irradiance, for that; 0 for any. For pictures of which only
            the change is used.
        kept: ``KeptRays`` of the blocks, then of those of half the stride and so on, as far as there are any; for the
            role REAL.
    """

    launcher: Launcher
    buffer: GBuffer
    role: Role
    gatherer: Gatherer
    stride: int
    radius: int
    smoothing: int = 0
    detail: float = 0.0
    change: float = 0.0
    kept: tuple[Any, ...] = ()

    def blocks(self, beside: ExitStack | None = None) -> _Grid:
        """The blocks' points and what they gather (``beside``: as in :meth:`Gatherer.run`)."""
        columns, rows = -(-self.buffer.width // self.stride), -(-self.buffer.height // self.stride)
        gathered = self._choose(self.stride, columns, rows)
        nearness = self.launcher.zeros(columns * rows, wp.float32)
        before, after = self.gatherer.run(
            self.launcher,
            self.buffer.points,
            gathered.choice,
            columns * rows,
            nearness,
            self._kept_at(0),
            stride=self.stride,
            part=self._parts[0],
            beside=beside,
        )
        return _Grid(self.stride, columns, rows, gathered, nearness, before, after)

    def write(self, grid: _Grid, irradiance: tuple[Any, Any]) -> None:
        """Write to two vec3 ``[buffer.count]`` what follows from the :meth:`blocks`; 0 at the background."""
        launcher, points = self.launcher, self.buffer.points
        grid = self._smooth(grid, launcher.full(grid.count, 1, wp.int32))
        if self.gatherer.cone is None:
            for level in range(1, len(strides(self.stride, self.detail))):
                grid = self._refine(grid, self._kept_at(level))
        missing = launcher.empty(self.buffer.count, wp.int32)
        guide = grid.guide(self.radius if grid.stride > 1 else min(self.radius, 1))
        launcher.launch(
            reconstruction._reconstruct,
            self.buffer.count,
            [points, int(self.role), guide, grid.gathered, grid.before, grid.after],
            [*irradiance, missing],
        )
        _, index, left = compact(launcher, missing)
        found = self.gatherer.run(launcher, points, index, left, part=self._parts[2])
        launcher.launch(reconstruction._scatter_missing, left, [index, *found], [*irradiance])

    @property
    def _parts(self) -> tuple[str, ...]:
        return REAL_PARTS if self.role == Role.REAL else OBJECT_PARTS

    def _choose(self, stride: int, columns: int, rows: int) -> Any:
        launcher, buffer, count = self.launcher, self.buffer, columns * rows
        gathered = reconstruction.Gathered()
        gathered.choice = launcher.empty(count, wp.int32)
        gathered.spot = launcher.empty(count, reconstruction.Spot)
        window = buffer.window if self.role == Role.SYNTHETIC else (0, buffer.width - 1, 0, buffer.height - 1)
        how = [stride, columns, wp.vec4i(*window), int(self.role), self.gatherer.seed]
        launcher.launch(
            reconstruction._choose_points, count, [buffer.points, buffer.width, buffer.height, *how], [gathered]
        )
        return gathered

    def _smooth(self, grid: _Grid, mark: Any) -> _Grid:
        """The grid after the a-trous steps over its marked blocks; cones are smooth."""
        launcher = self.launcher
        for step in range(self.smoothing if self.gatherer.cone is None else 0):
            before, after = launcher.empty(grid.count, wp.vec3), launcher.empty(grid.count, wp.vec3)
            now = [mark, grid.before, grid.after, grid.nearness]
            launcher.launch(
                reconstruction._smooth,
                grid.count,
                [self.buffer.points, grid.gathered, grid.guide(2), 1 << step, *now],
                [before, after],
            )
            grid = replace(grid, before=before, after=after)
        return grid

    def _kept_at(self, level: int) -> Any:
        return self.kept[level] if level < len(self.kept) else None

    def _refine(self, grid: _Grid, kept: Any) -> _Grid:
        """A grid of half the stride: gathered where ``grid`` cannot tell, interpolated elsewhere."""
        launcher, points, stride = self.launcher, self.buffer.points, grid.stride // 2
        columns, rows = -(-self.buffer.width // stride), -(-self.buffer.height // stride)
        count = columns * rows
        gathered = self._choose(stride, columns, rows)
        mark = launcher.empty(count, wp.int32)
        nearness = launcher.empty(count, wp.float32)
        before, after = launcher.empty(count, wp.vec3), launcher.empty(count, wp.vec3)
        coarse = [grid.gathered, grid.nearness, grid.before, grid.after]
        launcher.launch(
            reconstruction._find_detail,
            count,
            [points, columns, gathered, grid.guide(self.radius), *coarse, self.detail],
            [mark, nearness, before, after],
        )
        if self.change > 0.0:
            inputs = [grid.columns, grid.rows, columns, grid.before, grid.after, before, self.change]
            launcher.launch(changed_detail._unmark_unchanged, count, inputs, [mark])
        _, listed, found = compact(launcher, mark)
        index = launcher.empty(max(1, found), wp.int32)
        launcher.launch(reconstruction._pick, found, [listed, gathered.choice], [index])
        near = launcher.empty(max(1, found), wp.float32)
        fresh = self.gatherer.run(launcher, points, index, found, near, kept, stride=stride, part=self._parts[1])
        launcher.launch(reconstruction._put_detail, found, [listed, *fresh, near], [before, after, nearness])
        return self._smooth(_Grid(stride, columns, rows, gathered, nearness, before, after), mark)


def gather_all(launcher: Launcher, points: Any, count: int, gatherer: Gatherer, *, part: str = "") -> tuple[Any, Any]:
    """Irradiance, before and after, gathered at each of ``count`` points (``part``: as in :meth:`Gatherer.run`)."""
    everyone = launcher.full(max(1, count), 1, wp.int32)
    _, index, _ = compact(launcher, everyone)
    return gatherer.run(launcher, points, index, count, part=part)


def shade_indirect(
    launcher: Launcher,
    points: Any,
    count: int,
    irradiance: tuple[Any, Any],
    *,
    alpha_max: float,
    light: Any,
    before: Any,
    with_before: bool,
) -> None:
    """Add diffusely reflected irradiance to ``light`` (and ``before``): Franke 2014, eqs. 6 and 8, first terms."""
    launcher.launch(kernels._shade_indirect, count, [points, *irradiance, alpha_max, int(with_before)], [light, before])

"""Keeping a budget while it is spent: how many rays a point gathers is settled when the light is in the volumes.

By then the frame has shown how fast the machine is just now, and a few points gathered on trial show what rays take in
this scene. What is left of the time decides, again and again while they are gathered (:mod:`warp_dvct.turns`). All
other settings follow from the scene and the budget alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_dvct.cost import REST, gather_part, gather_points
from warp_dvct.cost_model import Counts, price
from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import probe
from warp_dvct.kernels.gather import RUN
from warp_dvct.launch import Launcher
from warp_dvct.passes.gather import HIDDEN, OBJECT_PARTS, REAL_PARTS, Gatherer, glossy_hits
from warp_dvct.passes.gbuffer import render_gbuffer
from warp_dvct.scene import Role, Scene
from warp_dvct.settings import Settings
from warp_dvct.survey import Survey
from warp_dvct.turns import SLOWNESS, GatherTurns, with_rays

if TYPE_CHECKING:
    from warp_dvct.methods.light_field import LightField

WIDTH = 80  # of the picture whose points are gathered on trial
TRIALS = 3  # of which the median counts: another process may hold a thread up in one of them
LEAST_TRIAL = 2e-3  # seconds of each: the clock and the threads' start do not show in it
TRIAL_SHARE = 0.01  # of what is left, for all trials
LEAST_POINTS = 128  # of a trial: every thread has several
MOST_TRIED = 128  # rays a point of a trial: more take in proportion
PROBE = 4096, 200  # elements and steps of the machine's trial: 5 ms on one thread
BELIEVED = 0.75  # of the logarithm of a slow machine's sudden speed
BUSY = 0.9  # of the largest gain by threads: passes with less leave threads idle
LAST = ("specular", "resolve", "composite", REST)  # passes after the gather
LATER = ("gbuffer", "direct", *LAST)  # passes that do not run before the volumes are lit


def try_machine(launcher: Launcher) -> float:
    """Seconds of the clock that all threads take for work of a known amount, ``PROBE``: the lesser of two tries."""
    launcher.load(probe._work.module)
    value = launcher.empty(PROBE[0], wp.float32)
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        launcher.launch(probe._work, PROBE[0], [PROBE[1]], [value])
        wp.synchronize_device(launcher.device)
        seconds.append(time.perf_counter() - start)
    return min(seconds[1:])  # the first wakes the threads


@dataclass(frozen=True)
class Settled:
    """What was settled.

    Attributes:
        rays: Of a point, the mean of all turns. planned: Of a point, when the settings were chosen.
        slowness: Measured over predicted seconds of the passes until then. ray_slowness: Of rays gathered on trial.
        turns: Rays of a point, turn by turn; with those that were planned.
    """

    rays: int
    planned: int
    slowness: float
    ray_slowness: float
    turns: tuple[int, ...]


@dataclass
class Pace:
    """One frame's way through its budget.

    Attributes:
        width, height: Of the picture.
        aim: Seconds that the planning and the frame are to take together: all of the budget, as the gather's turns
            follow the clock.
        units: Seconds of the clock by pass and unit, see ``CostModel.clock_units``. cpu_units: Of the processor.
        count: From settings to counts by pass of a frame.
        least, most: Rays of a point.
        slowness: By which ``units`` were made dearer, see ``planning``. spent: Seconds of the planning.
        settled: Once the first frame's volumes were lit; its rays once the frame was rendered.
    """

    survey: Survey
    width: int
    height: int
    aim: float
    units: dict[str, Counts]
    cpu_units: dict[str, Counts]
    count: Callable[[Settings], dict[str, Counts]]
    least: int
    most: int
    slowness: float = 1.0
    spent: float = 0.0
    settled: Settled | None = None
    _began: tuple[float, float] = field(default=(0.0, 0.0), repr=False)

    def begin(self, launcher: Launcher) -> None:
        """The frame starts now."""
        self._began = time.perf_counter(), launcher.compile_seconds

    def settle(
        self, launcher: Launcher, scene: Scene, device_scene: DeviceScene, lit: LightField, settings: Settings
    ) -> GatherTurns:
        """Turns of the gather that fill what is left, called when all but the camera's passes are done."""
        wp.synchronize_device(launcher.device)
        work = self.count(settings)
        done = {name: work[name] for name in launcher.pass_seconds if name in work and name not in (*LATER, "gather")}
        predicted = price(done, self.units)
        measured = sum(launcher.pass_seconds[name] for name in done)
        slowness = self._believed(measured / predicted if predicted > 0.0 else 1.0)
        later = {
            names: slowness * price({name: work[name] for name in names if name in work}, self.units)
            for names in (LATER, LAST)
        }
        left = self._left(launcher) - later[LATER]
        tried = self._try_rays(launcher, scene, device_scene, lit, settings, left)
        ray_slowness = self._believed(tried * self._stall(launcher, done) / self.slowness)
        apart = price({"gather": work["gather"]}, self.units) - sum(
            price({"gather": gather_part(settings, self.survey, part, points)}, self.units)
            for part, points in gather_points(settings, self.survey, self.width, self.height).items()
        )
        self.settled = Settled(settings.gather_rays, settings.gather_rays, slowness, ray_slowness, ())
        return GatherTurns(
            self.survey,
            self.width,
            self.height,
            self.units,
            left=lambda: self._left(launcher),
            later=later[LAST] + slowness * apart,
            slowness=ray_slowness,
            least=self.least,
            most=self.most,
            settings=settings,
        )

    def end(self, turns: GatherTurns) -> Settings:
        """Settings of the same time and noise as the turns, once they are over: with their mean rays."""
        rays = turns.mean_rays
        assert self.settled is not None
        self.settled = replace(self.settled, rays=rays, turns=tuple(n for _, n in turns.taken))
        return with_rays(turns.settings, rays)

    def _believed(self, slowness: float) -> float:
        """Measured over predicted seconds, within bounds. A machine that was slow when the plan was made, and no longer
        is, may soon be slow again: a part of such a change is believed."""
        least = self.slowness**-BELIEVED * min(1.0, slowness * self.slowness)
        return float(np.clip(max(slowness, least), *SLOWNESS))

    def _stall(self, launcher: Launcher, done: Mapping[str, Counts]) -> float:
        """By how much longer threads took by the clock for their processor time than when they were calibrated, in the
        passes that keep all of them busy: other processes and the machine's host take cores away."""
        if launcher.device.is_cuda:
            return 1.0
        gains = {}
        for name, counts in done.items():
            clock, processor = (price({name: counts}, units) for units in (self.units, self.cpu_units))
            if clock > 0.0:
                gains[name] = processor * self.slowness / clock
        busy = [name for name, gain in gains.items() if gain >= BUSY * max(gains.values())]
        expected = sum(launcher.pass_cpu_seconds[name] / gains[name] for name in busy)
        measured = sum(launcher.pass_seconds[name] for name in busy)
        return float(np.clip(measured / expected, 1.0 / SLOWNESS[1], SLOWNESS[1])) if expected > 0.0 else 1.0

    def _left(self, launcher: Launcher) -> float:
        """Seconds of what is aimed at that are not spent yet; loading and compiling do not count."""
        began, compiled = self._began
        return self.aim - self.spent - (time.perf_counter() - began - (launcher.compile_seconds - compiled))

    def _try_rays(
        self,
        launcher: Launcher,
        scene: Scene,
        device_scene: DeviceScene,
        lit: LightField,
        settings: Settings,
        left: float,
    ) -> float:
        """Measured over predicted processor time of rays, from points spread over a small picture in the proportion of
        real surfaces and objects in which the gather will find them.

        By the clock a trial of milliseconds says little: it is over before, or all within, another process's turn.
        """
        rays, height = min(settings.gather_rays, MOST_TRIED), max(1, round(WIDTH * self.height / self.width))
        buffer = render_gbuffer(launcher, device_scene, WIDTH, height, edge_samples=0, behind=False)
        role = buffer.points.role.numpy()[: WIDTH * height]
        found = [np.flatnonzero(role == int(r)) for r in (Role.REAL, Role.SYNTHETIC)]
        numbers = gather_points(settings, self.survey, self.width, self.height)
        objects = sum(numbers[part] for part in OBJECT_PARTS)
        share = objects / max(sum(numbers.values()) - numbers[HIDDEN], 1.0)
        few = with_rays(settings, rays)
        one = self._trial_seconds(few, 1.0 - share, share)
        wanted = launcher.threads * max(LEAST_TRIAL, TRIAL_SHARE * left / TRIALS) / max(one, 1e-9)
        points = int(np.clip(wanted, LEAST_POINTS, len(role)))
        hits = glossy_hits(launcher, scene, device_scene, lit.bounces, settings.seed)
        aimed = settings.gather_aimed if self.survey.plate else 0.0
        gatherer = Gatherer(device_scene, lit.world, rays, settings.seed, hits=hits, aimed=aimed)
        numbers = round((1.0 - share) * points), round(share * points)
        ratios = []
        for k in range(TRIALS):
            chosen = [_spread(pixels, n, k) for pixels, n in zip(found, numbers, strict=True)]
            index = launcher.array(np.concatenate(chosen).astype(np.int32), wp.int32)
            predicted = self._trial_seconds(few, len(chosen[0]), len(chosen[1]))
            now = time.perf_counter if launcher.device.is_cuda else time.process_time
            start = now()
            gatherer.run(launcher, buffer.points, index, index.shape[0], stride=settings.gather_stride)
            wp.synchronize_device(launcher.device)
            ratios.append((now() - start) / predicted)
        return float(np.median(ratios))

    def _trial_seconds(self, settings: Settings, real: float, objects: float) -> float:
        """Predicted processor time of the rays of some points on real surfaces and on objects."""
        points = {REAL_PARTS[0]: real, OBJECT_PARTS[0]: objects}
        counts = [gather_part(settings, self.survey, part, n) for part, n in points.items()]
        return sum(price({"gather": each}, self.cpu_units) for each in counts)


def _spread(pixels: np.ndarray, count: int, trial: int) -> np.ndarray:
    """About ``count`` of some pixels, in runs of neighbours that lie evenly over all of them, others in each trial."""
    runs = min(-(-count // RUN), len(pixels) // RUN)
    if runs == 0:
        return pixels[:count]
    starts = (np.arange(runs) + trial / TRIALS) * (len(pixels) / runs)
    return pixels[np.minimum(starts.astype(int), len(pixels) - RUN)[:, None] + np.arange(RUN)].ravel()

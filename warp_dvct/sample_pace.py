"""Keeping a budget while paths are traced: how many samples a pixel gets is settled by the time that is left."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import warp as wp

from warp_dvct.launch import Launcher
from warp_dvct.methods.path_tracing import PathTracer

AIM = 0.98  # of the budget: what comes after the paths is short
SHARE = 4  # of the samples that are left, one in so many is traced before the clock is asked again


@dataclass(frozen=True)
class SettledSamples:
    """What was settled. ``samples``: A pixel. ``planned``: When the settings were chosen. ``slowness``: Measured over
    predicted seconds of all samples."""

    samples: int
    planned: int
    slowness: float


@dataclass
class SamplePace:
    """One path-traced frame's way through its budget.

    Attributes:
        budget: Seconds of the planning and the frame.
        each: Seconds that a sample of all pixels is predicted to take.
        planned, most: Samples a pixel.
        spent: Seconds of the planning.
        settled: Once the frame was traced.
    """

    budget: float
    each: float
    planned: int
    most: int
    spent: float
    settled: SettledSamples | None = None
    _began: tuple[float, float] = field(default=(0.0, 0.0), repr=False)

    def begin(self, launcher: Launcher) -> None:
        """The frame starts now."""
        self._began = time.perf_counter(), launcher.compile_seconds

    def trace(self, launcher: Launcher, tracer: PathTracer, progress: Callable[[int, int], None]) -> int:
        """Add samples, one at least, until another would end too late; returns how many there are."""
        each, total = self.each, 0.0
        while tracer.samples < self.most:
            fit = int((AIM * self.budget - self._spent(launcher)) / each)
            if fit < 1 and tracer.samples > 0:
                break
            progress(tracer.samples, tracer.samples + max(fit, 1))
            samples = min(max(1, fit // SHARE), tracer.samples_per_launch, self.most - tracer.samples)
            before = self._spent(launcher)
            tracer.add(samples)
            wp.synchronize_device(launcher.device)
            took = self._spent(launcher) - before
            each, total = max(took / samples, 1e-9), total + took
        self.settled = SettledSamples(tracer.samples, self.planned, total / (tracer.samples * self.each))
        return tracer.samples

    def _spent(self, launcher: Launcher) -> float:
        """Seconds so far; loading and compiling do not count."""
        began, compiled = self._began
        return self.spent + time.perf_counter() - began - (launcher.compile_seconds - compiled)

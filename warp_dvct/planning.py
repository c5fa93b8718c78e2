"""From a scene and a budget to settings: surveys the scene and asks :mod:`warp_dvct.budget`, or tries a few paths."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.budget import AIM, Choice, check_request, choose
from warp_dvct.cost import PROBE
from warp_dvct.cost_model import CostModel, load_model, price
from warp_dvct.device_scene import DeviceScene
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.layers import Radiance
from warp_dvct.methods.path_tracing import PathTracer
from warp_dvct.metrics import to_display
from warp_dvct.pace import SLOWNESS, try_machine
from warp_dvct.plan import make_plan
from warp_dvct.sample_pace import SamplePace
from warp_dvct.scene import Scene
from warp_dvct.settings import Settings, make_settings
from warp_dvct.survey import survey

SLOW = 1.4  # of the time that the machine's trial took at calibration: up to there rays alone make up for it
PILOT_PIXELS = 5_000  # about, of the picture that tells what paths cost and how noisy they are
PILOT_SAMPLES = 4
# Mean FLIP over the mean difference in display values: 1.9 to 3.0 in four stages at 1, 4 and 16 samples a pixel.
FLIP_OF_NOISE = 2.35
FALLS = (0.1, 0.5)  # with the root of the samples, unless bright paths are so rare that they are mostly missed
MOST_SAMPLES = 2**20
MOST_FASTER = 4  # times the planned samples, on a machine that turns out to be faster


def choose_settings(
    scene: Scene,
    method: str,
    launcher: Launcher,
    width: int,
    height: int,
    *,
    seconds: float | None,
    max_error: float | None,
    has_plate: bool,
    fixed: Mapping[str, Any],
) -> Choice:
    """Settings of a method for a time or an error; see ``Relighter.keep_budget``."""
    check_request(seconds, max_error)
    if method == "path-trace":
        return _path_trace(scene, launcher, width, height, seconds, max_error, fixed)
    start, compiled = time.perf_counter(), launcher.compile_seconds
    probed = math.inf if seconds is None else try_machine(launcher)
    found = survey(scene, make_settings("balanced", fixed), launcher, width / height, has_plate=has_plate)
    if seconds is not None:
        probed = min(probed, try_machine(launcher))  # another process's turn may hide one of two, not both
    model = load_model("cpu" if launcher.device.is_cpu else launcher.device.alias)
    choice = choose(
        found,
        model,
        width=width,
        height=height,
        threads=launcher.threads,
        seconds=seconds,
        max_error=max_error,
        fixed=fixed,
        method=method,
        slowness=1.0 if seconds is None else _slowness(probed, model, launcher.threads),
    )
    if choice.pace is not None:
        choice.pace.spent = time.perf_counter() - start - (launcher.compile_seconds - compiled)
    return choice


def _slowness(probed: float, model: CostModel, threads: int) -> float:
    """By how much longer than when ``model`` was measured this machine takes just now, told by what :func:`try_machine`
    gave; 1 where that is little, for the same scene and budget to give the same settings."""
    expected = price({PROBE: {"tries": 1.0}}, model.clock_units(threads))
    if expected <= 0.0:
        return 1.0  # measured before there was a trial
    slowness = probed / expected
    return min(slowness, SLOWNESS[1]) if slowness > SLOW else 1.0


@dataclass(frozen=True)
class _Paths:
    """What a small picture says of paths.

    Attributes:
        seconds, cpu_seconds: Of one, on all threads. spent, spent_cpu: Of the small picture.
        noise: Mean difference in display values that ``PILOT_SAMPLES`` a pixel leave. falls: By which power of their
            number it falls.
    """

    seconds: float
    cpu_seconds: float
    spent: float
    spent_cpu: float
    noise: float
    falls: float

    def error(self, samples: int) -> float:
        """FLIP against a picture without noise."""
        return FLIP_OF_NOISE * self.noise * (samples / PILOT_SAMPLES) ** -self.falls

    def samples(self, error: float) -> int:
        """The fewest whose FLIP is no larger."""
        return max(1, math.ceil(PILOT_SAMPLES * (FLIP_OF_NOISE * self.noise / error) ** (1.0 / self.falls)))


def _path_trace(
    scene: Scene,
    launcher: Launcher,
    width: int,
    height: int,
    budget: float | None,
    max_error: float | None,
    fixed: Mapping[str, Any],
) -> Choice:
    """Samples that fit: paths cost, and differ by, what the scene makes of them, so a few are traced."""
    settings = make_settings("balanced", fixed)
    paths = _try_paths(scene, launcher, width, height, settings)
    each, each_cpu = width * height * paths.seconds, width * height * paths.cpu_seconds
    floor = each + paths.spent
    if budget is not None and budget < floor:
        raise OptionError(
            f"--budget {budget:g} s is below the floor: one sample a pixel at {width} x {height} takes about"
            f" {floor:.2f} s on {launcher.threads} thread(s); raise it or lower --imageWidth"
        )
    if "samples" in fixed:
        samples = settings.samples
    elif budget is not None:
        samples = max(1, int((AIM * budget - paths.spent) / each))
    else:
        samples = paths.samples(max_error or 1.0)
    if samples > MOST_SAMPLES:
        raise OptionError(
            f"--max-error {max_error:g} would take {samples} samples a pixel, more than {MOST_SAMPLES}; raise it"
            if budget is None
            else f"--budget {budget:g} s is more than {MOST_SAMPLES} samples a pixel take"
        )
    chosen = make_settings("balanced", {**fixed, "samples": samples})
    pace = None
    if budget is not None and "samples" not in fixed:
        most = min(MOST_FASTER * samples, MOST_SAMPLES)
        pace = SamplePace(budget, each, samples, most, paths.spent)
    return Choice(
        "path-trace",
        chosen,
        each * samples + paths.spent,
        each_cpu * samples + paths.spent_cpu,
        paths.error(samples),
        floor,
        tuple(sorted(fixed)),
        (
            f"samples={samples}: a path was timed at {1e6 * paths.cpu_seconds:.2f} us of processor time",
            f"noise falls with samples to the power of {paths.falls:.2f}, from FLIP"
            f" {paths.error(PILOT_SAMPLES):.3f} at {PILOT_SAMPLES}",
        ),
        pace=pace,
    )


def _try_paths(scene: Scene, launcher: Launcher, width: int, height: int, settings: Settings) -> _Paths:
    """Two independent small pictures: what they take, and by how much they differ after one sample and after more."""
    start, cpu = time.perf_counter(), time.process_time()
    compiled, compiled_cpu = launcher.compile_seconds, launcher.compile_cpu_seconds
    plan = make_plan(scene, settings, "path-trace", width, height)
    device_scene = DeviceScene.upload(launcher, scene, np.asarray(plan.origin), plan.scale)
    shrink = min(1.0, math.sqrt(PILOT_PIXELS / (width * height)))
    small = max(1, round(shrink * width)), max(1, round(shrink * height))
    bounces = settings.bounces
    tracers = [PathTracer(launcher, device_scene, scene, *small, bounces=bounces, seed=k) for k in range(2)]
    pictures = []
    traced = traced_cpu = 0.0
    for samples in (1, PILOT_SAMPLES - 1):
        for tracer in tracers:
            began, began_cpu = time.perf_counter(), time.process_time()
            before, before_cpu = launcher.compile_seconds, launcher.compile_cpu_seconds
            tracer.add(samples)
            wp.synchronize_device(launcher.device)
            traced += time.perf_counter() - began - (launcher.compile_seconds - before)
            traced_cpu += time.process_time() - began_cpu - (launcher.compile_cpu_seconds - before_cpu)
        pictures.append([tracer.resolve() for tracer in tracers])
    one, more = (_noise(*pair) for pair in pictures)
    falls = math.log(max(one, 1e-9) / max(more, 1e-9)) / math.log(PILOT_SAMPLES)
    paths = 2 * PILOT_SAMPLES * small[0] * small[1]
    return _Paths(
        traced / paths,
        traced_cpu / paths,
        time.perf_counter() - start - (launcher.compile_seconds - compiled),
        time.process_time() - cpu - (launcher.compile_cpu_seconds - compiled_cpu),
        more,
        min(max(falls, FALLS[0]), FALLS[1]),
    )


def _noise(a: Radiance, b: Radiance) -> float:
    """Mean largest difference of a channel, in display values, between a picture and the mean of many: that of two
    independent ones over the root of two. Both are composited over one 'before', as on a plate."""
    arrays = [[x.numpy().reshape(r.height, r.width, -1) for x in (r.before, r.delta, r.synthetic)] for r in (a, b)]
    plate = 0.5 * (arrays[0][0] + arrays[1][0])
    shown = [to_display(np.maximum(s[..., :3] + (1.0 - s[..., 3:]) * plate + d, 0.0)) for _, d, s in arrays]
    return float(np.abs(shown[0] - shown[1]).max(-1).mean()) / math.sqrt(2.0)

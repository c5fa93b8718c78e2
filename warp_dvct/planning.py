"""From a scene and a budget to settings: surveys the scene, and asks :mod:`warp_dvct.budget` or times a few paths."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from warp_dvct.budget import AIM, Choice, check_request, choose
from warp_dvct.cost import load_model
from warp_dvct.device_scene import DeviceScene
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.methods.path_tracing import PathTracer
from warp_dvct.plan import make_plan
from warp_dvct.scene import Scene
from warp_dvct.settings import make_settings
from warp_dvct.survey import survey

PATHS = 16_000  # at most, traced to learn what a path costs


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
        return _path_trace(scene, launcher, width, height, seconds, fixed)
    if method != "delta-cones":
        raise OptionError(
            f"a budget chooses settings of delta-cones and path-trace; give those of {method} by --quality and --set"
        )
    found = survey(scene, make_settings("balanced", fixed), launcher, width / height, has_plate=has_plate)
    return choose(
        found,
        load_model("cpu" if launcher.device.is_cpu else launcher.device.alias),
        width=width,
        height=height,
        threads=launcher.threads,
        seconds=seconds,
        max_error=max_error,
        fixed=fixed,
    )


def _path_trace(
    scene: Scene, launcher: Launcher, width: int, height: int, budget: float | None, fixed: Mapping[str, Any]
) -> Choice:
    """Samples that fit: paths cost what the scene makes of them, so a few are timed."""
    if budget is None:
        raise OptionError("--max-error: the noise of path-trace is not predicted; give --budget, or --set samples=N")
    settings = make_settings("balanced", fixed)
    plan = make_plan(scene, settings, "path-trace", width, height)
    device_scene = DeviceScene.upload(launcher, scene, np.asarray(plan.origin), plan.scale)
    shrink = min(1.0, math.sqrt(PATHS / (width * height)))
    size = max(1, round(shrink * width)), max(1, round(shrink * height))
    tracer = PathTracer(launcher, device_scene, scene, *size, bounces=settings.bounces, seed=settings.seed)
    tracer.add(1)  # loads the kernels
    start, cpu = time.perf_counter(), time.process_time()
    tracer.add(1)
    start, cpu = time.perf_counter() - start, time.process_time() - cpu
    share = width * height / (size[0] * size[1])
    floor = share * start + 2 * start
    if budget < floor:
        raise OptionError(
            f"--budget {budget:g} s is below the floor: one sample a pixel at {width} x {height} takes about"
            f" {floor:.2f} s on {launcher.threads} thread(s); raise it or lower --imageWidth"
        )
    samples = settings.samples if "samples" in fixed else max(1, int((AIM * budget - 2 * start) / (share * start)))
    chosen = make_settings("balanced", {**fixed, "samples": min(samples, 2**20)})
    return Choice(
        chosen,
        share * start * samples + 2 * start,
        share * cpu * samples + 2 * cpu,
        math.nan,
        floor,
        tuple(sorted(fixed)),
        (f"samples={samples}: a path was timed at {1e6 * start / (size[0] * size[1]):.2f} us",),
    )

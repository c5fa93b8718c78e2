"""How time and memory grow with triangles, voxels, pixels, lights, frames and threads: fitted exponents."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.bench.error import read, stage_file
from warp_dvct.bench.motion import shot
from warp_dvct.errors import OptionError
from warp_dvct.scene import LightKind, Mesh, Role, Scene

KIND = "scaling"
SLACK = 0.15  # of an exponent: what a few noisy points leave open
SHOT_FRAMES = 60  # of the whole turn of the object, unless more are measured
LEAST_GAIN = 0.5  # exponent of speed in threads below which threads are said not to pay


@dataclass(frozen=True)
class Case:
    """One frame to measure: its scene and how it is rendered."""

    scene: Scene
    settings: dict[str, Any] = field(default_factory=dict)
    width: int = 0
    threads: int | None = None


@dataclass(frozen=True)
class Axis:
    """What grows.

    Attributes:
        quick, full: Values by default, and with ``--full``.
        make: Scene, width and value to the case.
        time, again, memory: Largest exponents that are expected of a first frame, of a further frame of the unchanged
            scene, and of memory; None where nothing is claimed.
        why: The claim in words.
    """

    name: str
    quick: tuple[int, ...]
    full: tuple[int, ...]
    make: Callable[[Scene, int, int], Case]
    time: float | None
    again: float | None
    memory: float | None
    why: str


@dataclass(frozen=True)
class ScalingOptions:
    """What is measured; the fields are the command's flags."""

    axes: tuple[str, ...] = ()
    full: bool = False
    width: int = 160
    repeats: int = 2
    quality: str = "balanced"
    settings: dict[str, str] = field(default_factory=dict)
    device: str = "cpu"


def _triangles(scene: Scene, width: int, count: int) -> Case:
    """The synthetic objects become one ball of about ``count`` triangles, of their size and place."""
    bounds = scene.bounds(Role.SYNTHETIC)
    assert bounds is not None
    low, high = bounds
    real = tuple(m for m in scene.meshes if m.role == Role.REAL)
    first = next(m for m in scene.meshes if m.role == Role.SYNTHETIC)
    radius = 0.5 * float(np.min(high - low))
    return Case(
        replace(scene, meshes=(*real, ball(0.5 * (low + high), radius, count, int(first.materials[0])))), {}, width
    )


def ball(center: np.ndarray, radius: float, count: int, material: int) -> Mesh:
    """A sphere of about ``count`` triangles (at least 8), by longitude and latitude."""
    rows = max(2, round(math.sqrt(count / 4)) + 1)
    columns = 2 * rows
    theta = np.linspace(0.0, math.pi, rows + 1)[:, None]
    phi = np.linspace(0.0, 2.0 * math.pi, columns, endpoint=False)[None]
    up = np.broadcast_to(np.cos(theta), (rows + 1, columns))
    points = np.stack([np.sin(theta) * np.cos(phi), up, np.sin(theta) * np.sin(phi)], -1).reshape(-1, 3)
    i, j = (v.ravel() for v in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    triangles = np.concatenate([np.stack([a, b, c], 1)[i > 0], np.stack([b, d, c], 1)[i < rows - 1]]).astype(np.int32)
    materials = np.full(len(triangles), material, np.int32)
    return Mesh(center + radius * points, triangles, materials, Role.SYNTHETIC, path="/ball")


def _resolution(scene: Scene, width: int, n: int) -> Case:
    # One volume, and maps as fine as its voxels, so that nothing else decides.
    return Case(scene, {"volume.resolution": n, "volume.coarse": 0, "rsm.texels": 4 * n}, width)


def _pixels(scene: Scene, width: int, factor: int) -> Case:
    return Case(scene, {}, factor)


def _lights(scene: Scene, width: int, count: int) -> Case:
    """The first light with a place, ``count`` times on a ring around where it is, with as much light in all."""
    index = next((i for i, x in enumerate(scene.lights) if x.kind not in (LightKind.DOME, LightKind.DISTANT)), None)
    if index is None:
        raise OptionError("--axis lights: the stage has no light with a place; take another --stage")
    light = scene.lights[index]
    radius = 0.2 * float(np.max(np.subtract(*(scene.bounds() or (np.zeros(3), np.ones(3)))[::-1])))
    share = tuple(v / count for v in light.radiance)
    turns = [2.0 * math.pi * k / count for k in range(count)]
    offsets = [radius * np.array([math.cos(t), 0.0, math.sin(t)]) * (count > 1) for t in turns]
    copies = [replace(light, position=tuple(np.asarray(light.position) + o), radiance=share) for o in offsets]
    return Case(replace(scene, lights=tuple(copies)), {}, width)


def _threads(scene: Scene, width: int, count: int) -> Case:
    return Case(scene, {}, 2 * width, count)


def _thread_counts() -> tuple[int, ...]:
    cores = len(os.sched_getaffinity(0))
    return tuple(sorted({min(2**k, cores) for k in range(cores.bit_length() + 1)}))


FRAMES = "frames"
AXES = (
    Axis(
        "triangles",
        (10**3, 10**4, 10**5),
        (10**3, 10**4, 10**5, 10**6, 10**7),
        _triangles,
        1.0,
        0.15,
        1.0,
        "once voxelised, a frame's time does not depend on them, but for deeper trees",
    ),
    Axis(
        "resolution",
        (32, 64, 128),
        (64, 128, 256, 512, 1024),
        _resolution,
        2.0,
        0.1,
        2.0,
        "voxels hold surface: time and memory grow by the square, not the cube",
    ),
    Axis("pixels", (160, 320, 640), (160, 320, 640, 1280, 2560), _pixels, 2.0, 2.0, 2.0, "of the width: by its square"),
    Axis("lights", (1, 2, 4), (1, 2, 4, 8, 16, 32, 64), _lights, 1.0, 1.0, 1.0, "at most in proportion"),
    Axis(
        FRAMES,
        (1, 2, 4, 8),
        (1, 4, 16, 64),
        lambda s, w, v: Case(s, {}, w),
        1.0,
        None,
        0.1,
        "a static room is voxelised once",
    ),
    Axis(
        "threads", _thread_counts(), _thread_counts(), _threads, None, None, 0.1, "by the clock; memory does not grow"
    ),
)


def measure(
    stage: str, options: ScalingOptions, report: Callable[[dict[str, Any]], None] = lambda row: None
) -> list[dict[str, Any]]:
    """A row per value of each axis.

    Raises:
        OptionError: An unknown axis, nothing synthetic to scale, ``repeats`` below 1.
    """
    names = [axis.name for axis in AXES]
    for name in options.axes:
        if name not in names:
            raise OptionError(f"there is no axis '{name}'; choose from {', '.join(names)}")
    if options.repeats < 1:
        raise OptionError(f"--repeats is {options.repeats}; give at least 1")
    scene = read(stage_file(stage))
    if scene.bounds(Role.SYNTHETIC) is None:
        raise OptionError("the stage has nothing synthetic; take another --stage")
    rows = []
    for axis in AXES:
        if options.axes and axis.name not in options.axes:
            continue
        values = axis.full if options.full else axis.quick
        _render(axis.make(scene, 32, values[0]), options, 1)  # compiles
        for value in values:
            if axis.name == FRAMES:
                row = _measure_shot(scene, value, options)
            else:
                row = _measure_frame(axis, scene, value, options)
            head = {"kind": KIND, "stage": Path(stage).stem, "axis": axis.name, "value": value}
            rows.append({**head, "quality": options.quality, "settings": dict(options.settings), **row})
            report(rows[-1])
    return rows


def _relighter(case: Case, options: ScalingOptions) -> Any:
    from warp_dvct.relighter import Relighter

    settings = {**case.settings, **options.settings}
    return Relighter(
        case.scene,
        quality=options.quality,
        settings=settings,
        width=case.width,
        device=options.device,
        threads=case.threads,
    )


def _render(case: Case, options: ScalingOptions, frames: int) -> list[dict[str, Any]]:
    """Statistics of a first and of further frames of an unchanged scene, on a grey plate."""
    relighter = _relighter(case, options)
    plate = np.full((relighter.height, relighter.width, 3), 0.5, np.float32)
    stats = []
    for _ in range(frames):
        relighter.render(plate)
        stats.append(relighter.stats)
    return stats


def _spent(options: ScalingOptions) -> str:
    """Which seconds are fitted: of all threads, or of the clock where kernels run elsewhere."""
    return "cpu_seconds" if options.device == "cpu" else "render_seconds"


def _measure_frame(axis: Axis, scene: Scene, value: int, options: ScalingOptions) -> dict[str, Any]:
    case = axis.make(scene, options.width, value)
    runs = [_render(case, options, 2) for _ in range(options.repeats)]
    first, again = ([run[k] for run in runs] for k in (0, 1))
    spent = _spent(options)
    best = min(first, key=lambda s: s[spent])
    return {
        "triangles": sum(len(m.triangles) for m in case.scene.meshes),
        "seconds": min(s["render_seconds"] for s in first),
        "cpu_seconds": best[spent],
        "again_cpu_seconds": min(s[spent] for s in again),
        "bytes": best["peak_bytes"],
        "cpu_passes": best["cpu_passes"],
    }


def _measure_shot(scene: Scene, frames: int, options: ScalingOptions) -> dict[str, Any]:
    """A shot of a moving object: the sum of its frames, and how often the real room was voxelised again."""
    moments = shot(scene, max(frames, SHOT_FRAMES), False)[:frames]
    relighter = _relighter(Case(moments[0], {}, options.width), options)
    plate = np.full((relighter.height, relighter.width, 3), 0.5, np.float32)
    wall = cpu = 0.0
    peak = again = 0
    places, last = 0, ()  # of both volumes: the fine one follows the object in steps, each of which needs voxels
    for moment in moments:
        relighter.set_scene(moment)
        relighter.render(plate)
        stats = relighter.stats
        wall, cpu = wall + stats["render_seconds"], cpu + stats[_spent(options)]
        peak = max(peak, stats["peak_bytes"])
        fragments = [reused for name, reused in stats["kept"].items() if name.startswith("real fragments")]
        again += sum(not reused for reused in fragments)
        plan = relighter.plan
        now = tuple((plan.origin, plan.scale, box) for box in (plan.fine, plan.coarse) if box is not None)
        places, last = places + len(set(now) - set(last)), now
    return {
        "triangles": sum(len(m.triangles) for m in scene.meshes),
        "seconds": wall,
        "cpu_seconds": cpu,
        "again_cpu_seconds": None,
        "bytes": peak,
        "cpu_passes": {},
        "voxelised_real": again,
        "places": places,
    }


@dataclass(frozen=True)
class Exponent:
    """Of one quantity of one axis: fitted over all points, between the last two, and the largest expected."""

    axis: str
    what: str
    fitted: float
    last: float
    expected: float | None
    worse: bool


def exponents(rows: Sequence[dict[str, Any]]) -> list[Exponent]:
    """Log-log slopes by axis; ``worse`` where the last step is steeper than expected by more than the slack.

    The last step decides, since at small sizes what every frame costs hides the growth.
    """
    found = []
    for axis in AXES:
        own = [r for r in rows if r["axis"] == axis.name]
        if len(own) < 2:
            continue
        x = [float(r["triangles"] if axis.name == "triangles" else r["value"]) for r in own]
        if axis.name == "threads":
            found.append(_speed(x, [r["seconds"] for r in own]))
        else:
            what = "all frames" if axis.name == FRAMES else "first frame"
            found.append(_exponent(axis.name, what, x, [r["cpu_seconds"] for r in own], axis.time))
            if axis.again is not None:
                again = [r["again_cpu_seconds"] for r in own]
                found.append(_exponent(axis.name, "next frame", x, again, axis.again))
        found.append(_exponent(axis.name, "memory", x, [r["bytes"] for r in own], axis.memory))
    return found


def _exponent(axis: str, what: str, x: Sequence[float], y: Sequence[float], expected: float | None) -> Exponent:
    fitted = float(np.polyfit(np.log(x), np.log(y), 1)[0])
    last = math.log(y[-1] / y[-2]) / math.log(x[-1] / x[-2])
    return Exponent(axis, what, fitted, last, expected, expected is not None and last > expected + SLACK)


def _speed(x: Sequence[float], seconds: Sequence[float]) -> Exponent:
    speed = _exponent("threads", "speed", x, [1.0 / s for s in seconds], None)
    return replace(speed, expected=LEAST_GAIN, worse=speed.last < LEAST_GAIN)


HEAD = f"{'axis':12}{'value':>10}{'triangles':>11}{'seconds':>10}{'CPU s':>9}{'next CPU s':>12}{'MiB':>9}"


def format_row(row: dict[str, Any]) -> str:
    """A line under :data:`HEAD`."""
    again = row["again_cpu_seconds"]
    shown = f"{'-':>12}" if again is None else f"{again:12.3f}"
    line = (
        f"{row['axis']:12}{row['value']:10}{row['triangles']:11}{row['seconds']:10.3f}{row['cpu_seconds']:9.3f}{shown}"
    )
    line += f"{row['bytes'] / 2**20:9.1f}"
    if "voxelised_real" in row:
        line += f"  real surfaces voxelised {row['voxelised_real']} times: the volumes were in {row['places']} places"
    return line


def format_exponents(found: Sequence[Exponent], rows: Sequence[dict[str, Any]]) -> str:
    """A line per exponent; what is worse than expected is flagged."""
    why = {axis.name: axis.why for axis in AXES}
    lines = [f"{'axis':12}{'of':14}{'exponent':>10}{'last step':>11}{'expected':>10}"]
    for e in found:
        expected = "-" if e.expected is None else f"{'≥' if e.what == 'speed' else '≤'} {e.expected:g}"
        flag = "  WORSE THAN EXPECTED" if e.worse else ""
        lines.append(f"{e.axis:12}{e.what:14}{e.fitted:10.2f}{e.last:11.2f}{expected:>10}{flag}")
    lines += [f"{name}: {why[name]}" for name in dict.fromkeys(e.axis for e in found)]
    twice = [r for r in rows if r.get("voxelised_real", 0) > r.get("places", 0)]
    lines += [f"WORSE THAN EXPECTED: {format_row(r)}" for r in twice]
    return "\n".join(lines)

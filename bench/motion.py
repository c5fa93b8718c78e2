"""A moving shot: frames a second, what is kept between frames, equality with frames from scratch, and flicker."""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.bench.error import MANY_BOUNCES, read, stage_file
from warp_dvct.bench.references import ReferenceStore
from warp_dvct.bench.table1 import machine
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.layers import Layers
from warp_dvct.metrics import flip_ldr, import_flip
from warp_dvct.scene import Light, LightKind, Role, Scene

if TYPE_CHECKING:
    from warp_dvct.relighter import Relighter

OBJECT_SWING = 0.4  # of the object's largest edge: how far it goes to each side
LIGHT_SWING = 0.1  # of the real scene's largest edge
LIGHT_TURN = math.radians(10.0)  # of lights that have a direction and no place
PEER_SAMPLES = 4


@dataclass(frozen=True)
class MotionOptions:
    """What ``bench motion`` measures; the fields are its flags."""

    frames: int = 60
    light: bool = False
    plate: bool = True
    quality: str = "balanced"
    settings: dict[str, str] = field(default_factory=dict)
    width: int = 640
    checks: int = 3
    flicker: int = 5
    flicker_width: int = 320
    samples: int = 64
    cache: Path = Path()
    device: str = "cpu"
    threads: int | None = None


@dataclass(frozen=True)
class Flicker:
    """Mean temporal LDR-FLIP of the error between consecutive frames.

    Attributes:
        frames: Consecutive frames. size: Pixels. truth_samples: Per pixel of the truth.
        truth_noise: What the truth's own noise flickers by: half of its two halves' flicker beside each other. It is in
            ``ours`` and ``peer``, of which :meth:`net` takes it out.
        ours, peer: Of the method, and of the path tracer at 4 samples a pixel.
        peer_name: What the peer is, with or without a denoiser.
        ours_error, peer_error: Mean LDR-FLIP of the single frames.
    """

    frames: int
    size: tuple[int, int]
    truth_samples: int
    truth_noise: float
    ours: float
    peer: float
    peer_name: str
    ours_error: float
    peer_error: float

    def net(self, flicker: float) -> float:
        """Without the truth's noise: independent errors add up as squares."""
        return math.sqrt(max(flicker**2 - self.truth_noise**2, 0.0))


@dataclass(frozen=True)
class MotionReport:
    """One shot.

    Attributes:
        seconds, cpu_seconds: Per warm frame: on the clock, and of all threads together.
        plate: Whether frames were composited on a plate, or rendered the light before as well.
        passes: Median seconds of each pass. kept: Per kept result, the share of warm frames that reused it.
        checked, equal: Frames compared with a frame from scratch, and how many of these were equal bit for bit.
    """

    stage: str
    moving: str
    plate: bool
    size: tuple[int, int]
    machine: str
    seconds: list[float]
    cpu_seconds: list[float]
    passes: dict[str, float]
    kept: dict[str, float]
    checked: int
    equal: int
    flicker: Flicker | None

    @property
    def frames_per_second(self) -> float:
        """Of the median warm frame."""
        return 1.0 / float(np.median(self.seconds))


def shot(scene: Scene, frames: int, light: bool) -> list[Scene]:
    """The scenes of a moving shot: the synthetic objects, or the first light that has a place or a direction, go once
    along a horizontal figure of eight around where they are.

    Raises:
        OptionError: There is nothing to move, or fewer than 2 frames.
    """
    if frames < 2:
        raise OptionError(f"--frames is {frames}; a moving shot has at least 2")
    bounds, real = scene.bounds(Role.SYNTHETIC), scene.bounds(Role.REAL)
    vertical = int(np.argmax(np.abs(np.asarray(scene.camera.to_world)[:3, 1])))
    u, v = np.delete(np.eye(3), vertical, 0)
    turns = [2.0 * math.pi * n / frames for n in range(frames)]
    path = [math.sin(t) * u + 0.5 * math.sin(2.0 * t) * v for t in turns]
    if light:
        index = next((i for i, x in enumerate(scene.lights) if x.kind != LightKind.DOME), None)
        if index is None or real is None:
            raise OptionError("--light: the stage has no light with a place or a direction; take another --stage")
        swing = LIGHT_SWING * float(np.max(real[1] - real[0]))
        return [_with_light(scene, index, swing * p, LIGHT_TURN * p) for p in path]
    if bounds is None:
        raise OptionError("the stage has no synthetic object to move; take another --stage, or --light")
    swing = OBJECT_SWING * float(np.max(bounds[1] - bounds[0]))
    return [_with_objects(scene, swing * p) for p in path]


def _with_objects(scene: Scene, offset: np.ndarray) -> Scene:
    meshes = tuple(replace(m, points=m.points + offset) if m.role == Role.SYNTHETIC else m for m in scene.meshes)
    return replace(scene, meshes=meshes)


def _with_light(scene: Scene, index: int, offset: np.ndarray, turn: np.ndarray) -> Scene:
    lights = list(scene.lights)
    light: Light = lights[index]
    if light.kind == LightKind.DISTANT:
        direction = np.asarray(light.direction) + np.tan(turn)
        lights[index] = replace(light, direction=tuple(direction / np.linalg.norm(direction)))
    else:
        lights[index] = replace(light, position=tuple(np.asarray(light.position) + offset))
    return replace(scene, lights=tuple(lights))


def measure(stage: str, options: MotionOptions) -> MotionReport:
    """Render a shot frame after frame by one Relighter, on the plates that a camera would have taken of the real scene.

    Args:
        stage: A bundled stage's name, or a USD file.
    Raises:
        DvctError: As the relighter raises; OptionError for nothing to move or a missing flip-evaluator.
    """
    if options.flicker > 1:
        import_flip()
    scene = read(stage_file(stage))
    scenes = shot(scene, options.frames, options.light)
    plates = _plates(scenes, options)
    relighter = _relighter(scenes[0], options, options.width)
    relighter.render(plates[0])
    seconds, cpu, passes, kept, checked, equal = [], [], [], [], 0, 0
    check = {round(k) for k in np.linspace(1, options.frames - 1, options.checks)} if options.checks else set()
    for n, (moment, plate) in enumerate(zip(scenes[1:], plates[1:], strict=True), 1):
        start, start_cpu = time.perf_counter(), time.process_time()
        relighter.set_scene(moment)
        layers = relighter.render(plate)
        seconds.append(time.perf_counter() - start)
        cpu.append(time.process_time() - start_cpu)
        passes.append(relighter.stats["passes"])
        kept.append(relighter.stats["kept"])
        if n in check:
            checked += 1
            equal += same(layers, _relighter(moment, options, options.width).render(plate))
    return MotionReport(
        Path(stage).stem,
        "a light" if options.light else "the synthetic objects",
        options.plate,
        (relighter.width, relighter.height),
        machine(),
        seconds,
        cpu,
        {name: float(np.median([p.get(name, 0.0) for p in passes])) for name in passes[-1]},
        {name: float(np.mean([k.get(name, False) for k in kept])) for name in kept[-1]},
        checked,
        equal,
        _flicker(scenes[: options.flicker], options) if options.flicker > 1 else None,
    )


def same(one: Layers, other: Layers) -> bool:
    """Whether two frames are equal bit for bit, in every layer."""
    pairs = [(getattr(one, n), getattr(other, n)) for n in Layers.__dataclass_fields__]
    return all(np.array_equal(a, b, equal_nan=isinstance(a, np.ndarray)) for a, b in pairs)


def _relighter(scene: Scene, options: MotionOptions, width: int) -> Relighter:
    from warp_dvct.relighter import Relighter

    return Relighter(
        scene,
        quality=options.quality,
        settings=options.settings,
        width=width,
        device=options.device,
        threads=options.threads,
    )


def _plates(scenes: Sequence[Scene], options: MotionOptions) -> Sequence[np.ndarray | None]:
    """The real scene of each frame as the method renders it: as good a photograph as any where speed is measured.

    While only objects move it is one photograph.
    """
    if not options.plate:
        return [None] * len(scenes)
    film, plates = _relighter(scenes[0], options, options.width), []
    for moment in scenes if options.light else scenes[:1]:
        film.set_scene(moment)
        plates.append(np.ascontiguousarray(film.render().plate))
    return plates if options.light else plates * len(scenes)


def _flicker(scenes: Sequence[Scene], options: MotionOptions) -> Flicker:
    launcher = Launcher(options.device, options.threads)
    width = options.flicker_width
    height = max(1, round(width / scenes[0].camera.aspect))
    # Two halves by other random numbers, for what the truth's own noise flickers by to be known.
    halves = [
        [
            ReferenceStore(
                scene, width, height, samples=half, seed=seed, cache=options.cache, launcher=launcher, quiet=True
            ).get(MANY_BOUNCES)
            for scene in scenes
        ]
        for seed, half in ((1, -(-options.samples // 2)), (2, max(1, options.samples // 2)))
    ]
    # Every method is given the truth's 'before' as the plate: only what it changes is compared.
    plates = [0.5 * (one.before + two.before) for one, two in zip(*halves, strict=True)]
    if not options.light:
        plates = [plates[0]] * len(scenes)
    parts = [
        [t.comp - (1.0 - t.coverage[..., None]) * (t.before - p) for t, p in zip(half, plates, strict=True)]
        for half in halves
    ]
    expected = [0.5 * (one + two) for one, two in zip(*parts, strict=True)]
    ours_relighter = _relighter(scenes[0], options, width)
    denoise = _denoiser()
    ours, peer = [], []
    for n, (scene, plate) in enumerate(zip(scenes, plates, strict=True)):
        ours_relighter.set_scene(scene)
        ours.append(ours_relighter.render(plate).comp)
        peer.append(_path_traced(scene, plate, n, options, denoise))
    name = f"path tracer, {PEER_SAMPLES} spp" + (
        ", denoised by OIDN" if denoise else ", not denoised (pip install pyoidn)"
    )
    return Flicker(
        len(scenes),
        (width, height),
        options.samples,
        0.5 * flicker_of(*parts),
        flicker_of(ours, expected),
        flicker_of(peer, expected),
        name,
        _mean(flip_ldr(t, p)[0] for t, p in zip(expected, ours, strict=True)),
        _mean(flip_ldr(t, p)[0] for t, p in zip(expected, peer, strict=True)),
    )


def flicker_of(pictures: Sequence[np.ndarray], truths: Sequence[np.ndarray]) -> float:
    """Mean LDR-FLIP between each frame and what it would be if the error of the frame before had stayed as it was.

    An error that does not change from frame to frame is not seen as flicker and counts 0, however large it is.
    """
    steady = [
        np.maximum(truth + (last - last_truth), 0.0)
        for last, last_truth, truth in zip(pictures[:-1], truths[:-1], truths[1:], strict=True)
    ]
    return _mean(flip_ldr(s, p)[0] for s, p in zip(steady, pictures[1:], strict=True))


def _path_traced(
    scene: Scene, plate: np.ndarray, frame: int, options: MotionOptions, denoise: Callable[..., np.ndarray] | None
) -> np.ndarray:
    """What a user of a path tracer composites: before and after at few samples, both denoised, other noise each
    frame."""
    from warp_dvct.relighter import Relighter

    height, width = plate.shape[:2]
    settings = {"samples": str(PEER_SAMPLES), "seed": str(1000 + frame), "bounces": str(MANY_BOUNCES)}
    layers = Relighter(
        scene,
        method="path-trace",
        settings=settings,
        width=width,
        height=height,
        device=options.device,
        threads=options.threads,
    ).render()
    before, cover = layers.plate, layers.rgba[..., 3:]
    after = layers.rgba[..., :3] + (1.0 - cover) * before + layers.delta
    if denoise is not None:
        guides = {
            "albedo": np.clip(layers.albedo, 0.0, 1.0).astype(np.float32),
            "normal": layers.normal.astype(np.float32),
        }
        after, before = (
            denoise(np.ascontiguousarray(np.maximum(p, 0.0), np.float32), **guides, hdr=True) for p in (after, before)
        )
    return np.maximum(cover * after + (1.0 - cover) * (plate + after - before), 0.0).astype(np.float32)


def _denoiser() -> Callable[..., np.ndarray] | None:
    try:
        return importlib.import_module("pyoidn").denoise
    except (ImportError, OSError):
        return None


def _mean(values: Any) -> float:
    return float(np.mean(list(values)))


def format_report(report: MotionReport) -> str:
    """The report for a terminal."""
    milli = 1e3 * np.array(report.seconds)
    lines = [
        f"{report.stage} {report.size[0]}x{report.size[1]}, {report.moving} moving, {len(milli)} warm frames"
        f" {'on plates' if report.plate else 'without a plate'};"
        f" {report.machine}",
        f"{report.frames_per_second:.2f} frames/s (median {np.median(milli):.0f} ms, 9 of 10 below"
        f" {np.quantile(milli, 0.9):.0f} ms), {1e3 * np.median(report.cpu_seconds):.0f} ms of processor time a frame",
        "medians [ms]: " + ", ".join(f"{name} {1e3 * s:.0f}" for name, s in report.passes.items()),
        "kept from the frame before: " + ", ".join(f"{name} {100 * s:.0f} %" for name, s in report.kept.items()),
        f"frames compared with frames from scratch: {report.checked}, of these equal bit for bit: {report.equal}",
    ]
    if report.flicker is not None:
        f = report.flicker
        ours, peer = f.net(f.ours), f.net(f.peer)
        lines.append(
            f"flicker over {f.frames} frames at {f.size[0]}x{f.size[1]}, truth of {f.truth_samples} spp: ours"
            f" {f.ours:.4f}, {f.peer_name} {f.peer:.4f}, ratio {f.ours / max(f.peer, 1e-9):.3f};"
            f" without the truth's own {f.truth_noise:.4f}: {ours:.4f}, {peer:.4f}, ratio {ours / max(peer, 1e-9):.3f};"
            f" FLIP of the single frames {f.ours_error:.4f} and {f.peer_error:.4f}"
        )
    return "\n".join(lines)

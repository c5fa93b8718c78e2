"""Measuring what frames cost on this machine, for the cost model: bundled stages under settings drawn at random."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from warp_dvct import usd_scenes
from warp_dvct.accuracy import LADDERS_OF, RAYS
from warp_dvct.budget import choose
from warp_dvct.cost import CHOOSING, PROBE, REST, count_survey, count_work
from warp_dvct.cost_model import CostModel, Sample, fit, processor, shipped_model
from warp_dvct.cost_vpls import RENAMED, count_vpl_work
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.pace import try_machine
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Mesh, Scene
from warp_dvct.settings import make_settings
from warp_dvct.survey import Survey, survey
from warp_dvct.usd.read import read_stage

STAGES = ("room_area", "room_glossy", "ground_dome", "thin_wall", "bunny")
WIDTHS = (128, 256, 384, 512)
COUNT = {"delta-cones": count_work, "instant-radiosity": count_vpl_work}
FRAMES_EACH = {"delta-cones": 1, "instant-radiosity": 4}  # one of so many frames is of the method
CONES_EACH = 2  # and one of so many is once more of delta-cones, by cones
CONES = {
    "gather": ("cones", "rays"),
    "shadows": ("cone", "ray"),
    "glossy": ("cones", "rays"),
    "cones.count": (4, 9, 16, 36),
    "cones.step": (0.5, 1.0, 2.0),
}
REPEATS = 2  # of which the least counts: other work on the machine only adds
LONG = 2.0  # processor seconds of a frame from which one try is enough: short disturbances even out
SPLITS = 2  # of the last stage's triangles, once more: what deep trees and many triangles cost
MOST_SECONDS = 6.0  # of processor time a frame, by the shipped model: dearer draws are drawn again
MORE_RAYS = (1024, 2048)  # beyond their ladder: what is left of a long budget goes into them
BUDGETS = (4.0, 20.0)  # seconds, between which a search for settings is timed
SEARCHED = 320, 180  # pixels
MOST_DRAWS = 50


def calibrate(
    device: str = "cpu",
    threads: int | None = None,
    *,
    frames: int = 8,
    seed: int = 1,
    report: Callable[[str, float], None] = lambda name, share: None,
) -> tuple[CostModel, list[Sample]]:
    """Render ``frames`` pictures of each of a few bundled stages and fit unit costs to them.

    Args:
        frames: Of each stage. report: Called with a stage's name and the share that is done.
    Raises:
        OptionError: ``frames`` below 4: too few for the unknowns. DeviceError: The device is absent.
    """
    if frames < 4:
        raise OptionError(f"--frames is {frames}; give at least 4, the model has several unknowns a pass")
    launcher = Launcher(device, threads)
    rng = np.random.default_rng(seed)
    scenes = {name: read_stage(usd_scenes.path(name)) for name in STAGES}
    scenes[f"{STAGES[-1]}, finer"] = subdivide(scenes[STAGES[-1]], SPLITS)
    samples = []
    for i, (name, scene) in enumerate(scenes.items()):
        for k in range(frames):
            report(name, (i * frames + k) / (len(scenes) * frames))
            plate = k % 4 != 3
            looked, found = _look(name, scene, launcher, rng, plate=plate)
            samples.append(looked)
            methods = [method for method, each in FRAMES_EACH.items() if k % each == 0]
            samples += [_measure(name, scene, found, launcher, rng, method) for method in methods]
            if k % CONES_EACH == 0:
                samples.append(_measure(name, scene, found, launcher, rng, "delta-cones", cones=True))
    report("fit", 1.0)
    return fit(samples, device=device, threads=launcher.threads, machine=processor()), samples


def _look(
    name: str, scene: Scene, launcher: Launcher, rng: np.random.Generator, *, plate: bool
) -> tuple[Sample, Survey]:
    """The survey, a search for settings and the machine's trial, timed: the lesser of a few."""
    seconds = float(np.exp(rng.uniform(*np.log(BUDGETS))))
    found, times = None, []
    for _ in range(REPEATS):
        start = _Clock(launcher)
        found = survey(scene, make_settings(), launcher, scene.camera.aspect, has_plate=plate)
        surveyed = start.spent()
        start = _Clock(launcher)
        width, height = SEARCHED
        choose(found, shipped_model(), width=width, height=height, threads=launcher.threads, seconds=seconds)
        chosen = start.spent()
        probed = try_machine(launcher)
        times.append((surveyed, chosen, (launcher.threads * probed, probed)))
    assert found is not None
    work = {"survey": count_survey(found), CHOOSING: {"frame": 1.0}, PROBE: {"tries": 1.0}}
    least = {name: min(t[k] for t in times) for k, name in enumerate(work)}
    cpu, wall = ({name: seconds[k] for name, seconds in least.items()} for k in (0, 1))
    return Sample(work, wall if launcher.device.is_cuda else cpu, wall, f"{name} survey"), found


class _Clock:
    """Processor seconds and seconds since it was made, without loading and compiling."""

    def __init__(self, launcher: Launcher) -> None:
        self.launcher = launcher
        self.start = self._now()

    def _now(self) -> np.ndarray:
        compiled = self.launcher.compile_cpu_seconds, self.launcher.compile_seconds
        return np.array([time.process_time(), time.perf_counter()]) - compiled

    def spent(self) -> tuple[float, float]:
        cpu, wall = self._now() - self.start
        return float(cpu), float(wall)


def _measure(
    name: str,
    scene: Scene,
    found: Survey,
    launcher: Launcher,
    rng: np.random.Generator,
    method: str,
    *,
    cones: bool = False,
) -> Sample:
    """A frame of some size under some settings; with ``cones``, some of them ask for cones."""
    settings, width = _draw(scene, found, rng, method, CONES if cones else {})
    height = max(1, round(width / scene.camera.aspect))
    plate = np.full((height, width, 3), 0.5, np.float32) if found.plate else None
    size = {"width": width, "height": height, "device": launcher.device.alias, "threads": launcher.threads}
    stats = []
    for _ in range(REPEATS):
        relighter = Relighter(scene, method=method, settings=settings, overlap=False, **size)
        relighter.render(plate)
        stats.append(_with_rest(relighter.stats, method, by_clock=launcher.device.is_cuda))
        if relighter.stats["cpu_seconds"] > LONG:
            break
    work = COUNT[method](make_settings("balanced", settings), found, width, height)
    cpu_passes, wall_passes = ({n: min(f[k][n] for f in stats) for n in stats[0][k]} for k in (0, 1))
    shown = " ".join(f"{k}={v}" for k, v in settings.items())
    return Sample(work, cpu_passes, wall_passes, f"{name} {width} {'' if found.plate else 'no plate '}{shown}")


def _draw(
    scene: Scene, found: Survey, rng: np.random.Generator, method: str, more: Mapping[str, tuple[Any, ...]]
) -> tuple[dict[str, Any], int]:
    """Any value of each ladder, and of what there is ``more``, and any size, but no frame of many seconds."""
    shipped = shipped_model()
    settings: dict[str, Any] = {}
    width = WIDTHS[0]
    for _ in range(MOST_DRAWS):
        for ladder in LADDERS_OF[method]:
            values = ladder.values + (MORE_RAYS if ladder.knob == RAYS else ())
            settings |= ladder.settings(values[rng.integers(len(values))])
        settings |= {name: values[rng.integers(len(values))] for name, values in more.items()}
        width = int(rng.choice(WIDTHS))
        work = COUNT[method](make_settings("balanced", settings), found, width, round(width / scene.camera.aspect))
        if shipped.cpu_seconds(work) <= MOST_SECONDS:
            break
    return settings, width


def _with_rest(stats: dict[str, Any], method: str, *, by_clock: bool) -> tuple[dict[str, float], dict[str, float]]:
    """A frame's seconds by pass, of all threads and of the clock, with what is in no pass as one more.

    Where kernels do not run on the processor (``by_clock``) the clock's stand for both.
    """
    names: dict[str, str] = RENAMED if method == "instant-radiosity" else {}
    cpu, wall = ({names.get(str(n), str(n)): t for n, t in stats[k].items()} for k in ("cpu_passes", "passes"))
    cpu[REST] = max(stats["cpu_seconds"] - sum(cpu.values()), 1e-6)
    wall[REST] = max(stats["render_seconds"] - sum(wall.values()), 1e-6)
    return (wall if by_clock else cpu), wall


def subdivide(scene: Scene, times: int) -> Scene:
    """The same surfaces with each triangle split into four, ``times`` times over; textures and colours are dropped."""
    meshes = scene.meshes
    for _ in range(times):
        meshes = tuple(_split(mesh) for mesh in meshes)
    return replace(scene, meshes=meshes)


def _split(mesh: Mesh) -> Mesh:
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    corners = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
    count = 4 * len(mesh.triangles)
    return replace(
        mesh,
        points=corners,
        triangles=np.arange(3 * count, dtype=np.int32).reshape(count, 3),
        materials=np.repeat(mesh.materials, 4).astype(np.int32),
        corner_normals=None,
        corner_uvs=None,
        corner_colors=None,
    )

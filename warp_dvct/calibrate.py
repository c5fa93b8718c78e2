"""Measuring what frames cost on this machine, for the cost model: bundled stages under settings drawn at random."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from warp_dvct import usd_scenes
from warp_dvct.budget import LADDERS
from warp_dvct.cost import REST, CostModel, Sample, count_work, fit, processor
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Mesh, Scene
from warp_dvct.settings import make_settings
from warp_dvct.survey import survey
from warp_dvct.usd.read import read_stage

STAGES = ("room_area", "room_glossy", "ground_dome", "bunny")
WIDTHS = (128, 256, 384)
REPEATS = 2  # of which the least counts: other work on the machine only adds
SPLITS = 2  # of the last stage's triangles, once more: what deep trees and many triangles cost
# Values from which the design draws: cheap enough that a frame takes below a second or two.
DEAREST = {"volume.resolution": 384, "rsm.texels": 1024, "gather.rays": 256, "gather.stride": 2, "shadows.samples": 32}
DEAREST |= {"patches.count": 16384, "glossy.rays": 16, "antialias": 8, "volume.coarse": 192, "bounces": 8}


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
            samples += _measure(name, scene, launcher, rng, plate=k % 4 != 3)
    report("fit", 1.0)
    return fit(samples, device=device, threads=launcher.threads, machine=processor()), samples


def _measure(name: str, scene: Scene, launcher: Launcher, rng: np.random.Generator, *, plate: bool) -> list[Sample]:
    settings: dict[str, int] = {}
    for ladder in LADDERS:
        dearest = DEAREST[ladder.knob]
        last = next(i for i, v in enumerate(ladder.values) if v == dearest or i + 1 == len(ladder.values))
        settings |= ladder.settings(int(rng.choice(ladder.values[: last + 1])))
    width = int(rng.choice(WIDTHS))
    height = max(1, round(width / scene.camera.aspect))
    start, cpu_start = time.perf_counter(), time.process_time()
    compiled, compiled_cpu = launcher.compile_seconds, launcher.compile_cpu_seconds
    found = survey(scene, make_settings("balanced", settings), launcher, scene.camera.aspect, has_plate=plate)
    wall = time.perf_counter() - start - (launcher.compile_seconds - compiled)
    cpu = time.process_time() - cpu_start - (launcher.compile_cpu_seconds - compiled_cpu)
    cpu = wall if launcher.device.is_cuda else cpu
    planning = {"survey": {"frame": 1.0, "triangles": found.triangles * 1e-6}}
    stats = []
    for _ in range(REPEATS):
        relighter = Relighter(
            scene, settings=settings, width=width, height=height, device=launcher.device.alias, threads=launcher.threads
        )
        relighter.render(np.full((height, width, 3), 0.5, np.float32) if plate else None)
        stats.append(_with_rest(relighter.stats, by_clock=launcher.device.is_cuda))
    work = count_work(make_settings("balanced", settings), found, width, height)
    cpu_passes, wall_passes = ({n: min(f[k][n] for f in stats) for n in stats[0][k]} for k in (0, 1))
    shown = " ".join(f"{k}={v}" for k, v in settings.items())
    label = f"{name} {width} {'' if plate else 'no plate '}{shown}"
    looked = Sample(planning, {"survey": cpu}, {"survey": wall}, f"{name} survey")
    return [looked, Sample(work, cpu_passes, wall_passes, label)]


def _with_rest(stats: dict[str, Any], *, by_clock: bool) -> tuple[dict[str, float], dict[str, float]]:
    """A frame's seconds by pass, of all threads and of the clock, with what is in no pass as one more.

    Where kernels do not run on the processor (``by_clock``) the clock's stand for both.
    """
    cpu, wall = dict(stats["cpu_passes"]), dict(stats["passes"])
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

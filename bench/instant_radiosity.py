"""Differential instant radiosity: times per pass at the paper's settings, and how well its shadow maps see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import numpy as np

from warp_dvct.bench.references import ReferenceStore
from warp_dvct.bench.table1 import machine
from warp_dvct.device_scene import DeviceScene, camera_frame
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.methods.instant_radiosity import lit_region, make_vpls
from warp_dvct.metrics import flip_ldr, rmse
from warp_dvct.passes.gbuffer import render_gbuffer
from warp_dvct.passes.ism import draw_isms, new_isms, ray_sight
from warp_dvct.passes.point_cloud import sample_surfaces
from warp_dvct.passes.vpl_shading import Agreement, compare_sight
from warp_dvct.plan import make_plan
from warp_dvct.scene import Scene
from warp_dvct.settings import make_settings

# Section 6 of the paper: 1024 x 768, 256 VPLs, maps of 128 x 128, 1024 points each, a 4 x 4 split; 18 fps on a GTX 580.
PAPER_SIZE = (1024, 768)
PAPER_SETTINGS = {
    "vpls.count": "256",
    "vpls.further": "256",
    "ism.size": "128",
    "ism.points": "1024",
    "vpls.tiles": "4",
    "antialias": "0",
    "visibility": "ism",
}
STILL_WIDTH = 160  # pixels
POINTS = (128, 256, 512, 1024, 2048, 4096)


@dataclass(frozen=True)
class Times:
    """Median milliseconds per pass with ``bounces`` bounces: a first frame, and the next of the unchanged scene.

    ``first_cpu`` and ``next_cpu`` are processor time of all threads together, which a busy machine changes less.
    """

    bounces: int
    first: dict[str, float]
    next: dict[str, float]
    first_total: float
    next_total: float
    first_cpu: float
    next_cpu: float
    peak_mib: float


@dataclass(frozen=True)
class Row:
    """Agreement of imperfect shadow maps of ``points`` points with exact rays."""

    points: int
    agreement: Agreement


def measure(
    stage: str, bounces: Sequence[int], *, settings: dict[str, str], runs: int, device: str, threads: int | None
) -> list[Times]:
    """Median times of ``runs`` fresh relighters with a plate, as in the paper, after one that compiles the kernels.

    Raises:
        OptionError: ``runs`` below 1.
    """
    if runs < 1:
        raise OptionError(f"--runs is {runs}; give a number of at least 1")
    from warp_dvct.bench.error import stage_file
    from warp_dvct.relighter import Relighter

    width, height = PAPER_SIZE
    plate = np.full((height, width, 3), 0.5, np.float32)
    result = []
    for count in bounces:
        common = {
            "method": "instant-radiosity",
            "settings": {**PAPER_SETTINGS, **settings, "bounces": str(count)},
            "device": device,
            "threads": threads,
        }
        Relighter(stage_file(stage), width=64, height=48, **common).render(np.zeros((48, 64, 3), np.float32))
        frames: list[list[dict]] = []
        for _ in range(runs):
            relighter = Relighter(stage_file(stage), width=width, height=height, **common)
            frames.append([])
            for _ in range(2):
                relighter.render(plate)
                frames[-1].append(dict(relighter.stats))
        first, following = ([pair[k] for pair in frames] for k in (0, 1))
        result.append(
            Times(
                count,
                _medians(first),
                _medians(following),
                1e3 * median(s["render_seconds"] for s in first),
                1e3 * median(s["render_seconds"] for s in following),
                1e3 * median(s["cpu_seconds"] for s in first),
                1e3 * median(s["cpu_seconds"] for s in following),
                max(s["peak_bytes"] for s in first) / 2**20,
            )
        )
    return result


def agreement(
    scene: Scene, points: Sequence[int], *, settings: dict[str, str], launcher: Launcher, width: int = 64
) -> list[Row]:
    """Compare the maps of a scene's VPLs with exact rays, for several numbers of points per map.

    Pairs are all VPLs with all pixels of a picture of ``width``.
    """
    height = max(1, round(width / scene.camera.aspect))
    values = make_settings("balanced", {"bounces": 1, **settings, "visibility": "ray"})
    plan = make_plan(scene, values, "instant-radiosity", width, height)
    device_scene = DeviceScene.upload(launcher, scene, np.asarray(plan.origin), plan.scale)
    frame = camera_frame(scene.camera, np.asarray(plan.origin), plan.scale)
    buffer = render_gbuffer(
        launcher, replace(device_scene, camera=frame), width, height, edge_samples=0, behind=False, seed=values.seed
    )
    lights = make_vpls(launcher, scene, device_scene, plan)
    region = lit_region(scene, device_scene, plan)
    rows = []
    for count in points:
        cloud = sample_surfaces(launcher, device_scene, region, block=count, blocks=values.ism_blocks, seed=values.seed)
        sky, count_all = lights.ends[0], lights.vpls.count
        maps = new_isms(launcher, count_all - sky, size=values.ism_size, bias=values.ism_bias, first=sky)
        draw_isms(launcher, maps, lights.vpls, cloud, sky, count_all - sky, grow=values.ism_grow)
        rows.append(
            Row(
                count,
                compare_sight(
                    launcher, device_scene, buffer.points, buffer.count, lights.vpls, maps, ray_sight(launcher)
                ),
            )
        )
    return rows


@dataclass(frozen=True)
class Still:
    """Error of a still shot after ``frames`` frames: LDR-FLIP, and RMSE of the composite, linear."""

    frames: int
    flip: float
    rmse: float


def still(
    stage: str, frames: Sequence[int], *, settings: dict[str, str], launcher: Launcher, samples: int, cache: Path
) -> list[Still]:
    """Errors against the path tracer's one-bounce light while nothing moves and ``vpls.frames`` averages.

    Raises:
        OptionError: A number of frames below 1.
    """
    if min(frames) < 1:
        raise OptionError(f"--still is {min(frames)}; give a number of at least 1")
    from warp_dvct.bench.error import read, stage_file
    from warp_dvct.relighter import Relighter

    scene = read(stage_file(stage))
    height = max(1, round(STILL_WIDTH / scene.camera.aspect))
    store = ReferenceStore(scene, STILL_WIDTH, height, samples=samples, seed=1, cache=cache, launcher=launcher)
    truth = store.get(1)
    values = {**settings, "bounces": "1", "vpls.frames": str(max(max(frames), 2))}
    relighter = Relighter(scene, method="instant-radiosity", width=STILL_WIDTH, height=height, settings=values)
    rows = []
    for frame in range(1, max(frames) + 1):
        comp = relighter.render(truth.before).comp
        if frame in frames:
            rows.append(Still(frame, float(flip_ldr(truth.comp, comp)[0]), rmse(truth.comp, comp)))
    return rows


def format_still(rows: list[Still], title: str) -> str:
    """A line per number of frames."""
    return "\n".join(
        [title, f"{'frames':>8}{'FLIP':>10}{'RMSE':>10}", *(f"{r.frames:8}{r.flip:10.4f}{r.rmse:10.5f}" for r in rows)]
    )


def _medians(frames: list[dict]) -> dict[str, float]:
    names = dict.fromkeys(name for stats in frames for name in stats["passes"])
    return {name: 1e3 * median(stats["passes"].get(name, 0.0) for stats in frames) for name in names}


def format_times(times: list[Times], title: str) -> str:
    """A line per pass; columns per number of bounces, first frame and next."""
    heads = "".join(f"{f'{t.bounces} bounce(s)':>22}" for t in times)
    lines = [
        title,
        machine(),
        "",
        f"{'milliseconds':20}{heads}",
        f"{'':20}" + f"{'first':>12}{'next':>10}" * len(times),
    ]
    for name in dict.fromkeys(name for t in times for name in t.first):
        cells = "".join(f"{t.first.get(name, 0.0):12.1f}{t.next.get(name, 0.0):10.1f}" for t in times)
        lines.append(f"{name:20}{cells}")
    lines.append(f"{'whole frame':20}" + "".join(f"{t.first_total:12.1f}{t.next_total:10.1f}" for t in times))
    lines.append(f"{'processor time':20}" + "".join(f"{t.first_cpu:12.1f}{t.next_cpu:10.1f}" for t in times))
    lines.append(f"{'peak MiB':20}" + "".join(f"{t.peak_mib:12.1f}{'':10}" for t in times))
    lines.append("the paper: 18 frames a second, 56 ms, on a GTX 580")
    return "\n".join(lines)


def format_agreement(rows: list[Row], title: str) -> str:
    """A line per number of points."""
    lines = [title, f"{'points':>8}{'pairs':>12}{'agree':>9}{'only maps block':>18}{'only rays block':>18}"]
    for row in rows:
        a = row.agreement
        lines.append(
            f"{row.points:8}{a.pairs:12}{100 * a.agree:8.2f}%{100 * a.only_maps:17.2f}%{100 * a.only_rays:17.2f}%"
        )
    return "\n".join(lines)

"""The rows of Table 1 of Franke 2014, "Delta Voxel Cone Tracing", with the times of this machine beside."""

from __future__ import annotations

import os
import platform
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

import numpy as np
from tqdm import trange

from warp_dvct.errors import OptionError
from warp_dvct.usd_scenes import path

# Milliseconds on a GTX 780: Infinite Head, Phlegmatic Dragon, Happy Buddha.
PAPER = {
    "Rµ": (0.19, 0.22, 0.18),
    "Rρ": (0.20, 0.37, 0.62),
    "Rµ + Rρ": (0.39, 0.59, 0.80),  # not a row of the paper: we trace the pair in one pass
    "Voxelization": (2.29, 3.04, 4.39),
    "Split-inject": (3.38, 3.45, 3.26),
    "Filtering": (7.90, 8.03, 7.68),
    "Deferred pass": (0.24, 0.40, 0.64),
    "Postprocessing": (0.68, 0.74, 0.65),
    "Cone-tracing, diffuse": (7.21, 10.36, 9.07),
    "Cone-tracing, glossy": (8.84, 10.65, 10.30),
    "Cone-tracing, specular": (20.00, 21.17, 30.53),
    "∑ (glossy)": (23.72, 26.90, 27.72),
    "DVCT cost (glossy)": (22.80, 25.76, 26.43),
}
CONES = "Cone-tracing"
# Row of the table -> our passes in it; a pass named in none is printed under its own name.
PASSES = {
    "Rµ + Rρ": ("rsm",),
    "Voxelization": ("voxelize",),
    "Split-inject": ("inject",),
    "Filtering": ("light faces", "pyramid"),
    "Deferred pass": ("gbuffer",),
    "Postprocessing": ("resolve", "composite"),
    CONES: ("direct", "gather", "specular"),
}
DVCT_ROWS = ("Rµ + Rρ", "Voxelization", "Split-inject", "Filtering", CONES)
# The density makes every map as large as the texel limit allows.
SIZE_SETTINGS = {"volume.resolution": "256", "rsm.texels": "1024", "rsm.density": "16"}
# What the paper did besides: one volume, cones for everything at every pixel, one bounce, no samples at edges.
PAPER_SETTINGS = {
    "volume.coarse": "0",
    "bounces": "1",
    "antialias": "0",
    "shadows": "cone",
    "gather": "cones",
    "gather.stride": "1",
    "gather.object_stride": "1",
    "glossy": "cones",
}


@dataclass(frozen=True)
class Variant:
    """One of the paper's three surface roughnesses: a bundled stage and values that replace its roughness."""

    name: str
    stage: str
    roughness: dict[str, float] = field(default_factory=dict)


VARIANTS = (
    Variant("diffuse", "room_area"),
    Variant("glossy", "room_glossy"),
    Variant("specular", "room_glossy", {"Floor": 0.0, "Chrome": 0.0}),
)


@dataclass(frozen=True)
class Times:
    """Median milliseconds per pass of one variant: of a first frame, and of one more of the unchanged scene."""

    variant: str
    first: dict[str, float]
    next: dict[str, float]
    first_total: float
    next_total: float
    peak_mib: float


def measure(
    variant: Variant,
    *,
    quality: str,
    settings: dict[str, str],
    width: int,
    height: int,
    runs: int,
    device: str,
    threads: int | None,
) -> Times:
    """Median times of ``runs`` fresh relighters, after a small picture that compiles the kernels.

    Raises:
        OptionError: ``runs`` below 1.
    """
    if runs < 1:
        raise OptionError(f"--runs is {runs}; give a number of at least 1")
    from warp_dvct.relighter import Relighter

    plate = np.full((height, width, 3), 0.5, np.float32)  # as in the paper: the 'before' comes from a camera
    frames: list[list[dict]] = []
    with tempfile.TemporaryDirectory() as folder:
        stage = variant_stage(variant, Path(folder))
        common = {"quality": quality, "settings": settings, "device": device, "threads": threads, "overlap": False}
        Relighter(stage, width=64, height=36, **common).render(np.zeros((36, 64, 3), np.float32))  # compiles
        for _ in trange(runs, desc=variant.name, disable=None, leave=False):
            relighter = Relighter(stage, width=width, height=height, **common)
            frames.append([])
            for _ in range(2):
                relighter.render(plate)
                frames[-1].append(dict(relighter.stats))
    first, following = ([pair[k] for pair in frames] for k in (0, 1))
    return Times(
        variant.name,
        _median_passes(first),
        _median_passes(following),
        1e3 * median(stats["render_seconds"] for stats in first),
        1e3 * median(stats["render_seconds"] for stats in following),
        max(stats["peak_bytes"] for stats in first) / 2**20,
    )


def variant_stage(variant: Variant, folder: Path) -> Path:
    """The variant's stage; one with other roughness is a small layer over the bundled one."""
    base = path(variant.stage)
    if not variant.roughness:
        return base
    overs = "\n".join(
        f'over "{name}" {{\nover "Surface" {{\nfloat inputs:roughness = {value}\n}}\n}}'
        for name, value in variant.roughness.items()
    )
    file = folder / f"{variant.name}.usda"
    file.write_text(
        f'#usda 1.0\n(\n    defaultPrim = "World"\n    subLayers = [@{base.as_posix()}@]\n    upAxis = "Y"\n'
        '    metersPerUnit = 1\n    renderSettingsPrimPath = "/Render/Settings"\n)\n'
        f'over "World" {{\nover "Materials" {{\n{overs}\n}}\n}}\n',
        encoding="utf-8",
    )
    return file


def rows_of(passes: dict[str, float]) -> tuple[dict[str, float], dict[str, float]]:
    """Sum passes into the table's rows; and those that belong to none, by their own names."""
    owner = {name: row for row, names in PASSES.items() for name in names}
    rows: dict[str, float] = {}
    others: dict[str, float] = {}
    for name, value in passes.items():
        target, key = (rows, owner[name]) if name in owner else (others, name)
        target[key] = target.get(key, 0.0) + value
    return rows, others


def format_table(times: list[Times], title: str) -> str:
    """The paper's rows, ours beside; rows that no pass of ours fills show a dash."""
    sums = {t.variant: rows_of(t.first) for t in times}
    lines = [title, machine(), ""]
    lines.append(
        f"{'milliseconds':28}{'paper, GTX 780 (three scenes)':>32}" + "".join(f"{t.variant:>12}" for t in times)
    )
    for row, paper in PAPER.items():
        cells = "".join(_cell(_ours(row, t, sums[t.variant][0])) for t in times)
        lines.append(f"{row:28}{'  '.join(f'{p:5.2f}' for p in paper):>32}{cells}")
    lines.append("")
    names = sorted({name for _, others in sums.values() for name in others})
    for name in names:
        cells = "".join(_cell(sums[t.variant][1].get(name)) for t in times)
        lines.append(f"{name:28}{'not in the paper':>32}{cells}")
    for label, value in (
        ("whole frame", lambda t: t.first_total),
        ("next frame, same scene", lambda t: t.next_total),
        ("peak MiB", lambda t: t.peak_mib),
    ):
        lines.append(f"{label:60}" + "".join(_cell(value(t)) for t in times))
    return "\n".join(lines)


def machine() -> str:
    """Processor, cores this process may use, and Warp's version."""
    import warp

    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        name = models[0] if models else name
    return f"{name}, {len(os.sched_getaffinity(0))} cores, Warp {warp.__version__}, Python {platform.python_version()}"


def _ours(row: str, times: Times, sums: dict[str, float]) -> float | None:
    """Our milliseconds in a row of the paper; the rows of cones belong to one variant each."""
    if row.startswith(CONES):
        return sums.get(CONES) if row.endswith(times.variant) else None
    if row.startswith("∑"):
        return sum(sums.values()) if times.variant == "glossy" else None
    if row.startswith("DVCT"):
        return sum(sums.get(r, 0.0) for r in DVCT_ROWS) if times.variant == "glossy" else None
    return sums.get(row)


def _median_passes(frames: list[dict]) -> dict[str, float]:
    names = dict.fromkeys(name for stats in frames for name in stats["passes"])
    return {name: 1e3 * median(stats["passes"].get(name, 0.0) for stats in frames) for name in names}


def _cell(value: float | None) -> str:
    return f"{'-':>12}" if value is None else f"{value:12.2f}"

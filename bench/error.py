"""How far a method's composite is from the path-traced truth, beside two baselines."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.bench.references import Reference, ReferenceStore, combine
from warp_dvct.errors import FileError, OptionError
from warp_dvct.image import write_png
from warp_dvct.launch import Launcher
from warp_dvct.metrics import (
    REGIONS,
    affected_mask,
    flip_ldr,
    import_flip,
    region_masks,
    rel_mse,
    rmse,
    smooth_delta,
    to_display,
)
from warp_dvct.usd_scenes import names, path

if TYPE_CHECKING:
    from warp_dvct.scene import Scene

LIT_STAGES = ("room_area", "room_spot", "room_glossy", "ground_dome", "bunny", "thin_wall")
MANY_BOUNCES = 8
METRICS = ("FLIP", "RMSE", "relMSE")
AREAS = ("picture", "affected", *REGIONS)
PASTED, DIRECT = "object pasted, nothing else", "direct light only"


@dataclass(frozen=True)
class ErrorOptions:
    """What ``bench error`` measures; the fields are its flags."""

    method: str = "delta-cones"
    quality: str = "balanced"
    settings: dict[str, str] = field(default_factory=dict)
    width: int = 640
    samples: int = 128
    seed: int = 1
    bounces: int = MANY_BOUNCES
    exposure: float = 0.0
    cache: Path = Path()
    out: Path | None = None
    device: str = "cpu"
    threads: int | None = None


@dataclass(frozen=True)
class Row:
    """One picture against one truth: ``errors[metric][area]``, NaN where an area has no pixel."""

    name: str
    seconds: float | None
    errors: dict[str, dict[str, float]]


@dataclass(frozen=True)
class Block:
    """The rows that are compared with one truth."""

    title: str
    truth_bounces: int
    truth_samples: int
    truth_noise: float
    pixels: dict[str, int]
    rows: list[Row]


@dataclass(frozen=True)
class Report:
    """All that was measured on one stage."""

    stage: str
    width: int
    height: int
    blocks: list[Block]


def measure(stage: str, options: ErrorOptions) -> Report:
    """Render a stage by a method and compare it with the truth, at equal bounces and with many.

    The plate is the truth's own 'before', so that what is measured is the change of light and the object.

    Args:
        stage: A bundled stage's name, or a USD file.
    Raises:
        DvctError: As the relighter raises; OptionError for a size below 16 pixels or a missing flip-evaluator.
    """
    import_flip()
    if options.width < 16:
        raise OptionError(f"--width is {options.width}; FLIP needs pictures of at least 16 pixels")
    launcher = Launcher(options.device, options.threads)
    scene = read(stage_file(stage))
    store = ReferenceStore.of(scene, options, launcher)
    glossy, direct = store.glossy_mask(), store.get(0)
    blocks = []
    for title, bounces, overrides in (
        ("equal bounces", 1, {"bounces": "1"}),
        ("many bounces", options.bounces, {}),
    ):
        truth = store.get(bounces)
        layers, seconds = _relight(scene, options, {**options.settings, **overrides}, truth.before)
        pictures = {
            f"{options.method} {options.quality}": (layers, seconds),
            PASTED: (combine(truth.before, np.zeros_like(direct.delta), direct.synthetic), None),
            DIRECT: (combine(truth.before, direct.delta, direct.synthetic), None),
        }
        masks = _masks(truth, direct, glossy)
        rows = [
            Row(n, s, _errors(truth.comp, picture, masks, options.exposure)) for n, (picture, s) in pictures.items()
        ]
        pixels = {area: int(mask.sum()) for area, mask in masks.items()}
        blocks.append(Block(title, bounces, store.samples, truth.noise, pixels, rows))
        if options.out is not None:
            _save_pictures(options.out, f"{Path(stage).stem}_{bounces}", truth.comp, layers, options.exposure)
    return Report(Path(stage).stem, options.width, store.height, blocks)


def stage_file(stage: str) -> Path:
    """A bundled stage by its name, or a file by its path.

    Raises:
        OptionError: Neither.
    """
    return Path(stage) if stage not in names() and Path(stage).suffix else path(stage)


def read(file: Path) -> Scene:
    """The stage's scene at its default time."""
    from warp_dvct.usd.read import read_stage

    return read_stage(file)


def _relight(
    scene: Scene, options: ErrorOptions, settings: dict[str, str], plate: np.ndarray
) -> tuple[np.ndarray, float]:
    """The composite, and the seconds of a frame without loading and compiling."""
    from warp_dvct.relighter import Relighter

    relighter = Relighter(
        scene,
        method=options.method,
        quality=options.quality,
        settings=settings,
        width=plate.shape[1],
        height=plate.shape[0],
        device=options.device,
        threads=options.threads,
    )
    layers = relighter.render(plate=plate)
    return layers.comp, float(relighter.stats["render_seconds"])


def _masks(truth: Reference, direct: Reference, glossy: np.ndarray) -> dict[str, np.ndarray]:
    picture = np.ones(glossy.shape, bool)
    delta, delta_direct = (smooth_delta(r.delta, truth.coverage) for r in (truth, direct))
    affected = affected_mask(delta, truth.coverage)
    regions = region_masks(delta_direct, delta, truth.coverage, glossy)
    return {"picture": picture, "affected": affected, **regions}


def _errors(truth: np.ndarray, picture: np.ndarray, masks: dict[str, np.ndarray], exposure: float) -> dict[str, Any]:
    error = flip_ldr(truth, picture, exposure)[1]
    return {
        "FLIP": {n: float(error[m].mean()) if m.any() else math.nan for n, m in masks.items()},
        "RMSE": {n: rmse(truth, picture, m) for n, m in masks.items()},
        "relMSE": {n: rel_mse(truth, picture, m) for n, m in masks.items()},
    }


def _save_pictures(folder: Path, stem: str, truth: np.ndarray, picture: np.ndarray, exposure: float) -> None:
    """``STEM_truth.png``, ``STEM_comp.png`` and ``STEM_flip.png`` (magma, black is equal)."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"--out {folder} cannot be made: {error.strerror}") from error
    flip = import_flip()
    expected, comp = (np.ascontiguousarray(to_display(p, exposure)) for p in (truth, picture))
    error_map, _, _ = flip.evaluate(expected, comp, "LDR", applyMagma=True)
    for name, pixels in (("truth", expected), ("comp", comp), ("flip", error_map)):
        codes = np.clip(pixels * 255 + 0.5, 0, 255).astype(np.uint8)
        write_png(folder / f"{stem}_{name}.png", codes)


def format_report(report: Report) -> str:
    """The report as a table for a terminal: a block per truth, a line per picture and metric."""
    lines = []
    for block in report.blocks:
        lines.append(
            f"{report.stage} {report.width}x{report.height}, {block.title}: truth of {block.truth_bounces} bounce(s),"
            f" {block.truth_samples} spp, its noise is FLIP {block.truth_noise:.4f}"
        )
        lines.append(f"{'':30}{'seconds':>9}{'':>8}" + "".join(f"{area:>11}" for area in AREAS))
        share = [f"{100 * block.pixels[area] / block.pixels['picture']:10.1f}%" for area in AREAS]
        lines.append(f"{'share of the pixels':47}" + "".join(share))
        for row in block.rows:
            for i, metric in enumerate(METRICS):
                seconds = "" if row.seconds is None or i else f"{row.seconds:.2f}"
                values = "".join(_cell(row.errors[metric][area]) for area in AREAS)
                lines.append(f"{row.name if not i else '':30}{seconds:>9}{metric:>8}{values}")
        lines.append("")
    return "\n".join(lines)


def _cell(value: float) -> str:
    return f"{'-':>11}" if math.isnan(value) else f"{value:11.4f}"

"""The table of errors that ``relight --budget`` predicts from, fitted to the rows of ``bench tradeoff``.

Squared FLIP (less that of the truth's noise) of a sweep's point over that of the stage's base point (``REFERENCE`` of
:mod:`warp_dvct.budget`) gives what a value of a knob costs; the table holds its geometric
mean over the stages of a class. The base itself is a power law in how much the objects change the picture, found by the
survey. How far several improvements together fall short of their product is fitted to all points.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.bench.error import read, stage_file
from warp_dvct.budget import CLOSED, LADDERS, REFERENCE, Accuracy, class_of, kind_of
from warp_dvct.errors import OptionError
from warp_dvct.image import write_text
from warp_dvct.launch import Launcher
from warp_dvct.settings import NAMES, Settings, make_settings
from warp_dvct.survey import Survey, survey

LEAST = 1e-4  # FLIP below which a stage says nothing


def fit_table(rows: Sequence[Mapping[str, Any]]) -> tuple[Accuracy, list[tuple[str, float, float]]]:
    """The table, and for each row its name, measured and predicted FLIP.

    Args:
        rows: Of ``bench tradeoff``, delta-cones, of several stages; other methods' and cones, which a budget does not
            choose, are left aside.
    Raises:
        OptionError: No stage has the base point, or no knob was swept.
    """
    rows = [r for r in rows if r["method"] == "delta-cones" and not _by_cones(_settings(r))]
    stages = list(dict.fromkeys(r["stage"] for r in rows))
    launcher = Launcher("cpu")
    surveys = {}
    for stage in stages:
        scene = read(stage_file(stage))
        surveys[stage] = survey(scene, make_settings(), launcher, scene.camera.aspect, has_plate=True)
    widths = [r["width"] for r in rows]
    main = max(set(widths), key=widths.count)
    points = {(r["stage"], r["width"], _settings(r)): net_flip(r) for r in rows}
    base = _base_points(rows, points, main)
    if not base:
        raise OptionError("no stage has the reference point; docs/tradeoff.md says how to measure it")
    knobs: dict[str, dict[str, list[list[float]]]] = {}
    for knob in (ladder.knob for ladder in LADDERS):
        classes = {stage: class_of(knob, surveys[stage]) for stage in base}
        for kind in dict.fromkeys(classes.values()):
            table = _excess(knob, [s for s in base if classes[s] == kind], base, points, main)
            if len(table) > 1:
                knobs.setdefault(kind, {})[knob] = table
    if not any(knobs.values()):
        raise OptionError("no knob was swept; run bench tradeoff --knob gather.rays and others first")
    coefficients = _power_law(base, surveys, points, main)
    tables = [Accuracy({**coefficients, "overlap": float(power)}, knobs, 0.0) for power in np.arange(0.1, 1.01, 0.05)]

    def compare(table: Accuracy) -> list[tuple[str, float, float]]:
        return [
            (f"{s} {w} {_name(settings)}", flip, table.error(settings, surveys[s], w))
            for (s, w, settings), flip in points.items()
            if flip > LEAST
        ]

    def spread(table: Accuracy) -> float:
        return float(np.sqrt(np.mean([math.log(m / max(p, 1e-9)) ** 2 for _, m, p in compare(table)])))

    best = min(tables, key=spread)
    return Accuracy(best.base, best.knobs, spread(best)), compare(best)


def net_flip(row: Mapping[str, Any]) -> float:
    """FLIP of the picture without what the truth's own noise is worth: independent errors add as squares."""
    return math.sqrt(max(row["errors"]["FLIP"]["picture"] ** 2 - row["truth"]["noise"] ** 2, 0.0))


def _settings(row: Mapping[str, Any]) -> Settings:
    return Settings(**row["resolved"])


def _by_cones(settings: Settings) -> bool:
    return settings.gather == "cones" or settings.shadows == "cone" or settings.glossy == "cones"


def _base_points(rows: Sequence[Mapping[str, Any]], points: Mapping[Any, float], main: int) -> dict[str, float]:
    """By stage, FLIP at the reference."""
    found = {}
    for row in rows:
        flip = points.get((row["stage"], main, make_settings("balanced", REFERENCE)), 0.0)
        if flip > LEAST:
            found[row["stage"]] = flip
    return found


def _excess(
    knob: str, stages: Sequence[str], base: Mapping[str, float], points: Mapping[Any, float], main: int
) -> list[list[float]]:
    """``[value, excess]`` by rising value, falling (for strides rising) in it."""
    ladder = next(x for x in LADDERS if x.knob == knob)
    moved = {NAMES[name] for name in ladder.settings(ladder.values[0])}
    found: dict[float, list[float]] = {}
    for (stage, width, settings), flip in points.items():
        if stage not in stages or width != main:
            continue
        reference = asdict(make_settings("balanced", REFERENCE))
        if {k for k, v in asdict(settings).items() if v != reference[k]} <= moved:
            value = float(getattr(settings, NAMES[knob]))
            found.setdefault(value, []).append(2.0 * math.log(max(flip, LEAST) / base[stage]))
    values = sorted(found)
    means = np.array([math.expm1(float(np.mean(found[v]))) for v in values])
    falling = _falling(means if knob != "gather.stride" else means[::-1])
    falling = falling if knob != "gather.stride" else falling[::-1]
    return [[v, round(float(e), 4)] for v, e in zip(values, falling, strict=True)]


def _falling(values: np.ndarray) -> np.ndarray:
    """The nearest sequence that never rises (pool adjacent violators): a dearer value that errs more is noise."""
    blocks: list[list[float]] = []
    for value in values:
        blocks.append([float(value), 1.0])
        while len(blocks) > 1 and blocks[-2][0] < blocks[-1][0]:
            (a, n), (b, m) = blocks[-2:]
            blocks[-2:] = [[(a * n + b * m) / (n + m), n + m]]
    return np.concatenate([np.full(int(n), v) for v, n in blocks]) if blocks else values


def _power_law(
    base: Mapping[str, float], surveys: Mapping[str, Survey], points: Mapping[Any, float], main: int
) -> dict[str, float]:
    """Log FLIP = constants of the classes + power * log(mean change over mean picture) + power * log(width / 320)."""
    stages = list(base)
    columns = [[float(kind_of(surveys[s]) == k) for s in stages] for k in ("diffuse", "glossy")]
    columns.append([float(surveys[s].met <= CLOSED) for s in stages])
    columns.append([math.log(max(surveys[s].affected * surveys[s].change, 1e-3)) for s in stages])
    matrix, values = np.array(columns).T, np.log([base[s] for s in stages])
    # A little pull towards no dependence keeps both sensible where there are few stages.
    pull = np.diag([0.0, 0.0, 0.1, 0.3])[2:]
    found = np.linalg.lstsq(np.vstack([matrix, pull]), np.append(values, [0.0, 0.0]), rcond=None)[0]
    slopes = []
    for (stage, width, settings), flip in points.items():
        at_main = points.get((stage, main, settings), 0.0)
        if width != main and flip > LEAST and at_main > LEAST:
            slopes.append(math.log(flip / at_main) / math.log(width / main))
    slope = float(np.mean(slopes)) if slopes else 0.0
    shift = slope * math.log(320.0 / main)
    return {
        "diffuse": float(found[0]) + shift,
        "glossy": (float(found[1]) if any(columns[1]) else float(found[0])) + shift,
        "open": float(found[2]),
        "change": float(found[3]),
        "width": slope,
    }


def _name(settings: Settings) -> str:
    reference = asdict(make_settings("balanced", REFERENCE))
    changed = [f"{k}={v}" for k, v in asdict(settings).items() if v != reference[k]]
    return " ".join(changed) or "reference"


def write_table(table: Accuracy, file: Path) -> None:
    """Write a table as JSON."""
    content = {"base": {k: round(v, 4) for k, v in table.base.items()}, "spread": round(table.spread, 4)}
    text = json.dumps({**content, "knobs": table.knobs}, indent=1)
    write_text(file, text + "\n")

"""The table of errors that ``relight --budget`` predicts from, fitted to the rows of ``bench tradeoff``.

Squared FLIP (less that of the truth's noise) of a sweep's point over that of the stage's base point (``REFERENCE`` of
:mod:`warp_dvct.accuracy`) gives what a value of a knob costs; the table holds its geometric mean over the stages of a
class. The base itself is a power law in how much the objects change the picture, found by the survey; so is what
missing bounces cost. How far several improvements together fall short of their product is fitted to all points.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.accuracy import (
    BOUNCES,
    CONES,
    DETAIL,
    DETAILS,
    FORMS,
    LADDERS_OF,
    LEAST_NOISE,
    OVERLAP,
    REFERENCE,
    REFERENCE_OF,
    STRIDE,
    Accuracy,
    class_of,
    form_table,
    kind_of,
    missing_bounces,
    sizes,
    stride_table,
)
from warp_dvct.bench.error import read, stage_file
from warp_dvct.errors import OptionError
from warp_dvct.image import write_text
from warp_dvct.launch import Launcher
from warp_dvct.pilot import FLIP_POWER
from warp_dvct.settings import NAMES, Settings, make_settings
from warp_dvct.survey import Survey, survey

LEAST = 1e-4  # FLIP below which a stage says nothing
# Powers of ``sizes`` towards which a fit is pulled: an error is mostly noise, and in proportion to both together.
TYPICAL = {"noise": 0.7, "shown": 0.3, "change": 0.0}


@dataclass(frozen=True)
class Fit:
    """A table and how well it holds.

    Attributes:
        points: Of each row its name, measured and predicted FLIP.
        unseen: By stage, FLIP measured at the reference and as predicted from the other stages alone.
    """

    table: Accuracy
    points: list[tuple[str, float, float]]
    unseen: dict[str, tuple[float, float]]


def fit_table(rows: Sequence[Mapping[str, Any]]) -> Fit:
    """The table that fits some rows best.

    Args:
        rows: Of ``bench tradeoff``, of several stages; path tracing, which has no table, is left aside. A stage without
            noise says what outlines cost, the others all else; its rows by cones, which leak there, are left aside.
    Raises:
        OptionError: No stage has the base point, or no knob was swept.
    """
    rows = [r for r in rows if r["method"] in LADDERS_OF]
    launcher = Launcher("cpu")
    surveys = {}
    for stage in dict.fromkeys(r["stage"] for r in rows):
        scene = read(stage_file(stage))
        surveys[stage] = survey(scene, make_settings(), launcher, scene.camera.aspect, has_plate=True)
    still = {stage for stage, found in surveys.items() if found.noise <= LEAST_NOISE}
    sweeps = {method: _Sweep.of(method, [r for r in rows if r["stage"] not in still]) for method in LADDERS_OF}
    outlines = _Sweep.of("delta-cones", [r for r in rows if r["stage"] in still and not _by_cones(r)])
    cones = sweeps["delta-cones"]
    if not cones.base:
        raise OptionError("no stage has the reference point; docs/tradeoff.md says how to measure it")
    knobs = {kind: tables for sweep in sweeps.values() for kind, tables in sweep.tables(surveys).items() if tables}
    if not any(knobs.values()):
        raise OptionError("no knob was swept; run bench tradeoff --knob gather.rays and others first")
    coefficients = _power_law(cones, surveys) | {"bounces": _bounces(cones, surveys)}
    coefficients |= _constants(sweeps["instant-radiosity"], surveys)
    coefficients["outlined"] = _outlined(outlines.points, surveys)
    kinds = {stage: kind_of(found) for stage, found in surveys.items()}

    def compare(table: Accuracy, methods: Sequence[str], kind: str = "") -> list[tuple[str, float, float]]:
        return [
            (f"{method} {s} {w} {_name(method, settings)}", flip, table.error(settings, surveys[s], w, method))
            for method in methods
            for sweep in (sweeps[method], outlines)
            for (s, w, settings), flip in sweep.points.items()
            if sweep.method == method and flip > LEAST and sweeps[method].base and kind in ("", kinds[s])
        ]

    def spread(table: Accuracy, kind: str = "") -> float:
        pairs = compare(table, ["delta-cones"], kind)
        return float(np.sqrt(np.mean([math.log(m / max(p, 1e-9)) ** 2 for _, m, p in pairs]))) if pairs else 0.0

    for kind in ("diffuse", "glossy"):
        powers = [{**coefficients, f"{kind} {OVERLAP}": float(power)} for power in np.arange(0.1, 1.61, 0.05)]
        coefficients = min(powers, key=lambda base, kind=kind: spread(Accuracy(base, knobs, 0.0), kind))
    best = Accuracy(coefficients, knobs, 0.0)
    best = replace(best, spread=spread(best))
    return Fit(best, compare(best, list(LADDERS_OF)), _unseen(cones, surveys))


def net_flip(row: Mapping[str, Any]) -> float:
    """FLIP of the picture without what the truth's own noise is worth: independent errors add as squares."""
    return math.sqrt(max(row["errors"]["FLIP"]["picture"] ** 2 - row["truth"]["noise"] ** 2, 0.0))


def _by_cones(row: Mapping[str, Any]) -> bool:
    """Whether any light is found by cones."""
    return any(row["resolved"][NAMES[knob]] == form for knob, form in FORMS.items())


def _settings(row: Mapping[str, Any]) -> Settings:
    """As measured; what no ladder moves and nobody gave counts as its default, which may since have changed."""
    counted = {NAMES[name] for name in (*REFERENCE, *row.get("settings", ()))}
    measured = row["resolved"].items()
    return Settings(**{k: v for k, v in measured if k in counted or row["quality"] != "balanced"})


@dataclass(frozen=True)
class _Sweep:
    """What was measured of a method.

    Attributes:
        points: FLIP by stage, width and settings. base: By stage, that at the reference.
        main: The width of most points. stages: Those that are looked at.
    """

    method: str
    points: Mapping[Any, float]
    base: Mapping[str, float]
    main: int
    stages: Sequence[str] = ()

    @classmethod
    def of(cls, method: str, rows: Sequence[Mapping[str, Any]]) -> _Sweep:
        """The rows of a method."""
        own = [r for r in rows if r["method"] == method]
        points = {(r["stage"], r["width"], _settings(r)): net_flip(r) for r in own}
        widths = [r["width"] for r in own]
        main = max(set(widths), key=widths.count) if widths else 0
        reference = make_settings("balanced", REFERENCE_OF[method])
        found = {stage: points.get((stage, main, reference), 0.0) for stage in dict.fromkeys(r["stage"] for r in own)}
        return cls(method, points, {stage: flip for stage, flip in found.items() if flip > LEAST}, main)

    def tables(self, surveys: Mapping[str, Survey]) -> dict[str, dict[str, list[list[float]]]]:
        """By class of scenes and knob."""
        knobs: dict[str, dict[str, list[list[float]]]] = {}
        ladders = [x.knob for x in LADDERS_OF[self.method] if x.knob not in (DETAIL, BOUNCES)]
        for knob in (*ladders, *FORMS) if CONES in ladders else ladders:
            classes = {stage: class_of(knob, surveys[stage], self.method) for stage in self.base}
            for kind in dict.fromkeys(classes.values()):
                sweep = replace(self, stages=[s for s in self.base if classes[s] == kind])
                if knob == STRIDE:
                    tables = sweep.by_detail()
                elif knob in FORMS:
                    tables = sweep.by_form(knob)
                else:
                    tables = {knob: sweep.excess(knob)}
                knobs.setdefault(kind, {}).update({k: t for k, t in tables.items() if len(t) > 1 or knob in FORMS})
        return knobs

    def by_form(self, name: str) -> dict[str, list[list[float]]]:
        """Of a setting that asks for cones; where these gather diffuse light, of their number."""
        field = NAMES[name]
        if name == "gather":
            found = self._found(CONES, {field, NAMES[CONES]}, None, (field, FORMS[name]))
            falling = _falling(np.array(list(found.values())))
            table = {CONES: [[v, round(float(e), 4)] for v, e in zip(found, falling, strict=True)]}
            return table if found else {}
        found = self._found(name, {field}, None, (field, FORMS[name]))
        return {form_table(name): [[1.0, round(e, 4)] for e in found.values()]} if found else {}

    def excess(self, knob: str) -> list[list[float]]:
        """``[value, excess]`` by rising value, falling from cheap to dear."""
        ladder = next(x for x in LADDERS_OF[self.method] if x.knob == knob)
        found = self._found(knob, {NAMES[name] for name in ladder.settings(ladder.values[0])}, None)
        order = -1 if ladder.values[0] > ladder.values[-1] else 1
        falling = _falling(np.array(list(found.values()))[::order])[::order]
        return [[v, round(float(e), 4)] for v, e in zip(found, falling, strict=True)]

    def by_detail(self) -> dict[str, list[list[float]]]:
        """For each detail a table of the strides, rising in them and not falling with a larger detail.

        Details that were swept at few strides differ from the reference's as interpolated between these; below strides
        of four nothing is gathered again, so that they do not differ.
        """
        moved = {NAMES[STRIDE], "gather_object_stride", NAMES[DETAIL]}
        swept = {detail: self._found(STRIDE, moved, detail) for detail in DETAILS}
        full = swept[REFERENCE[DETAIL]]
        tables: dict[str, list[list[float]]] = {}
        last = None
        for detail, found in swept.items():
            if not found or len(full) < 2:
                continue
            known = {2.0: 0.0, **{v: found[v] - full[v] for v in found if v in full}}
            strides = sorted(known)
            away = np.interp(np.log2(list(full)), np.log2(strides), [known[v] for v in strides])
            values = np.array(list(full.values())) + away
            values = values if last is None else np.minimum(values, last)
            last = _falling(values[::-1])[::-1]
            tables[stride_table(detail)] = [[v, round(float(e), 4)] for v, e in zip(full, last, strict=True)]
        return tables

    def _found(
        self, knob: str, moved: set[str], detail: float | None, given: tuple[str, str] | None = None
    ) -> dict[float, float]:
        """By rising value, the geometric mean over the stages of squared FLIP over the reference's, less one.

        Args:
            moved: Fields that may differ from the reference. detail: That points have. given: A field's value likewise.
        """
        reference = asdict(make_settings("balanced", REFERENCE_OF[self.method]))
        found: dict[float, list[float]] = {}
        for (stage, width, settings), flip in self.points.items():
            other = detail is not None and settings.gather_detail != detail
            other = other or (given is not None and getattr(settings, given[0]) != given[1])
            if stage not in self.stages or width != self.main or other:
                continue
            if {k for k, v in asdict(settings).items() if v != reference[k]} <= moved:
                value = 1.0 if knob in FORMS else float(getattr(settings, NAMES[knob]))
                found.setdefault(value, []).append(2.0 * math.log(max(flip, LEAST) / self.base[stage]))
        return {value: math.expm1(float(np.mean(found[value]))) for value in sorted(found)}


def _falling(values: np.ndarray) -> np.ndarray:
    """The nearest sequence that never rises (pool adjacent violators): a dearer value that errs more is noise."""
    blocks: list[list[float]] = []
    for value in values:
        blocks.append([float(value), 1.0])
        while len(blocks) > 1 and blocks[-2][0] < blocks[-1][0]:
            (a, n), (b, m) = blocks[-2:]
            blocks[-2:] = [[(a * n + b * m) / (n + m), n + m]]
    return np.concatenate([np.full(int(n), v) for v, n in blocks]) if blocks else values


def _constants(sweep: _Sweep, surveys: Mapping[str, Survey]) -> dict[str, float]:
    """Of a method of which few stages were measured: FLIP in proportion to what the objects change, by class."""
    found: dict[str, list[float]] = {}
    for stage, flip in sweep.base.items():
        left = math.log(flip) - sizes(surveys[stage])["shown"]
        found.setdefault(class_of("", surveys[stage], sweep.method), []).append(left)
    return {kind: float(np.mean(values)) for kind, values in found.items()} | {f"{sweep.method} shown": 1.0}


def _power_law(sweep: _Sweep, surveys: Mapping[str, Survey]) -> dict[str, float]:
    """Log FLIP = constants of the classes + powers of ``sizes`` + power * log(width / 320)."""
    base, points, main = sweep.base, sweep.points, sweep.main
    stages = list(base)
    columns = [[float(kind_of(surveys[s]) == k) for s in stages] for k in ("diffuse", "glossy")]
    columns += [[sizes(surveys[s])[name] for s in stages] for name in TYPICAL]
    matrix, values = np.array(columns).T, np.log([base[s] for s in stages])
    # The pull lets few stages decide no more than they can.
    pull = np.hstack([np.zeros((len(TYPICAL), 2)), np.eye(len(TYPICAL))])
    found = np.linalg.lstsq(np.vstack([matrix, pull]), np.append(values, list(TYPICAL.values())), rcond=None)[0]
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
        **dict(zip(TYPICAL, map(float, found[2:]), strict=True)),
        "width": slope,
    }


def _unseen(sweep: _Sweep, surveys: Mapping[str, Survey]) -> dict[str, tuple[float, float]]:
    """See ``Fit.unseen``; nothing of fewer than three stages."""
    found = {}
    for stage, flip in sweep.base.items() if len(sweep.base) > 2 else ():
        others = replace(sweep, base={s: f for s, f in sweep.base.items() if s != stage})
        found[stage] = flip, Accuracy(_power_law(others, surveys), {}, 0.0).reference(surveys[stage], sweep.main)
    return found


def _outlined(points: Mapping[Any, float], surveys: Mapping[str, Survey]) -> float:
    """FLIP of outlines of one point a pixel over ``Survey.outlined`` for each pixel of the width: the mean of stages in
    which nothing else errs; 0 where none was measured."""
    ratios = [
        flip * width / surveys[stage].outlined * (1.0 + settings.antialias) ** FLIP_POWER
        for (stage, width, settings), flip in points.items()
        if flip > LEAST and surveys[stage].outlined > 0.0
    ]
    return float(np.mean(ratios)) if ratios else 0.0


def _bounces(sweep: _Sweep, surveys: Mapping[str, Survey]) -> float:
    """Measured FLIP of missing bounces over what the survey says of them: the geometric mean of those points in which
    they are most of the error."""
    reference = asdict(make_settings("balanced", REFERENCE_OF[sweep.method]))
    ratios = []
    for (stage, width, settings), flip in sweep.points.items():
        alone = {k for k, v in asdict(settings).items() if v != reference[k]} == {NAMES[BOUNCES]}
        if (
            alone
            and width == sweep.main
            and settings.bounces > 0
            and flip > math.sqrt(2.0) * sweep.base.get(stage, 1.0)
        ):
            expected = surveys[stage].later * missing_bounces(settings.bounces, surveys[stage].decay)
            ratios.append(math.log(math.sqrt(flip**2 - sweep.base[stage] ** 2) / expected))
    return math.exp(float(np.mean(ratios))) if ratios else 1.0


def _name(method: str, settings: Settings) -> str:
    reference = asdict(make_settings("balanced", REFERENCE_OF[method]))
    changed = [f"{k}={v}" for k, v in asdict(settings).items() if v != reference[k]]
    return " ".join(changed) or "reference"


def write_table(table: Accuracy, file: Path) -> None:
    """Write a table as JSON."""
    content = {"base": {k: round(v, 4) for k, v in table.base.items()}, "spread": round(table.spread, 4)}
    text = json.dumps({**content, "knobs": table.knobs}, indent=1)
    write_text(file, text + "\n")

"""What settings were measured to cost in error: a table, knob by knob, of FLIP's square over that at a reference.

Squares of FLIP add up, for the knobs' errors are independent of each other in good approximation. The table
(``accuracy.json``) is fitted by ``bench error-table`` to the rows of ``bench tradeoff``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from warp_dvct.errors import FileError
from warp_dvct.settings import NAMES, Settings
from warp_dvct.survey import Survey

TABLE_FILE = Path(__file__).with_name("accuracy.json")
# The point that the table of errors is relative to.
REFERENCE = {
    "volume.resolution": 128,
    "volume.coarse": 64,
    "rsm.texels": 1024,
    "gather.rays": 64,
    "gather.object_rays": 64,
    "gather.stride": 8,
    "gather.object_stride": 4,
    "gather.detail": 0.25,
    "shadows.samples": 16,
    "shadows.probes": 8,
    "bounces": 8,
    "patches.count": 8192,
    "antialias": 4,
    "glossy.rays": 8,
}
CLOSED = 0.8  # share of gathered rays that meet a surface: above it a scene counts as a closed room
STRIDE, DETAIL, RAYS, VPLS = "gather.stride", "gather.detail", "gather.rays", "vpls.count"
DETAILS = (0.0, 0.5, 0.25, 0.125)
OBJECT_STRIDE = {16: 8, 12: 6, 8: 4, 6: 3, 4: 2, 2: 1, 1: 1}


@dataclass(frozen=True)
class Ladder:
    """Values of one knob from cheap to dear."""

    knob: str
    values: tuple[float, ...]

    def settings(self, value: float) -> dict[str, float]:
        """What a value sets."""
        if self.knob == RAYS:
            return {RAYS: value, "gather.object_rays": value}
        if self.knob == STRIDE:
            return {STRIDE: value, "gather.object_stride": OBJECT_STRIDE[int(value)]}
        if self.knob == "shadows.samples":
            return {"shadows.samples": value, "shadows.probes": value if value < 8 else value // 2}
        if self.knob == VPLS:
            return {VPLS: value, "vpls.sky": value}
        return {self.knob: value}


LADDERS = (
    Ladder("volume.resolution", (32, 64, 96, 128, 192, 256, 384, 512)),
    Ladder("volume.coarse", (32, 64, 96, 128, 192, 256)),
    Ladder("rsm.texels", (64, 128, 192, 256, 384, 512, 1024, 2048)),
    Ladder(RAYS, (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)),
    Ladder(STRIDE, (16, 12, 8, 6, 4, 2, 1)),
    Ladder(DETAIL, DETAILS),
    Ladder("shadows.samples", (1, 2, 4, 8, 16, 32, 64)),
    Ladder("bounces", (1, 2, 4, 6, 8, 12)),
    Ladder("patches.count", (256, 1024, 4096, 8192, 16384, 32768)),
    Ladder("antialias", (0, 2, 4, 8, 16)),
    Ladder("glossy.rays", (1, 2, 4, 8, 16, 32, 64, 128)),
)


# Shadows and edges stay as given: beside the pattern of the virtual lights their errors do not show.
VPL_LADDERS = (
    Ladder(VPLS, (64, 96, 128, 192, 256, 384, 512, 768, 1024, 1536, 2048)),
    Ladder("vpls.further", (32, 64, 96, 128, 192, 256, 384, 512)),
    Ladder("vpls.tiles", (8, 4, 2, 1)),
    Ladder("ism.size", (32, 64, 128, 256)),
    Ladder("ism.points", (256, 512, 1024, 2048, 4096)),
    Ladder("bounces", (1, 2, 4, 6, 8)),
)
LADDERS_OF = {"delta-cones": LADDERS, "instant-radiosity": VPL_LADDERS}
# By method, settings that the reference does not share with the preset ``balanced``.
REFERENCE_OF = {"delta-cones": REFERENCE, "instant-radiosity": {"bounces": 8}}
FILLED = {"delta-cones": RAYS, "instant-radiosity": VPLS}  # takes the rest of a budget, in steps of one


@dataclass(frozen=True)
class Accuracy:
    """What was measured of errors.

    Attributes:
        base: Coefficients of the logarithm of FLIP at the reference, see :meth:`reference`, and ``overlap``, the
            power by which improvements of several knobs together fall short of their product.
        knobs: By class of scene and knob: values, and by how much squared FLIP exceeds that of ``REFERENCE``, over it.
            Knobs of further bounces go by ``open`` and ``closed`` scenes, the others by
            ``diffuse`` and ``glossy`` ones. Strides have a table for each of ``DETAILS`` (:func:`stride_table`).
        spread: Standard deviation of the logarithm of measured over predicted FLIP.
    """

    base: dict[str, float]
    knobs: dict[str, dict[str, list[list[float]]]]
    spread: float

    def reference(self, survey: Survey, width: int, method: str = "delta-cones") -> float:
        """FLIP at the method's reference: by class, powers of the mean change of the picture and of its width."""
        size = max(survey.affected * survey.change, 1e-3)
        power = self.base["change"] * math.log(size) + self.base["width"] * math.log(width / 320.0)
        if method != "delta-cones":
            return math.exp(self.base[class_of("", survey, method)] + power)
        power += 0.0 if survey.met > CLOSED else self.base["open"]  # less of the light there is indirect
        return math.exp(self.base[kind_of(survey)] + power)

    def error(self, settings: Settings, survey: Survey, width: int, method: str = "delta-cones") -> float:
        """Mean LDR-FLIP of the picture against many bounces."""
        if not survey.changes:
            return 0.0
        found = [self.excess(ladder.knob, settings, survey, method) for ladder in LADDERS_OF[method]]
        return self.reference(survey, width, method) * math.sqrt(self.combined(found))

    def combined(self, excesses: Iterable[float]) -> float:
        """Squared FLIP over that at the reference, of settings whose knobs one by one exceed it by these."""
        factor, added = 1.0, 0.0
        for excess in excesses:
            # Independent errors add up; what improves takes a share off the reference's own, and these overlap.
            added += max(excess, 0.0)
            factor *= 1.0 + min(excess, 0.0)
        return factor ** self.base["overlap"] + added

    def excess(self, knob: str, settings: Settings, survey: Survey, method: str = "delta-cones") -> float:
        """Of squared FLIP over that at the reference, where only ``knob`` is as in ``settings``."""
        if knob == DETAIL or not matters(knob, survey):
            return 0.0  # the strides' tables are by detail
        tables = self.knobs.get(class_of(knob, survey, method), {})
        value = float(getattr(settings, NAMES[knob]))
        if knob == STRIDE:
            ranks = [detail_rank(detail) for detail in DETAILS]
            found = [_look_up(tables.get(stride_table(detail)), value) for detail in DETAILS]
            return float(np.interp(detail_rank(settings.gather_detail), ranks, found))
        table = tables.get(knob)
        if knob == FILLED[method] and table and value > table[-1][0]:
            # Noise goes as one over the rays, down to what other causes leave: here what the last two values point to.
            (v0, e0), (v1, e1) = table[-2:]
            limit = max(e1 - (e0 - e1) / (v1 / v0 - 1.0), -1.0)
            return limit + (e1 - limit) * v1 / value
        return _look_up(table, value)


def _look_up(table: list[list[float]] | None, value: float) -> float:
    if not table:
        return 0.0
    values, excess = np.array(table).T
    return float(np.interp(math.log2(value + 1.0), np.log2(values + 1.0), excess))


def stride_table(detail: float) -> str:
    """Name of the strides' table for a detail."""
    return f"{STRIDE} {DETAIL}={detail:g}"


def detail_rank(detail: float) -> float:
    """By how many halvings a detail is below 1, at which hardly anything is gathered again; 0 where nothing is."""
    return max(-math.log2(detail), 0.0) if detail > 0.0 else 0.0


@cache
def load_accuracy() -> Accuracy:
    """The package's table of measured errors.

    Raises:
        FileError: It is missing or broken.
    """
    try:
        data = json.loads(TABLE_FILE.read_text(encoding="utf-8"))
        return Accuracy(dict(data["base"]), dict(data["knobs"]), float(data["spread"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileError(f"{TABLE_FILE} is no table of errors ({error}); install the package again") from error


def class_of(knob: str, survey: Survey, method: str = "delta-cones") -> str:
    """The class of scenes whose table a knob's errors are in."""
    openness = "closed" if survey.met > CLOSED else "open"
    if method != "delta-cones":
        return f"{method} {openness}"
    return openness if knob in ("bounces", "patches.count") else kind_of(survey)


def kind_of(survey: Survey) -> str:
    """``diffuse``, or ``glossy`` where a lobe is traced by itself."""
    return "diffuse" if survey.roughness is None else "glossy"


def matters(knob: str, survey: Survey) -> bool:
    if knob == "glossy.rays":
        return survey.roughness is not None
    if knob == "shadows.samples":
        return survey.lights > 0
    return True

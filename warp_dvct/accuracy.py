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
from warp_dvct.pilot import ALL_BOUNCES, FLIP_POWER
from warp_dvct.settings import NAMES, Settings
from warp_dvct.survey import Survey

TABLE_FILE = Path(__file__).with_name("accuracy.json")
# The point that the table of errors is relative to.
REFERENCE = {
    "volume.resolution": 64,
    "volume.coarse": 64,
    "rsm.texels": 1024,
    "rsm.density": 2.0,
    "gather.rays": 64,
    "gather.object_rays": 64,
    "gather.stride": 8,
    "gather.object_stride": 4,
    "gather.detail": 0.15,
    "shadows.samples": 8,
    "shadows.probes": 8,
    "bounces": 8,
    "patches.count": 8192,
    "patches.rays": 64,
    "antialias": 8,
    "glossy.rays": 8,
}
CLOSED = 0.8  # share of gathered rays that meet a surface: above it a scene counts as a closed room
STRIDE, DETAIL, RAYS, VPLS = "gather.stride", "gather.detail", "gather.rays", "vpls.count"
DENSITY, CONES, BOUNCES = "rsm.density", "cones.count", "bounces"
OVERLAP = "overlap"
FORMS = {"gather": "cones", "shadows": "cone", "glossy": "cones"}  # settings that may ask for cones
FINE_SHARE = 0.25  # of what too few texels cost, that of the fine volume; the table's points leave 0 to 0.6 open
LEAST_DECAY = 0.05  # of light from bounce to bounce; less is not told from none
LEAST_NOISE = 1e-6  # of ``Survey.noise``: less is rounding
DETAILS = (0.0, 0.3, 0.15, 0.075)
FURTHER = ("patches.count", "patches.rays")  # knobs of the second and further bounces
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
            return {"shadows.samples": value, "shadows.probes": value if value <= 8 else value // 2}
        if self.knob == VPLS:
            return {VPLS: value, "vpls.sky": value}
        return {self.knob: value}


LADDERS = (
    Ladder("volume.resolution", (32, 48, 64, 96, 128, 192, 256, 384, 512)),
    Ladder("volume.coarse", (32, 64, 96, 128, 192, 256)),
    Ladder(DENSITY, (0.5, 1, 1.5, 2, 3, 4)),
    Ladder(RAYS, (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)),
    Ladder(STRIDE, (16, 12, 8, 6, 4, 2, 1)),
    Ladder(DETAIL, DETAILS),
    Ladder("shadows.samples", (1, 2, 4, 8, 16, 32, 64)),
    Ladder("bounces", (1, 2, 4, 6, 8, 12)),
    Ladder("patches.count", (256, 512, 1024, 4096, 8192, 16384, 32768)),
    Ladder("patches.rays", (16, 32, 64, 128)),
    Ladder("antialias", (0, 2, 4, 8, 16)),
    Ladder("glossy.rays", (1, 2, 4, 8, 16, 32, 64, 128)),
    Ladder(CONES, (4, 6, 9, 16, 25, 36)),
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
        base: Coefficients of the logarithm of FLIP at the reference, see :meth:`reference`; ``diffuse overlap`` and
            ``glossy overlap``, the powers by which improvements of several knobs together fall short of their product;
            ``bounces``, FLIP of missing bounces over ``Survey.later``; ``outlined``, FLIP of the objects' outlines, of
            one point a pixel, over ``Survey.outlined`` for each pixel of the width.
        knobs: By class of scene and knob: values, and by how much squared FLIP exceeds that of ``REFERENCE``, over it.
            Knobs of patches go by ``open`` and ``closed`` scenes, the others by ``diffuse`` and ``glossy`` ones.
            Strides have a table for each of ``DETAILS`` (:func:`stride_table`); forms that ask for cones one of a
            single value (:func:`form_table`), or, where diffuse light is gathered, of the number of cones.
        spread: Standard deviation of the logarithm of measured over predicted FLIP.
    """

    base: dict[str, float]
    knobs: dict[str, dict[str, list[list[float]]]]
    spread: float

    def reference(self, survey: Survey, width: int, method: str = "delta-cones") -> float:
        """FLIP at the method's reference, outlines left aside: by class, powers of :func:`sizes` and of the width."""
        power = self.base["width"] * math.log(width / 320.0)
        prefix = "" if method == "delta-cones" else f"{method} "
        power += sum(self.base.get(prefix + name, 0.0) * size for name, size in sizes(survey).items())
        return math.exp(self.base[class_of("", survey, method)] + power)

    def outlines(self, settings: Settings, survey: Survey, width: int) -> float:
        """FLIP of the objects' outlines, whose pixels are off by a part of the step that is there: one over the points
        that such a pixel gets, in FLIP's power of it."""
        return self.base["outlined"] * survey.outlined / width * (1.0 + settings.antialias) ** -FLIP_POWER

    def error(self, settings: Settings, survey: Survey, width: int, method: str = "delta-cones") -> float:
        """Mean LDR-FLIP of the picture against many bounces."""
        if not survey.changes:
            return 0.0
        found = [self.excess(ladder.knob, settings, survey, method) for ladder in LADDERS_OF[method]]
        found += self.forms(settings, survey, method)
        square = self.reference(survey, width, method) ** 2 * self.combined(found, survey)
        return math.sqrt(square + self.outlines(settings, survey, width) ** 2)

    def combined(self, excesses: Iterable[float], survey: Survey) -> float:
        """Squared FLIP over that at the reference, of settings whose knobs one by one exceed it by these."""
        factor, added = 1.0, 0.0
        for excess in excesses:
            # Independent errors add up; what improves takes a share off the reference's own, and these overlap.
            added += max(excess, 0.0)
            factor *= 1.0 + min(excess, 0.0)
        return factor ** self.base[f"{kind_of(survey)} {OVERLAP}"] + added

    def excess(self, knob: str, settings: Settings, survey: Survey, method: str = "delta-cones") -> float:
        """Of squared FLIP over that at the reference, where only ``knob`` is as in ``settings``."""
        if knob == DETAIL or not (matters(knob, survey, settings) and works(knob, settings)):
            return 0.0  # the strides' tables are by detail
        tables = self.knobs.get(class_of(knob, survey, method), {})
        value = float(getattr(settings, NAMES[knob]))
        table = tables.get(knob)
        if knob == BOUNCES:
            missing = self.base.get("bounces", 0.0) * survey.later * missing_bounces(settings.bounces, survey.decay)
            return (missing / self.reference(survey, 320, method)) ** 2
        if knob == STRIDE:
            return _strides(tables, settings)
        if knob == DENSITY:
            return _densities(table, settings, survey)
        if knob == FILLED[method] and table and value > table[-1][0]:
            # Noise goes as one over the rays, down to what other causes leave: here what the last two values point to.
            (v0, e0), (v1, e1) = table[-2:]
            limit = max(e1 - (e0 - e1) / (v1 / v0 - 1.0), -1.0)
            return limit + (e1 - limit) * v1 / value
        return _look_up(table, value)

    def forms(self, settings: Settings, survey: Survey, method: str = "delta-cones") -> list[float]:
        """Excesses of shadows and reflections that are asked for by cones."""
        if method != "delta-cones":
            return []
        tables = self.knobs.get(kind_of(survey), {})
        asked = [name for name in ("shadows", "glossy") if getattr(settings, name) == FORMS[name]]
        return [_look_up(tables.get(form_table(name)), 1.0) for name in asked]


def _strides(tables: dict[str, list[list[float]]], settings: Settings) -> float:
    """Of the strides with the detail that is asked for; cones halve none."""
    ranks = [detail_rank(detail) for detail in DETAILS]

    def excess(stride: float, detail: float) -> float:
        found = [_look_up(tables.get(stride_table(d)), stride) for d in DETAILS]
        return float(np.interp(detail_rank(detail), ranks, found))

    stride = float(settings.gather_stride)
    if settings.gather == FORMS["gather"]:
        return excess(stride, 0.0) - excess(float(REFERENCE[STRIDE]), 0.0)  # the rest is in the cones' own table
    return excess(stride, settings.gather_detail)


def _densities(table: list[list[float]] | None, settings: Settings, survey: Survey) -> float:
    """Of the texels that a voxel gets: fewer than asked for where ``rsm.texels`` limits a map."""
    found = []
    for need in survey.maps:
        edges = [(FINE_SHARE, need.fine * settings.volume_resolution)]
        if need.coarse > 0.0 and settings.volume_coarse > 0:
            edges.append((1.0 - FINE_SHARE, need.coarse * settings.volume_coarse))
        total = sum(share for share, _ in edges)
        for share, voxels in edges:
            density = min(settings.rsm_density, settings.rsm_texels / max(voxels, 1e-6))
            found.append(share / total / len(survey.maps) * _look_up(table, density))
    return sum(found)


def missing_bounces(bounces: int, decay: float) -> float:
    """FLIP of the light of further bounces than these, up to ``ALL_BOUNCES``, over that of all but the first: the rest
    of a geometric series, in FLIP's power of it."""
    ratio = min(max(decay, LEAST_DECAY), 0.999)
    last = ratio ** (ALL_BOUNCES - 1)
    return (max(ratio ** (bounces - 1) - last, 0.0) / (1.0 - last)) ** FLIP_POWER


def _look_up(table: list[list[float]] | None, value: float) -> float:
    if not table:
        return 0.0
    values, excess = np.array(table).T
    return float(np.interp(math.log2(value + 1.0), np.log2(values + 1.0), excess))


def stride_table(detail: float) -> str:
    """Name of the strides' table for a detail."""
    return f"{STRIDE} {DETAIL}={detail:g}"


def form_table(name: str) -> str:
    """Name of the table of what is asked for by cones."""
    return f"{name}={FORMS[name]}"


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


def sizes(survey: Survey) -> dict[str, float]:
    """Logarithms of what the error at the reference goes by, see ``Accuracy.reference``."""
    least = {"noise": LEAST_NOISE, "shown": 1e-4, "change": 1e-2}
    return {name: math.log(max(getattr(survey, name), value)) for name, value in least.items()}


def class_of(knob: str, survey: Survey, method: str = "delta-cones") -> str:
    """The class of scenes whose table a knob's errors are in."""
    openness = "closed" if survey.met > CLOSED else "open"
    if method != "delta-cones":
        return f"{method} {openness}"
    return openness if knob in FURTHER else kind_of(survey)


def kind_of(survey: Survey) -> str:
    """``diffuse``, or ``glossy`` where a lobe is traced by itself."""
    return "diffuse" if survey.roughness is None else "glossy"


def matters(knob: str, survey: Survey, settings: Settings) -> bool:
    """Whether a knob does anything in a scene, and for rays or cones as they are asked for."""
    if knob in (RAYS, DETAIL):
        return settings.gather == "rays"
    if knob == CONES:
        return settings.gather == FORMS["gather"]
    if knob == "glossy.rays":
        return survey.roughness is not None and settings.glossy == "rays"
    if knob == "shadows.samples":
        return survey.lights > 0
    return True


def works(knob: str, settings: Settings) -> bool:
    """Whether a knob that matters does anything just now: without further bounces no patch carries light."""
    return settings.bounces > 1 or knob not in FURTHER

"""Choosing settings for a time or an error: ``warp-dvct relight --budget SECONDS`` and ``--max-error FLIP``.

The time of a choice is predicted by the cost model (:mod:`warp_dvct.cost`), its error by a table of what each knob was
measured to cost, knob by knob: squares of FLIP add up, for the knobs' errors are independent of each other in good
approximation. Starting from the cheapest choice, the step that takes off the most squared error for its time is taken,
again and again, until the time is used up or the error is reached.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.cost import CostModel, count_work
from warp_dvct.errors import FileError, OptionError
from warp_dvct.settings import NAMES, Settings, make_settings
from warp_dvct.survey import Survey

TABLE_FILE = Path(__file__).with_name("accuracy.json")
AIM = 0.95  # of the budget: the model's own spread is then inside of it
VOXELS_PER_FEATURE = 2.0  # across the smallest extent of an object, for its light not to pass through it
# The point that the table of errors is relative to, and settings that a budget leaves alone: how many points a stride
# that is halved here and there adds is not known beforehand.
REFERENCE = {
    "volume.resolution": 128,
    "volume.coarse": 128,
    "rsm.texels": 1024,
    "gather.rays": 64,
    "gather.object_rays": 64,
    "gather.stride": 6,
    "gather.object_stride": 3,
    "gather.detail": 0.0,
    "shadows.samples": 16,
    "shadows.probes": 8,
    "bounces": 8,
    "patches.count": 8192,
    "antialias": 4,
    "glossy.rays": 8,
}
MOST_RAYS = 65536
CLOSED = 0.8  # share of gathered rays that meet a surface: above it a scene counts as a closed room
OBJECT_STRIDE = {16: 8, 12: 6, 8: 4, 6: 3, 4: 2, 2: 1, 1: 1}


@dataclass(frozen=True)
class Ladder:
    """Values of one knob from cheap to dear; ``also`` gives what moves with it."""

    knob: str
    values: tuple[int, ...]

    def settings(self, value: int) -> dict[str, int]:
        """What a value sets."""
        if self.knob == "gather.rays":
            return {"gather.rays": value, "gather.object_rays": value}
        if self.knob == "gather.stride":
            return {"gather.stride": value, "gather.object_stride": OBJECT_STRIDE[value]}
        if self.knob == "shadows.samples":
            return {"shadows.samples": value, "shadows.probes": value if value < 8 else value // 2}
        return {self.knob: value}


LADDERS = (
    Ladder("volume.resolution", (32, 64, 96, 128, 192, 256, 384, 512)),
    Ladder("volume.coarse", (32, 64, 96, 128, 192, 256)),
    Ladder("rsm.texels", (64, 128, 192, 256, 384, 512, 1024, 2048)),
    Ladder("gather.rays", (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)),
    Ladder("gather.stride", (12, 8, 6, 4, 2, 1)),
    Ladder("shadows.samples", (1, 2, 4, 8, 16, 32, 64)),
    Ladder("bounces", (1, 2, 4, 6, 8, 12)),
    Ladder("patches.count", (256, 1024, 4096, 8192, 16384, 32768)),
    Ladder("antialias", (0, 2, 4, 8, 16)),
    Ladder("glossy.rays", (1, 2, 4, 8, 16, 32, 64, 128)),
)


@dataclass(frozen=True)
class Accuracy:
    """What was measured of errors.

    Attributes:
        base: Coefficients of the logarithm of FLIP at ``REFERENCE``, see :meth:`reference`, and ``overlap``, the
            power by which improvements of several knobs together fall short of their product.
        knobs: By class of scene and knob: values, and by how much squared FLIP exceeds that of ``REFERENCE``, over it.
            Knobs of further bounces go by ``open`` and ``closed`` scenes, the others by
            ``diffuse`` and ``glossy`` ones.
        spread: Standard deviation of the logarithm of measured over predicted FLIP.
    """

    base: dict[str, float]
    knobs: dict[str, dict[str, list[list[float]]]]
    spread: float

    def reference(self, survey: Survey, width: int) -> float:
        """FLIP at ``REFERENCE``: by class, powers of the mean change of the picture and of its width."""
        size = max(survey.affected * survey.change, 1e-3)
        power = self.base["width"] * math.log(width / 320.0)
        power += 0.0 if survey.met > CLOSED else self.base["open"]  # less of the light there is indirect
        return math.exp(self.base[kind_of(survey)] + self.base["change"] * math.log(size) + power)

    def error(self, settings: Settings, survey: Survey, width: int) -> float:
        """Mean LDR-FLIP of the picture against many bounces."""
        if not survey.changes:
            return 0.0
        factor, added = 1.0, 0.0
        for ladder in LADDERS:
            excess = self.excess(ladder.knob, getattr(settings, NAMES[ladder.knob]), survey)
            # Independent errors add up; what improves takes a share off what the others left, and these overlap.
            added += max(excess, 0.0)
            factor *= 1.0 + min(excess, 0.0)
        return self.reference(survey, width) * math.sqrt(factor ** self.base["overlap"] * (1.0 + added))

    def excess(self, knob: str, value: float, survey: Survey) -> float:
        """Of squared FLIP over that at ``REFERENCE``, where only ``knob`` is at ``value``."""
        if not _matters(knob, survey):
            return 0.0
        table = self.knobs.get(class_of(knob, survey), {}).get(knob)
        if not table:
            return 0.0
        values, excess = np.array(table).T
        if knob == "gather.rays" and value > values[-1]:
            # Noise goes as one over the rays, down to what other causes leave: here what the last two values point to.
            limit = excess[-1] - (excess[-2] - excess[-1]) / (values[-1] / values[-2] - 1.0)
            return float(limit + (excess[-1] - limit) * values[-1] / value)
        return float(np.interp(math.log2(value + 1.0), np.log2(values + 1.0), excess))


@dataclass(frozen=True)
class Choice:
    """Settings chosen for a budget.

    Attributes:
        settings: All of them. seconds, cpu_seconds: Predicted, of the clock and of all threads, the survey included.
        error: Predicted mean LDR-FLIP of the picture.
        floor: Seconds of the cheapest choice. fixed: Settings that the user gave.
        reasons: Lines for people: what was chosen, what was left out and why.
    """

    settings: Settings
    seconds: float
    cpu_seconds: float
    error: float
    floor: float
    fixed: tuple[str, ...]
    reasons: tuple[str, ...]

    def describe(self) -> str:
        """Some lines for a terminal."""
        error = "its noise is not predicted" if math.isnan(self.error) else f"FLIP {self.error:.4f}"
        head = f"predicted: {self.seconds:.2f} s ({self.cpu_seconds:.2f} s of processor time), {error}"
        return "\n".join([head, *(f"  {line}" for line in self.reasons)])

    def to_dict(self) -> dict[str, Any]:
        """For statistics."""
        chosen = {name: getattr(self.settings, NAMES[name]) for ladder in LADDERS for name in ladder.settings(1)}
        return {
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "error": None if math.isnan(self.error) else self.error,
            "floor": self.floor,
            "chosen": chosen,
            "reasons": list(self.reasons),
        }


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


def choose(
    survey: Survey,
    model: CostModel,
    *,
    width: int,
    height: int,
    threads: int,
    seconds: float | None = None,
    max_error: float | None = None,
    fixed: Mapping[str, Any] | None = None,
) -> Choice:
    """The best settings that keep a time, or the cheapest that keep an error.

    Args:
        seconds: For one frame from scratch, without loading and compiling.
        max_error: Mean LDR-FLIP over the picture, against a truth of many bounces.
        fixed: Settings that the user gave by dotted name; they are not chosen.
    Raises:
        OptionError: Neither or both are given; a budget below the floor; an error that no choice reaches.
    """
    check_request(seconds, max_error)
    return _Chooser(survey, model, load_accuracy(), width, height, threads, dict(fixed or {})).choose(
        seconds, max_error
    )


def check_request(seconds: float | None, max_error: float | None) -> None:
    """Refuse what is no budget.

    Raises:
        OptionError: Neither or both are given, or one is not a positive number.
    """
    if (seconds is None) == (max_error is None):
        raise OptionError("give a budget in seconds or a largest error, and not both")
    for name, value in (("--budget", seconds), ("--max-error", max_error)):
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise OptionError(f"{name} is {value}; give a positive number")


class _Chooser:
    """The search; its state is an index into each ladder."""

    def __init__(
        self,
        survey: Survey,
        model: CostModel,
        accuracy: Accuracy,
        width: int,
        height: int,
        threads: int,
        fixed: dict[str, Any],
    ) -> None:
        self.survey, self.model, self.accuracy = survey, model, accuracy
        self.width, self.height, self.threads, self.fixed = width, height, threads, fixed
        self.base = make_settings("balanced", {"gather.detail": REFERENCE["gather.detail"], **fixed})
        self.required = math.ceil(VOXELS_PER_FEATURE / survey.feature) if survey.feature > 0.0 else 0
        self.ladders = [
            self._required(x)
            for x in LADDERS
            if _matters(x.knob, survey) and not any(k in fixed for k in x.settings(x.values[0]))
        ]
        self.planning = {"survey": {"frame": 1.0, "triangles": survey.triangles * 1e-6}}

    def _required(self, ladder: Ladder) -> Ladder:
        """Without voxels that are too large for the objects: no error that the table knows shows that."""
        if ladder.knob != "volume.resolution":
            return ladder
        enough = tuple(v for v in ladder.values if v >= self.required)
        return replace(ladder, values=enough or ladder.values[-1:])

    def settings(self, state: Mapping[str, int]) -> Settings:
        """Of a state, over what is fixed."""
        made: dict[str, Any] = {}
        for ladder in self.ladders:
            made.update(ladder.settings(state[ladder.knob]))
        return replace(self.base, **{NAMES[name]: value for name, value in made.items()})

    def seconds(self, settings: Settings) -> float:
        """Of the clock, the survey included."""
        work = count_work(settings, self.survey, self.width, self.height) | self.planning
        return self.model.seconds(work, self.threads)

    def square(self, settings: Settings) -> float:
        """Predicted squared FLIP."""
        return self.accuracy.error(settings, self.survey, self.width) ** 2

    def choose(self, budget: float | None, max_error: float | None) -> Choice:
        state = {ladder.knob: ladder.values[0] for ladder in self.ladders}
        floor = self.seconds(self.settings(state))
        if budget is not None and budget < floor:
            raise OptionError(
                f"--budget {budget:g} s is below the floor: the cheapest picture of this scene at {self.width} x"
                f" {self.height} takes about {floor:.2f} s on {self.threads} thread(s); raise it or lower --imageWidth"
            )
        aim = math.inf if budget is None else max(AIM * budget, floor)
        state, stopped = self._climb(state, aim, max_error)
        if max_error is not None and math.sqrt(self.square(self.settings(state))) > max_error:
            least = math.sqrt(self.square(self.settings(state)))
            raise OptionError(
                f"--max-error {max_error:g} is below what delta-cones reaches here, about {least:.4f};"
                " --method path-trace has no such limit"
            )
        if budget is not None:
            state, stopped = self._fill(state, aim, stopped)
        return self._choice(state, floor, stopped)

    def _climb(self, state: dict[str, int], aim: float, max_error: float | None) -> tuple[dict[str, int], str]:
        """Take steps while they fit; returns the state and why it ended."""
        state = dict(state)
        while True:
            settings = self.settings(state)
            time, square = self.seconds(settings), self.square(settings)
            if max_error is not None and square <= max_error**2:
                return state, "the error is reached"
            best, gain, full = None, 0.0, False
            for ladder in self.ladders:
                for value in ladder.values[ladder.values.index(state[ladder.knob]) + 1 :]:
                    candidate = {**state, ladder.knob: value}
                    made = self.settings(candidate)
                    more, less = self.seconds(made) - time, square - self.square(made)
                    if less <= 1e-4 * square:
                        continue
                    if time + more > aim:
                        full = True
                        break
                    if less / max(more, 1e-6) > gain:
                        best, gain = candidate, less / max(more, 1e-6)
            if best is None:
                return state, "the time is used up" if full else "nothing more that the table knows would help"
            state = best

    def _fill(self, state: dict[str, int], aim: float, stopped: str) -> tuple[dict[str, int], str]:
        """What is left of the time goes into gathered rays, which never harm."""
        if "gather.rays" not in state:
            return state, stopped
        low, high = state["gather.rays"], MOST_RAYS
        while low < high:
            middle = (low + high + 1) // 2
            if self.seconds(self.settings({**state, "gather.rays": middle})) <= aim:
                low = middle
            else:
                high = middle - 1
        return {**state, "gather.rays": low}, stopped

    def _choice(self, state: Mapping[str, int], floor: float, stopped: str) -> Choice:
        settings = self.settings(state)
        work = count_work(settings, self.survey, self.width, self.height) | self.planning
        error = self.accuracy.error(settings, self.survey, self.width)
        return Choice(
            settings,
            self.model.seconds(work, self.threads),
            self.model.cpu_seconds(work),
            error,
            floor,
            tuple(sorted(self.fixed)),
            tuple(self._reasons(state, settings, stopped)),
        )

    def _reasons(self, state: Mapping[str, int], settings: Settings, stopped: str) -> list[str]:
        survey = self.survey
        square = self.square(settings)
        lines = [
            f"the objects cover {survey.object:.0%} of the picture and change {survey.affected:.0%} of it;"
            f" {survey.lights} light(s){' and a dome' if survey.dome else ''}; ended because {stopped}"
        ]
        for ladder in self.ladders:
            value = state[ladder.knob]
            bought = self.settings({**state, ladder.knob: ladder.values[0]})
            share = max(0.0, self.square(bought) / max(square, 1e-12) - 1.0)
            saved = self.seconds(settings) - self.seconds(bought)
            shown = " ".join(f"{k}={v}" for k, v in ladder.settings(value).items())
            lines.append(
                f"{shown}: "
                + (f"takes {saved:.2f} s, without it squared error {share:+.0%}" if saved > 1e-4 else "the least")
            )
        lines += [f"{name}={value}: given" for name, value in sorted(self.fixed.items())]
        left = [knob for knob in (x.knob for x in LADDERS) if not _matters(knob, survey)]
        lines += [f"left out: {knob}, {_WHY[knob]}" for knob in left if knob in _WHY]
        if survey.roughness is not None:
            lines.append(
                f"the smoothest lobe has roughness {survey.roughness:.2f}: narrower than gathered light, traced apart"
            )
        if settings.volume_resolution < self.required:
            lines.append(
                f"the smallest object extends {survey.feature * settings.volume_resolution:.1f} voxels where"
                f" {VOXELS_PER_FEATURE:g} are needed: light leaks through it; --set volume.resolution={self.required}"
            )
        if self.model.shipped:
            lines.append("the times are those of another machine: `warp-dvct calibrate` measures this one's")
        return lines


_WHY = {
    "glossy.rays": "no material has a lobe smoother than glossy.roughness",
    "shadows.samples": "there is no light but the dome, whose shadows are gathered",
}


def class_of(knob: str, survey: Survey) -> str:
    """The class of scenes whose table a knob's errors are in."""
    if knob in ("bounces", "patches.count"):
        return "closed" if survey.met > CLOSED else "open"
    return kind_of(survey)


def kind_of(survey: Survey) -> str:
    """``diffuse``, or ``glossy`` where a lobe is traced by itself."""
    return "diffuse" if survey.roughness is None else "glossy"


def _matters(knob: str, survey: Survey) -> bool:
    if knob == "glossy.rays":
        return survey.roughness is not None
    if knob == "shadows.samples":
        return survey.lights > 0
    return True

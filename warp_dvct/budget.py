"""Choosing settings for a time or an error: ``warp-dvct relight --budget SECONDS`` and ``--max-error FLIP``.

The time of a choice is predicted by the cost model (:mod:`warp_dvct.cost_model`), its error by a table of what each
knob was measured to cost (:mod:`warp_dvct.accuracy`). Starting from the cheapest choice, and from the dearest preset
that fits, the step that takes off the most squared error for its time is taken, again and again, until the time is used
up or the error is reached.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from warp_dvct.accuracy import (
    BOUNCES,
    DENSITY,
    DETAIL,
    FILLED,
    FURTHER,
    LADDERS_OF,
    RAYS,
    STRIDE,
    Accuracy,
    Ladder,
    detail_rank,
    load_accuracy,
    matters,
)
from warp_dvct.cost import CHOOSING, count_survey, count_work
from warp_dvct.cost_model import CostModel, Counts, price
from warp_dvct.cost_vpls import count_vpl_work
from warp_dvct.errors import OptionError
from warp_dvct.pace import Pace
from warp_dvct.passes.gather import FINEST
from warp_dvct.sample_pace import SamplePace, SettledSamples
from warp_dvct.settings import NAMES, QUALITIES, Settings, make_settings
from warp_dvct.survey import Survey
from warp_dvct.turns import RAYS_SET

AIM = 0.95  # of the budget, for the settings' prediction; what is left when rays are settled goes into them
VOXELS_PER_FEATURE = 2.0  # across the smallest extent of an object, for its light not to pass through it
AHEAD = 3  # values of a ladder that a step may take at once: the next one alone may gain nothing
NEARLY = 0.9  # of what is aimed at: a choice that takes less has nothing more to gain
SHOWS = 0.005  # of an error: what doubling the rays has to take off it to be worth their time
# What the errors of a knob's values depend on besides.
BESIDES = {
    STRIDE: (DETAIL,),
    DENSITY: ("volume.resolution", "volume.coarse", "rsm.texels"),
    **dict.fromkeys(FURTHER, (BOUNCES,)),
}
MOST = {"gather.rays": 65536, "vpls.count": 4096}


@dataclass(frozen=True)
class Choice:
    """Settings chosen for a budget.

    Attributes:
        settings: All of them. seconds, cpu_seconds: Predicted, of the clock and of all threads, the survey included.
        error: Predicted mean LDR-FLIP of the picture.
        floor: Seconds of the cheapest choice. fixed: Settings that the user gave.
        reasons: Lines for people: what was chosen, what was left out and why.
        enough: Whether more time would buy nothing that shows, so that some of the budget is left.
        pace: Settles the rays or samples of the first frame by the time that is left; None where they are not for it to
            say.
    """

    method: str
    settings: Settings
    seconds: float
    cpu_seconds: float
    error: float
    floor: float
    fixed: tuple[str, ...]
    reasons: tuple[str, ...]
    enough: bool = False
    pace: Pace | SamplePace | None = field(default=None, compare=False)

    def describe(self) -> str:
        """Some lines for a terminal."""
        error = "its noise is not predicted" if math.isnan(self.error) else f"FLIP {self.error:.4f}"
        head = f"predicted: {self.seconds:.2f} s ({self.cpu_seconds:.2f} s of processor time), {error}"
        lines = [head, *(f"  {line}" for line in self.reasons)]
        if self.pace is not None:
            what, how = ("samples", "traced") if self.method == "path-trace" else ("gather.rays", "gathered")
            lines.append(f"  {what} is settled while the frame is {how}, again and again, by the time that is left")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """For statistics."""
        ladders = LADDERS_OF.get(self.method, ())
        chosen = {name: getattr(self.settings, NAMES[name]) for ladder in ladders for name in ladder.settings(1)}
        if self.method == "path-trace":
            chosen = {"samples": self.settings.samples}
        settled = self.pace.settled if self.pace is not None else None
        if isinstance(settled, SettledSamples):
            chosen["samples"] = settled.samples
        elif settled is not None:
            chosen |= {name: settled.rays for name in RAYS_SET}
        return {
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "error": None if math.isnan(self.error) else self.error,
            "floor": self.floor,
            "enough": self.enough,
            "chosen": chosen,
            "settled": None if settled is None else asdict(settled),
            "reasons": list(self.reasons),
        }


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
    method: str = "delta-cones",
    slowness: float = 1.0,
) -> Choice:
    """The best settings that keep a time, or the cheapest that keep an error.

    Args:
        seconds: For one frame from scratch, without loading and compiling.
        max_error: Mean LDR-FLIP over the picture, against a truth of many bounces.
        fixed: Settings that the user gave by dotted name; they are not chosen.
        method: ``delta-cones`` or ``instant-radiosity``.
        slowness: By how much longer than the model says everything takes just now.
    Raises:
        OptionError: Neither or both are given; a budget below the floor, however slow the machine is just now; an error
            that no choice reaches.
    """
    check_request(seconds, max_error)
    chooser = _Chooser(method, survey, model, load_accuracy(), width, height, threads, dict(fixed or {}), slowness)
    return chooser.choose(seconds, max_error)


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
        method: str,
        survey: Survey,
        model: CostModel,
        accuracy: Accuracy,
        width: int,
        height: int,
        threads: int,
        fixed: dict[str, Any],
        slowness: float,
    ) -> None:
        self.method, self.survey, self.model, self.accuracy = method, survey, model, accuracy
        self.slowness = slowness
        self.width, self.height, self.threads, self.fixed = width, height, threads, fixed
        self.base = make_settings("balanced", fixed, method)
        self.required = math.ceil(VOXELS_PER_FEATURE / survey.feature) if survey.feature > 0.0 else 0
        self.ladders = [
            self._required(x)
            for x in LADDERS_OF[method]
            if matters(x.knob, survey, self.base) and not any(k in fixed for k in x.settings(x.values[0]))
        ]
        self.planning = {"survey": count_survey(survey), CHOOSING: {"frame": 1.0}}
        units = model.clock_units(threads)
        self.prices = {name: {unit: slowness * cost for unit, cost in costs.items()} for name, costs in units.items()}
        self.reference = accuracy.reference(survey, width, method) if survey.changes else 0.0
        self.forms = accuracy.forms(self.base, survey, method)
        self.excesses: dict[tuple[Any, ...], float] = {}

    def _required(self, ladder: Ladder) -> Ladder:
        """Without voxels that are too large for the objects: no error that the table knows shows that."""
        if ladder.knob != "volume.resolution":
            return ladder
        enough = tuple(v for v in ladder.values if v >= self.required)
        return replace(ladder, values=enough or ladder.values[-1:])

    def settings(self, state: Mapping[str, float]) -> Settings:
        """Of a state, over what is fixed."""
        made: dict[str, Any] = {}
        for ladder in self.ladders:
            made.update(ladder.settings(state[ladder.knob]))
        return replace(self.base, **{NAMES[name]: value for name, value in made.items()})

    def seconds(self, settings: Settings) -> float:
        """Of the clock, the survey included."""
        return price(self.work(settings), self.prices)

    def work(self, settings: Settings) -> dict[str, Counts]:
        """What a frame and its planning take."""
        count = count_work if self.method == "delta-cones" else count_vpl_work
        return count(settings, self.survey, self.width, self.height) | self.planning

    def square(self, settings: Settings) -> float:
        """Predicted squared FLIP, as ``Accuracy.error``: a search asks for each value of a knob a hundred times."""
        if not self.survey.changes:
            return 0.0
        found = (self.excess(ladder.knob, settings) for ladder in LADDERS_OF[self.method])
        outlines = self.accuracy.outlines(settings, self.survey, self.width)
        return self.reference**2 * self.accuracy.combined((*found, *self.forms), self.survey) + outlines**2

    def excess(self, knob: str, settings: Settings) -> float:
        """As ``Accuracy.excess``, looked up once."""
        key = knob, *(getattr(settings, NAMES[name]) for name in (knob, *BESIDES.get(knob, ())))
        if key not in self.excesses:
            self.excesses[key] = self.accuracy.excess(knob, settings, self.survey, self.method)
        return self.excesses[key]

    def choose(self, budget: float | None, max_error: float | None) -> Choice:
        state = {ladder.knob: ladder.values[0] for ladder in self.ladders}
        slow_floor = self.seconds(self.settings(state))
        floor = slow_floor / self.slowness
        if budget is not None and budget < floor:
            raise OptionError(
                f"--budget {budget:g} s is below the floor: the cheapest picture of this scene at {self.width} x"
                f" {self.height} takes about {floor:.2f} s on {self.threads} thread(s); raise it or lower --imageWidth"
            )
        aim = math.inf if budget is None else max(AIM * budget, slow_floor)
        ends = [self._climb(start, aim, max_error) for start in (state, *self._presets(aim))]
        state, _, stopped = min(ends, key=lambda end: self.square(self.settings(end[0])))
        if max_error is not None and math.sqrt(self.square(self.settings(state))) > max_error:
            least = math.sqrt(self.square(self.settings(state)))
            raise OptionError(
                f"--max-error {max_error:g} is below what {self.method} reaches here, about {least:.4f};"
                " --method path-trace has no such limit"
            )
        enough = False
        if max_error is not None:
            state = self._cheapest([state for end in ends for state in end[:2]], max_error)
        pace = None
        if budget is not None:
            filled = [self._fill(end[0], aim) for end in ends]
            state, enough = min(filled, key=lambda end: self.square(self.settings(end[0])))
            stopped = "more would not show" if enough else "the time is used up"
            pace = self._pace(state, budget, enough=enough)
        return replace(self._choice(state, floor, stopped, enough=enough), pace=pace)

    def _presets(self, aim: float) -> list[dict[str, float]]:
        """The dearest preset that fits, for the search to end no worse: steps are never taken back, and what was worth
        its time early on may not be in the end. Values that no ladder has are rounded to the cheaper side."""
        fit = []
        for quality in QUALITIES:
            wanted = make_settings(quality, self.fixed, self.method)
            state = {}
            for ladder in self.ladders:
                value = float(getattr(wanted, NAMES[ladder.knob]))
                ranks = [ladder.values.index(v) for v in ladder.values if self._no_dearer(ladder, v, value)]
                state[ladder.knob] = ladder.values[max(ranks, default=0)]
            if self.seconds(self.settings(state)) <= aim:
                fit.append(state)
        return fit[-1:]

    @staticmethod
    def _no_dearer(ladder: Ladder, value: float, than: float) -> bool:
        falling = ladder.values[0] > ladder.values[-1]
        if ladder.knob == DETAIL:
            return detail_rank(value) <= detail_rank(than) + 1e-9
        return value >= than if falling else value <= than

    def _pace(self, state: Mapping[str, float], aim: float, *, enough: bool) -> Pace | None:
        """What keeps a frame to its time by rays, where rays are chosen."""
        if RAYS not in state or self.base.gather != "rays" or "gather" not in self.work(self.settings(state)):
            return None
        least = int(next(x for x in self.ladders if x.knob == RAYS).values[0])
        # A machine that turns out to be faster than planned for takes more rays, as long as they show.
        most = int(state[RAYS]) if enough else min(2 * int(state[RAYS]), MOST[RAYS])
        while not enough and most < MOST[RAYS] and self._shows(state, most):
            most = min(2 * most, MOST[RAYS])

        def count(settings: Settings) -> dict[str, Counts]:
            return count_work(settings, self.survey, self.width, self.height)

        return Pace(
            self.survey, self.width, self.height, aim, self.prices, self.model.units, count, least, most, self.slowness
        )

    def _climb(
        self, state: dict[str, float], aim: float, max_error: float | None
    ) -> tuple[dict[str, float], dict[str, float], str]:
        """Take steps while they fit; returns the state, the one before, and why it ended."""
        state = last = dict(state)
        while True:
            settings = self.settings(state)
            time, square = self.seconds(settings), self.square(settings)
            if max_error is not None and square <= max_error**2:
                return state, last, "the error is reached"
            best, gain, full = None, 0.0, False
            for ladder in self.ladders:
                next_ = ladder.values.index(state[ladder.knob]) + 1
                for value in ladder.values[next_ : next_ + AHEAD]:
                    candidate = {**state, ladder.knob: value}
                    made = self.settings(candidate)
                    less = square - self.square(made)
                    if less <= 1e-4 * square:
                        continue
                    more = self.seconds(made) - time
                    if time + more > aim:
                        full = True
                        break
                    if less / max(more, 1e-6) > gain:
                        best, gain = candidate, less / max(more, 1e-6)
            if best is None:
                return state, last, "the time is used up" if full else "nothing more that the table knows would help"
            state, last = best, state

    def _cheapest(self, states: Sequence[dict[str, float]], max_error: float) -> dict[str, float]:
        """Of some states the one that keeps an error in the least time, with as many rays or virtual lights as that
        takes: a whole step often does more than was asked for."""

        def keeps(state: Mapping[str, float]) -> bool:
            return self.square(self.settings(state)) <= max_error**2

        found = []
        for state in states:
            knob = FILLED[self.method]
            if knob in state:
                low, high = int(next(x for x in self.ladders if x.knob == knob).values[0]), MOST[knob]
                while low < high:
                    middle = (low + high) // 2
                    low, high = (low, middle) if keeps({**state, knob: middle}) else (middle + 1, high)
                state = {**state, knob: low}
            if keeps(state):
                found.append(state)
        return min(found, key=lambda state: self.seconds(self.settings(state)))

    def _fill(self, state: dict[str, float], aim: float) -> tuple[dict[str, float], bool]:
        """What is left of the time goes into rays or virtual lights, which never harm, as long as twice as many take
        more than ``SHOWS`` off the error; and whether they do not."""
        knob = FILLED[self.method]
        if knob not in state:
            return state, self.seconds(self.settings(state)) < NEARLY * aim
        low, high = int(state[knob]), MOST[knob]
        while low < high and self.seconds(self.settings({**state, knob: min(2 * low, high)})) <= aim:
            if self._shows(state, low):
                low = min(2 * low, high)
            else:
                high = low
        while low < high:
            middle = (low + high + 1) // 2
            if self.seconds(self.settings({**state, knob: middle})) <= aim:
                low = middle
            else:
                high = middle - 1
        state = {**state, knob: low}
        return state, self.seconds(self.settings(state)) < NEARLY * aim

    def _shows(self, state: Mapping[str, float], count: int) -> bool:
        """Whether twice as many rays or virtual lights take more than ``SHOWS`` off the error."""
        knob = FILLED[self.method]
        now, then = (math.sqrt(self.square(self.settings({**state, knob: n}))) for n in (count, 2 * count))
        return then <= (1.0 - SHOWS) * now

    def _choice(self, state: Mapping[str, float], floor: float, stopped: str, *, enough: bool) -> Choice:
        settings = self.settings(state)
        work = self.work(settings)
        return Choice(
            self.method,
            settings,
            self.seconds(settings),
            self.model.cpu_seconds(work),
            self.accuracy.error(settings, self.survey, self.width, self.method),
            floor,
            tuple(sorted(self.fixed)),
            tuple(self._reasons(state, settings, stopped)),
            enough,
        )

    def _reasons(self, state: Mapping[str, float], settings: Settings, stopped: str) -> list[str]:
        survey = self.survey
        square = self.square(settings)
        lines = [
            f"the objects cover {survey.object:.0%} of the picture and change {survey.affected:.0%} of it;"
            f" {survey.lights} light(s){' and a dome' if survey.dome else ''}; ended because {stopped}"
        ]
        for ladder in self.ladders:
            value = state[ladder.knob]
            if ladder.knob == DETAIL and settings.gather_stride <= FINEST:
                continue  # there is nothing to halve
            bought = self.settings({**state, ladder.knob: ladder.values[0]})
            share = max(0.0, self.square(bought) / max(square, 1e-12) - 1.0)
            saved = self.seconds(settings) - self.seconds(bought)
            shown = " ".join(f"{k}={v}" for k, v in ladder.settings(value).items())
            lines.append(
                f"{shown}: "
                + (f"takes {saved:.2f} s, without it squared error {share:+.0%}" if saved > 1e-4 else "the least")
            )
        lines += [f"{name}={value}: given" for name, value in sorted(self.fixed.items())]
        rays = replace(self.base, gather="rays", glossy="rays")
        left = [ladder.knob for ladder in LADDERS_OF[self.method] if not matters(ladder.knob, survey, rays)]
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
        if self.slowness > 1.0:
            lines.append(f"the machine takes {self.slowness:.1f} times as long just now as when it was calibrated")
        if self.model.shipped:
            lines.append("the times are those of another machine: `warp-dvct calibrate` measures this one's")
        return lines


_WHY = {
    "glossy.rays": "no material has a lobe smoother than glossy.roughness",
    "shadows.samples": "there is no light but the dome, whose shadows are gathered",
}

"""Following the clock through the gather: it takes turns, and each turn's rays are settled by what is left of the time.

A turn's points lie evenly over the picture, so a machine that changes its speed meanwhile changes the noise everywhere
alike; what one turn took says what the next will.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import warp as wp

from warp_dvct.cost import gather_part, gather_points
from warp_dvct.cost_model import Counts, price
from warp_dvct.launch import Launcher
from warp_dvct.passes.gather import GATHER_PARTS, HIDDEN, OBJECT_PARTS, REAL_PARTS, Turn
from warp_dvct.settings import NAMES, Settings
from warp_dvct.survey import Survey

RAYS_SET = ("gather.rays", "gather.object_rays")  # what is settled
MOST_TURNS = 8  # of a launch's points
LEAST_TURN = 0.02  # seconds: a launch's start and end do not show in it
MEMORY = 0.03  # seconds of rays after which half of what was believed before them is left
UNEVEN = 4  # times more or fewer rays than the mean before: no part of the picture pays for all delays
SLOWNESS = (0.4, 4.0)  # measured over predicted seconds that are believed
COUNTED_BEFORE = (REAL_PARTS[0], OBJECT_PARTS[0])  # parts of whose listed points only some are gathered


@dataclass
class GatherTurns:
    """The ``passes.gather.Turns`` of a frame under a budget.

    Attributes:
        survey, width, height: Of the scene and the picture.
        units: Seconds of the clock by pass and unit, see ``CostModel.clock_units``.
        left: Seconds of the budget that are left, as of now.
        later: Predicted seconds of what comes after the rays, on a machine as slow as at first.
        slowness: Measured over predicted seconds of rays, as believed now.
        least, most: Rays of a point.
        settings: Of the frame.
        taken: Points of each turn so far, as predicted, and their rays.
    """

    survey: Survey
    width: int
    height: int
    units: Mapping[str, Counts]
    left: Callable[[], float]
    later: float
    slowness: float
    least: int
    most: int
    settings: Settings
    taken: list[tuple[float, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._ahead = gather_points(self.settings, self.survey, self.width, self.height)
        self._first = self.slowness

    @property
    def mean_rays(self) -> int:
        """Of a point, over all turns; as many as the settings say where there was none."""
        points = sum(n for n, _ in self.taken)
        return round(sum(n * rays for n, rays in self.taken) / points) if points > 0.0 else self.settings.gather_rays

    def rays(self, part: str, points: float) -> int:
        """As many as fit what is left, for ``points`` of a part and all that come after them."""
        time_left = self.left() - self.later * self.slowness / self._first
        mean = self.mean_rays if self.taken else 0
        low, high = max(self.least, mean // UNEVEN), min(self.most, mean * UNEVEN or self.most)
        while low < high:
            middle = (low + high + 1) // 2
            settings = with_rays(self.settings, middle)
            ahead = sum(self._seconds(settings, p, n) for p, n in self._ahead.items() if n > 0.0)
            if self.slowness * (ahead + self._seconds(settings, part, points)) <= time_left:
                low = middle
            else:
                high = middle - 1
        return low

    def take(self, launcher: Launcher, part: str, count: int) -> Iterator[Turn]:
        """See ``passes.gather.Turns``."""
        points = self._reach(part, count)
        if count == 0:
            return
        rays = self.rays(part, points)
        seconds = self.slowness * self._seconds(with_rays(self.settings, rays), part, points)
        of = int(np.clip(seconds / LEAST_TURN, 1, MOST_TURNS))
        for number in range(of):
            rays = self.rays(part, points * (of - number) / of) if number else rays
            start, compiled = time.perf_counter(), launcher.compile_seconds
            yield Turn(number, of, rays)
            wp.synchronize_device(launcher.device)
            spent = time.perf_counter() - start - (launcher.compile_seconds - compiled)
            self._learn(self._seconds(with_rays(self.settings, rays), part, points / of), spent)
            if part != HIDDEN:
                self.taken.append((points / of, rays))

    def _reach(self, part: str, count: int) -> float:
        """Points of a part that are gathered next; those of parts before it are done."""
        for name in GATHER_PARTS[: GATHER_PARTS.index(part)]:
            self._ahead[name] = 0.0
        points = self._ahead[part] if part in COUNTED_BEFORE else float(count)
        self._ahead[part] = max(0.0, self._ahead[part] - points)
        return points

    def _seconds(self, settings: Settings, part: str, points: float) -> float:
        """Predicted, of rays alone."""
        return price({"gather": gather_part(settings, self.survey, part, points)}, self.units)

    def _learn(self, predicted: float, spent: float) -> None:
        """Believe what a turn took: the more, the longer it was."""
        if predicted > 0.0 and spent > 0.0:
            ratio = float(np.clip(spent / predicted, *SLOWNESS))
            self.slowness *= math.exp(math.log(ratio / self.slowness) * (1.0 - 0.5 ** (spent / MEMORY)))


def with_rays(settings: Settings, rays: int) -> Settings:
    """``settings`` with as many gathered rays of every point."""
    return replace(settings, **{NAMES[name]: rays for name in RAYS_SET})

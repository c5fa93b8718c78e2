"""How a budget is kept while paths are traced: the samples, settled by the time that is left."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from warp_dvct import Relighter
from warp_dvct import sample_pace as module
from warp_dvct.sample_pace import AIM, SamplePace
from warp_dvct.usd_scenes import path

LAUNCHER = SimpleNamespace(compile_seconds=0.0, device=None)


class Tracer:
    """Stands for a ``PathTracer`` whose n-th sample takes ``seconds(n)`` by a clock of its own."""

    samples_per_launch = 10

    def __init__(self, clock, seconds) -> None:
        self.clock, self.seconds, self.samples, self.batches = clock, seconds, 0, []

    def add(self, samples: int) -> None:
        self.clock.now += sum(self.seconds(self.samples + k) for k in range(samples))
        self.samples += samples
        self.batches.append(samples)


@pytest.fixture
def clock(monkeypatch) -> SimpleNamespace:
    made = SimpleNamespace(now=5.0)
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: made.now))
    monkeypatch.setattr(module.wp, "synchronize_device", lambda device: None)
    return made


@pytest.mark.parametrize(
    ("name", "seconds"),
    [
        ("as predicted", lambda n: 0.02),
        ("twice as slow", lambda n: 0.04),
        ("faster", lambda n: 0.012),
        ("slower from the middle on", lambda n: 0.02 if n < 100 else 0.05),
        ("faster from the middle on", lambda n: 0.02 if n < 100 else 0.008),
    ],
)
def test_samples_take_what_is_left_of_the_time(clock, name, seconds):
    """Whatever the machine does meanwhile, the last sample ends within one sample and a percent of what is aimed at."""
    pace, tracer = SamplePace(5.0, 0.02, planned=200, most=800, spent=0.5), Tracer(clock, seconds)
    pace.begin(LAUNCHER)
    shown = []
    assert pace.trace(LAUNCHER, tracer, lambda done, total: shown.append((done, total))) == tracer.samples
    spent = clock.now - 5.0 + pace.spent
    assert AIM * 5.0 - 1.01 * seconds(tracer.samples) - 0.05 <= spent <= 1.01 * AIM * 5.0
    assert pace.settled.samples == tracer.samples
    assert pace.settled.planned == 200
    assert pace.settled.slowness == pytest.approx((spent - 0.5) / (0.02 * tracer.samples))
    assert all(done < total for done, total in shown)
    assert max(tracer.batches) <= Tracer.samples_per_launch


def test_samples_have_bounds(clock):
    """One at least, however late; and no more than ``most``."""
    for spent, budget, expected in ((9.0, 1.0, 1), (0.0, 1e6, 12)):
        pace, tracer = SamplePace(budget, 0.02, planned=3, most=12, spent=spent), Tracer(clock, lambda n: 0.02)
        pace.begin(LAUNCHER)
        assert pace.trace(LAUNCHER, tracer, lambda *_: None) == expected


def test_a_settled_picture_is_that_of_its_samples():
    """The first frame settles the samples; it, and the next, equal a new frame of as many bit for bit."""
    relighter = Relighter(path("colour_bleeding"), method="path-trace", width=32)
    choice = relighter.keep_budget(0.5)
    assert "samples is settled while the frame is traced" in choice.describe()
    first, settled = relighter.render(), choice.pace.settled
    assert choice.to_dict()["chosen"]["samples"] == settled.samples == relighter.settings.samples
    assert choice.to_dict()["settled"]["planned"] == choice.settings.samples
    alone = Relighter(
        path("colour_bleeding"), method="path-trace", width=32, settings={"samples": settled.samples}
    ).render()
    np.testing.assert_array_equal(first.comp, alone.comp)
    np.testing.assert_array_equal(relighter.render().comp, alone.comp)


@pytest.mark.parametrize("fixed", [{"samples": 2}, {}])
def test_samples_that_are_not_the_clock_s_stay(fixed):
    relighter = Relighter(path("colour_bleeding"), method="path-trace", width=32, settings=fixed)
    request = {"seconds": 30.0} if fixed else {"max_error": 0.2}
    assert relighter.keep_budget(**request).pace is None

"""How a budget is kept while it is spent: the rays of the gather, settled by the time that is left."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from known_costs import chosen, made_model

from warp_dvct import Relighter
from warp_dvct.accuracy import load_accuracy
from warp_dvct.budget import SHOWS
from warp_dvct.cost import PROBE, gather_part, gather_points
from warp_dvct.cost_model import price
from warp_dvct.device_scene import DeviceScene
from warp_dvct.methods.delta_cone_tracing import render
from warp_dvct.methods.light_field import light_volumes
from warp_dvct.pace import BELIEVED, LAST, LATER, Pace, try_machine
from warp_dvct.passes.gather import Turn
from warp_dvct.plan import make_plan
from warp_dvct.settings import Settings, make_settings
from warp_dvct.turns import MOST_TURNS, UNEVEN, GatherTurns, with_rays
from warp_dvct.usd.read import read_stage
from warp_dvct.usd_scenes import path


class Machine:
    """Stands for a launcher under a clock of its own: passes have taken ``speed`` times their predicted processor time,
    and threads ``stall`` times as long by the clock as such processor time should take them."""

    compile_seconds = 0.0
    device = SimpleNamespace(is_cuda=False)

    def __init__(self, pace: Pace, settings: Settings, speed: float, stall: float = 1.0) -> None:
        done = {name: c for name, c in pace.count(settings).items() if name not in (*LATER, "gather")}
        self.pass_cpu_seconds = {name: speed * price({name: c}, pace.cpu_units) for name, c in done.items()}
        self.pass_seconds = {name: speed * stall * price({name: c}, pace.units) for name, c in done.items()}


@pytest.fixture
def clock(monkeypatch) -> SimpleNamespace:
    """A clock that tests turn."""
    from warp_dvct import pace, turns

    made = SimpleNamespace(now=100.0)
    fake = SimpleNamespace(perf_counter=lambda: made.now, process_time=lambda: made.now)
    for module in (pace, turns):
        monkeypatch.setattr(module, "time", fake)
        monkeypatch.setattr(module.wp, "synchronize_device", lambda device: None)
    return made


def gather(pace: Pace, turns: GatherTurns, machine: Machine, clock, speeds: dict[str, float]) -> list[tuple[str, Turn]]:
    """Take the turns on a machine whose rays cost ``speeds`` (by part, from its second half on; 1 elsewhere) times as
    much as predicted; the clock goes on by that."""
    numbers, taken = gather_points(turns.settings, pace.survey, pace.width, pace.height), []
    for part, points in numbers.items():
        for turn in turns.take(machine, part, round(points)):
            made = gather_part(with_rays(turns.settings, turn.rays), pace.survey, part, points / turn.of)
            late = turn.number >= turn.of // 2
            clock.now += (speeds.get(part, 1.0) if late else 1.0) * price({"gather": made}, pace.units)
            taken.append((part, turn))
    return taken


@pytest.mark.parametrize(("stage", "budget"), [("room_area", 0.6), ("room_glossy", 4.0), ("ground_dome", 5.0)])
@pytest.mark.parametrize(("speed", "stall"), [(0.7, 1.0), (1.0, 1.0), (0.8, 1.9), (1.4, 1.1)])
def test_rays_take_what_is_left_of_the_time(surveys, monkeypatch, clock, stage, budget, speed, stall):
    """On a machine of a known speed whose cores others use too, where rays cost by another factor than the rest:
    planning, what was done, what is still to do and the settled rays add up to what is aimed at."""
    choice = chosen(surveys, stage, seconds=budget)
    pace, settings = choice.pace, choice.settings
    monkeypatch.setattr(Pace, "_try_rays", lambda self, *args: 0.8 * speed)
    pace.spent = 0.05 * budget
    machine, slowness = Machine(pace, settings, speed, stall), speed * stall
    pace.begin(machine)
    clock.now += 0.3 * budget
    turns = pace.settle(machine, None, None, None, settings)
    work, numbers = pace.count(settings), gather_points(settings, pace.survey, pace.width, pace.height)
    first = next(iter(numbers))
    turns._ahead[first] = 0.0  # they are those asked for
    made = with_rays(settings, turns.rays(first, numbers[first]))
    assert pace.end(turns) == settings  # without a turn, as planned
    assert pace.settled.slowness == pytest.approx(slowness)
    assert replace(made, gather_rays=settings.gather_rays, gather_object_rays=settings.gather_object_rays) == settings

    def total(settings: Settings) -> float:
        later = sum(price({n: work[n]}, pace.units) for n in LAST if n in work)
        later += price({"gather": work["gather"]}, pace.units)  # of which rays as made, and what is no ray
        for part, points in numbers.items():
            rays = [
                price({"gather": gather_part(s, pace.survey, part, points)}, pace.units)
                for s in (choice.settings, settings)
            ]
            later += 0.8 * rays[1] - rays[0]
        return 0.35 * budget + slowness * later

    assert total(made) <= budget < total(with_rays(made, made.gather_rays + 1))


@pytest.mark.parametrize("speeds", [{}, {"real blocks": 2.0}, {"real blocks": 0.6}])
def test_turns_follow_a_machine_that_changes_its_speed(surveys, monkeypatch, clock, speeds):
    """In the middle of the gather: the frame still ends within a few percent of what is aimed at."""
    choice = chosen(surveys, seconds=4.0)
    pace, settings = choice.pace, choice.settings
    monkeypatch.setattr(Pace, "_try_rays", lambda self, *args: 1.0)
    machine = Machine(pace, settings, 1.0)
    pace.begin(machine)
    clock.now += 1.0
    turns = pace.settle(machine, None, None, None, settings)
    taken = gather(pace, turns, machine, clock, speeds)
    end = clock.now - 100.0 + turns.later * turns.slowness
    assert end == pytest.approx(pace.aim, rel=0.04)
    by_part = {part: [t for p, t in taken if p == part] for part, _ in taken}
    assert len(by_part["real blocks"]) == MOST_TURNS
    for part_turns in by_part.values():
        assert [t.number for t in part_turns] == list(range(part_turns[0].of))
    rays = [t.rays for t in by_part["real blocks"]]
    made, settled = pace.end(turns), pace.settled
    assert min(settled.turns) <= settled.rays == made.gather_rays == made.gather_object_rays <= max(settled.turns)
    assert max(settled.turns) <= UNEVEN * settled.rays
    if speeds:
        slower = speeds["real blocks"] > 1.0
        assert (rays[-1] < 0.8 * rays[0]) if slower else (rays[-1] > 1.1 * rays[0])
    else:
        assert max(rays) <= 1.05 * min(rays)


def test_settled_rays_have_bounds(surveys, monkeypatch, clock):
    """Late beyond help, the fewest rays; where more would not show, no more than planned."""
    monkeypatch.setattr(Pace, "_try_rays", lambda self, *args: 0.5)
    for seconds, spent, bound in ((1.0, 1e3, "least"), (10_000.0, 0.0, "most")):
        choice = chosen(surveys, seconds=seconds)
        choice.pace.spent = spent
        machine = Machine(choice.pace, choice.settings, 0.5)
        choice.pace.begin(machine)
        turns = choice.pace.settle(machine, None, None, None, choice.settings)
        taken = gather(choice.pace, turns, machine, clock, {})
        assert {turn.rays for _, turn in taken} == {getattr(choice.pace, bound)}
    assert choice.enough
    assert choice.pace.most == choice.settings.gather_rays


def test_no_more_rays_than_show_are_settled(surveys):
    """Planned for a slow machine, a frame of one bounce that is fast after all gathers no more than one would see."""
    usual = chosen(surveys, seconds=2.0)
    floor = usual.floor
    cheapest = chosen(surveys, seconds=1.1 * floor, slowness=3.0)
    assert cheapest.settings.bounces == 1
    assert 2 * cheapest.settings.gather_rays <= cheapest.pace.most <= 256
    assert usual.pace.most >= 2 * usual.settings.gather_rays
    table, found = load_accuracy(), surveys["room_area"]
    many, more = (table.error(with_rays(cheapest.settings, n * cheapest.pace.most), found, 320) for n in (1, 2))
    assert more >= (1.0 - SHOWS) * many


@pytest.mark.parametrize("request_", [{"max_error": 0.05}, {"seconds": 2.0, "fixed": {"gather.rays": 64}}])
def test_rays_that_are_not_the_clock_s_stay(surveys, request_):
    assert chosen(surveys, **request_).pace is None
    assert chosen(surveys, seconds=5.0, method="instant-radiosity").pace is None


def test_a_slow_machine_is_planned_for(surveys):
    """Everything takes twice as long: half as much fits, and nothing is refused for it."""
    usual, slow = (chosen(surveys, seconds=2.0, slowness=slowness) for slowness in (1.0, 2.0))
    assert 0.9 * 2.0 <= slow.seconds <= 0.95 * 2.0
    as_usual = price(usual.pace.count(slow.settings), usual.pace.units)
    assert as_usual == pytest.approx(0.5 * usual.seconds, rel=0.1)
    assert slow.floor == pytest.approx(usual.floor)
    assert slow.error > usual.error
    assert "takes 2.0 times as long just now" in slow.describe()
    least = chosen(surveys, seconds=1.1 * usual.floor, slowness=3.0)
    assert least.seconds == pytest.approx(3.0 * usual.floor)
    # Relative to what is expected now.
    assert price(slow.pace.count(slow.settings), slow.pace.units) == pytest.approx(slow.seconds, rel=0.1)


def test_a_part_of_a_sudden_speed_is_believed(surveys):
    usual, slow = (chosen(surveys, seconds=2.0, slowness=slowness).pace for slowness in (1.0, 2.0))
    assert usual._believed(0.7) == slow._believed(0.7) == pytest.approx(0.7)
    assert slow._believed(0.5) == pytest.approx(2.0**-BELIEVED)  # as fast as calibrated: not quite twice as fast
    assert slow._believed(0.4) == pytest.approx(0.8 * 2.0**-BELIEVED)  # faster still: in proportion
    assert usual._believed(0.1) == pytest.approx(0.4)
    assert slow._believed(9.0) == usual._believed(9.0) == pytest.approx(4.0)


@pytest.mark.parametrize(("ratio", "slowness"), [(0.3, 1.0), (1.3, 1.0), (1.6, 1.6), (100.0, 4.0)])
def test_a_little_slowness_changes_no_plan(ratio, slowness):
    """The machine's trial against a calibrated one, by the gain of as many threads."""
    from warp_dvct.planning import _slowness

    model = made_model()
    assert _slowness(1.0, model, 2) == 1.0  # calibrated before there was a trial
    model = replace(model, units={**model.units, PROBE: {"tries": 0.01}}, speedup={**model.speedup, PROBE: 2.0})
    assert _slowness(ratio * 0.005, model, 2) == pytest.approx(slowness)
    assert _slowness(ratio * 0.01, model, 1) == pytest.approx(slowness)


def test_the_machine_s_trial_is_work_of_a_known_amount(launcher, monkeypatch):
    from warp_dvct import pace as module

    usual = try_machine(launcher)
    monkeypatch.setattr(module, "PROBE", (module.PROBE[0], 50 * module.PROBE[1]))
    assert 0.0 < usual < try_machine(launcher)


@pytest.mark.cpu
def test_later_frames_keep_the_mean_rays(monkeypatch, tmp_path):
    """The first frame settles the rays while it gathers; the next equals a new frame of the settings that the
    statistics name bit for bit, and is not voxelised again."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    relighter = Relighter(path("colour_bleeding"), width=48)
    choice = relighter.keep_budget(1.0)
    relighter.render()
    settled = choice.pace.settled
    assert relighter.settings == with_rays(choice.settings, settled.rays) == relighter.plan.settings
    assert settled.planned == choice.settings.gather_rays
    assert min(settled.turns) <= settled.rays <= max(settled.turns)
    assert 0.4 <= settled.slowness <= 4.0
    assert 0.4 <= settled.ray_slowness <= 4.0
    assert choice.to_dict()["chosen"]["gather.rays"] == choice.to_dict()["settled"]["rays"] == settled.rays
    assert "settle" in relighter.stats["passes"]
    second = relighter.render()
    assert not {"settle", "voxelize", "upload"} & set(relighter.stats["passes"])
    alone = Relighter(path("colour_bleeding"), width=48, settings=choice.to_dict()["chosen"]).render()
    np.testing.assert_array_equal(second.comp, alone.comp)
    np.testing.assert_array_equal(second.delta, alone.delta)


@pytest.mark.cpu
def test_the_clock_decides_on_nothing_but_each_turn_s_rays(monkeypatch, tmp_path):
    """The first frame again with the rays that the clock gave each turn is the same bit for bit."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setattr("warp_dvct.planning._slowness", lambda *args: 1.0)
    calls: list[list[Turn]] = []
    take = GatherTurns.take

    def record(self, launcher, part, count):
        calls.append([])
        for turn in take(self, launcher, part, count):
            calls[-1].append(turn)
            yield turn

    def repeat(self, launcher, part, count):
        yield from calls.pop(0)

    frames = []
    for instead in (record, repeat):
        monkeypatch.setattr(GatherTurns, "take", instead)
        relighter = Relighter(path("colour_bleeding"), width=48)
        relighter.keep_budget(1.0)
        frames.append(relighter.render())
    assert not calls
    for layer in ("comp", "delta", "rgba"):
        np.testing.assert_array_equal(*(getattr(frame, layer) for frame in frames))


@pytest.mark.parametrize("with_before", [False, True])
@pytest.mark.parametrize("stage", ["colour_bleeding", "room_glossy"])
def test_turns_of_as_many_rays_make_the_same_picture(launcher, stage, with_before):
    """Bit for bit: each point is in one turn, however many there are."""

    class Even:
        def take(self, launcher, part, count):
            yield from (Turn(k, 5, 8) for k in range(5))

    scene = read_stage(path(stage))
    settings = make_settings("balanced", {"gather.rays": 8, "gather.object_rays": 8, "volume.resolution": 16})
    plan = make_plan(scene, settings, "delta-cones", 64, 36)
    uploaded = DeviceScene.upload(launcher, scene, np.asarray(plan.origin), plan.scale)
    lit = light_volumes(launcher, scene, uploaded, plan)
    pictures = [
        render(launcher, scene, uploaded, lambda: lit, plan, with_before=with_before, turns=turns)
        for turns in (None, Even())
    ]
    for name in ("delta", "synthetic", "before") if with_before else ("delta", "synthetic"):
        expected, turned = (getattr(picture, name).numpy() for picture in pictures)
        assert expected.any()
        assert np.isfinite(expected).all()
        np.testing.assert_array_equal(expected, turned)


def test_trials_are_spread_over_the_picture():
    """Runs of neighbours lie evenly, and are not those of another trial."""
    from warp_dvct.kernels.gather import RUN
    from warp_dvct.pace import TRIALS, _spread

    pixels = np.arange(0, 10_000, 2)
    trials = [_spread(pixels, 5 * RUN, k) for k in range(TRIALS)]
    for points in trials:
        runs = points.reshape(5, RUN)
        assert (np.diff(runs, axis=1) == 2).all()
        np.testing.assert_allclose(np.diff(runs[:, 0]), 2000, atol=2)
    assert len(np.unique(np.concatenate(trials))) == 5 * RUN * TRIALS
    assert len(_spread(pixels, RUN + 1, 0)) == 2 * RUN
    assert len(np.unique(_spread(pixels[:RUN], 1000, TRIALS - 1))) == RUN
    assert len(_spread(pixels[:3], 50, 0)) == 3
    assert len(_spread(pixels[:0], 50, 0)) == 0

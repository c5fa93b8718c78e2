"""``bench curve`` and ``bench compare``: what they measure, on pictures with a known answer and on a tiny room."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from warp_dvct.bench import sweep as module
from warp_dvct.bench.__main__ import bench
from warp_dvct.bench.references import Reference, combine
from warp_dvct.bench.sweep import Indirect, SweepOptions, Truth, compare_indirect, parse_trials
from warp_dvct.errors import OptionError
from warp_dvct.settings import make_settings

WIDTH, SPP = 64, 64


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """References that the tests of this file share."""
    return tmp_path_factory.mktemp("references")


def made_truth(noise: float) -> tuple[Truth, Indirect]:
    """A picture whose left half is real, with independent noise in the two parts; and its indirect light."""
    rng = np.random.default_rng(3)
    shape = (64, 64, 3)
    coverage = np.zeros(shape[:2], np.float32)
    coverage[:, 32:] = 1
    free = 1 - coverage[..., None]
    exact = Indirect(np.full(shape, 0.2), -0.1 * free * np.ones(3), 0.3 * (1 - free) * np.ones(3))
    parts = [
        Indirect(*(v + noise * rng.standard_normal(shape) for v in (exact.before, exact.delta, exact.synthetic)))
        for _ in range(2)
    ]
    whole = Reference(exact.before, exact.delta, np.concatenate([exact.synthetic, coverage[..., None]], -1), 0.0)
    return Truth(whole, (parts[0], parts[1]), 0.0, coverage <= 0, coverage >= 0, coverage >= 0), exact


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_errors_of_known_pictures(noise):
    """An offset of .01 on a mean of .2 is 5 %, whatever the truth's noise; the truth itself has no error."""
    truth, exact = made_truth(noise)
    error, before, after = compare_indirect(truth, exact)
    assert error < 0.025 if noise else error == 0  # the noise is 10 %
    assert (before, after) == pytest.approx((1, 1), abs=2e-3)
    off = replace(exact, delta=exact.delta + 0.01 * truth.real[..., None], before=1.1 * exact.before)
    error, before, after = compare_indirect(truth, off)
    assert error == pytest.approx(0.05, abs=4e-3)
    assert before == pytest.approx(1.1, abs=2e-3)
    assert after == pytest.approx((0.5 * 0.13 + 0.5 * 0.3) / (0.5 * 0.1 + 0.5 * 0.3), abs=2e-3)


def test_indirect_truth_is_the_bounce_alone(cache, launcher):
    """The two parts are independent, share no direct light, and agree in the mean."""
    from warp_dvct.bench.error import read
    from warp_dvct.usd_scenes import path

    options = SweepOptions(width=WIDTH, samples=SPP, cache=cache)
    truth = module.truth_of(read(path("room_area")), WIDTH, 36, options, launcher)
    one, two = truth.parts
    assert not np.array_equal(one.before, two.before)
    assert one.before.mean() == pytest.approx(two.before.mean(), rel=0.02)
    assert 0.2 < one.before.mean() / truth.whole.before.mean() < 0.8
    assert 0 < truth.noise < 0.05
    np.testing.assert_array_equal(
        truth.whole.comp, combine(truth.whole.before, truth.whole.delta, truth.whole.synthetic)
    )


def test_glossy_pixels_are_left_out_of_the_indirect_light(cache, launcher):
    """The frame of direct light mirrors lit surfaces in the floor: only the walls' indirect light is compared."""
    from warp_dvct.bench.error import read
    from warp_dvct.usd_scenes import path

    options = SweepOptions(width=WIDTH, samples=SPP, cache=cache)
    truth = module.truth_of(read(path("room_glossy")), WIDTH, 36, options, launcher)
    assert truth.real[4].mean() > 0.9  # back wall
    assert not truth.real[-1].any()  # floor
    np.testing.assert_array_equal(truth.counted, truth.real)


def test_more_of_everything_lowers_the_error(cache):
    """First and third step of the curve; indirect energy within 2 % at the third, over four seeds."""
    chosen = {name: module.CURVE[name] for name in ("1/4", "1")}
    again = {f"1, seed {n}": {**module.CURVE["1"], "seed": str(n)} for n in (1, 2, 3)}
    seen = []
    options = SweepOptions(width=128, samples=SPP, cache=cache)
    _, (low, middle, *others) = module.measure("room_area", {**chosen, **again}, options, seen.append)
    assert [t.name for t in seen] == ["1/4", "1", *again]
    assert middle.flip < 0.8 * low.flip
    assert middle.flip_affected < 0.8 * low.flip_affected
    assert middle.delta_error < 0.6 * low.delta_error
    assert abs(np.mean([t.energy_before for t in (middle, *others)]) - 1) < 0.02
    assert abs(np.mean([t.energy_after for t in (middle, *others)]) - 1) < 0.02
    assert low.cpu_seconds > 0


def test_curve_turns_every_knob_up():
    for weaker, stronger in zip(list(module.CURVE.values()), list(module.CURVE.values())[1:], strict=False):
        assert weaker.keys() == stronger.keys()
        for knob in weaker:
            a, b = float(weaker[knob]), float(stronger[knob])
            assert a >= b if any(word in knob for word in ("stride", "smoothing", "detail")) else a <= b, knob
    assert make_settings("balanced", module.CURVE["1"]) == make_settings("balanced")


def test_compare_prints_a_line_per_setting_and_writes_json(cache, tmp_path):
    file = tmp_path / "figures.json"
    arguments = ["compare", "--stage", "room_area", "--width", str(WIDTH), "--spp", str(SPP), "--cache", str(cache)]
    arguments += ["--quality", "balanced", "--json", str(file)]
    arguments += ["--try", "", "--try", "by cones: gather=cones"]
    result = CliRunner().invoke(bench, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    head, columns, preset, cones, noise, *_ = result.output.splitlines()
    assert head.startswith("room_area, 64 pixels wide, delta-cones balanced")
    assert " ".join(columns.split()) == "setting seconds CPU s FLIP affected delta err E before E after"
    assert len(columns) == len(preset) == len(cones)
    assert preset.split()[0] == "preset"
    assert cones.startswith("by cones")
    assert "noise is FLIP" in noise
    trials = json.loads(file.read_text())["trials"]
    assert [t["name"] for t in trials] == ["preset", "by cones"]
    assert trials[1]["delta_error"] > trials[0]["delta_error"]


def test_trials_from_text():
    assert parse_trials(["", "a: x.y=1 z=2", "gather=rays"]) == {
        "preset": {},
        "a": {"x.y": "1", "z": "2"},
        "gather=rays": {"gather": "rays"},
    }
    with pytest.raises(OptionError, match="KEY=VALUE"):
        parse_trials(["gather"])
    with pytest.raises(OptionError, match="given twice"):
        parse_trials(["a: x=1", "a: x=2"])


@pytest.mark.parametrize(("options", "message"), [({"width": 8}, "raise --width"), ({"samples": 1}, "--spp is 1")])
def test_unusable_sizes(options, message, cache):
    with pytest.raises(OptionError, match=message):
        module.measure("room_area", {"preset": {}}, SweepOptions(**{"width": WIDTH, "cache": cache, **options}))

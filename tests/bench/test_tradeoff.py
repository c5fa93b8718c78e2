"""``bench tradeoff``: which points it takes, what it measures, that it goes on where it stopped, and what it says."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from warp_dvct.bench import knobs, pareto, tradeoff
from warp_dvct.bench.__main__ import bench
from warp_dvct.bench.knobs import KNOBS, choose_trials
from warp_dvct.bench.rows import read_rows
from warp_dvct.errors import FileError, OptionError
from warp_dvct.settings import make_settings

ASKED = {  # the issue of the trade names these; each has to have a sweep of some method
    *("volume.resolution", "cones.count", "cones.aperture", "cones.step", "gather.stride", "rsm.texels", "shadows"),
    *("shadows.samples", "vpls.count", "ism.size", "ism.points", "bounces", "samples"),
}


def test_every_knob_that_matters_is_swept_and_every_value_is_valid():
    assert {k.name for k in KNOBS} >= ASKED
    trials, left_out = choose_trials((), (), 8, True)
    assert left_out == []
    for trial in trials:
        make_settings(trial.quality, trial.settings)
    assert {t.method for t in trials} == set(knobs.METHODS)
    assert len({(t.method, t.group, make_settings(t.quality, t.settings)) for t in trials}) == len(trials)


def test_values_that_move_together():
    knob = next(k for k in KNOBS if k.name == "gather.stride")
    assert knob.settings("4/2") == {"gather.stride": "4", "gather.object_stride": "2"}
    rays = next(k for k in KNOBS if k.name == "gather.rays")
    assert rays.settings("32") == {"gather.rays": "32", "gather.object_rays": "32"}
    with pytest.raises(OptionError, match="2 values are expected"):
        knob.settings("1/2/3")


def test_own_knobs_values_and_what_a_stage_cannot_show():
    trials, _ = choose_trials(("delta-cones",), ("volume.scale=2,4", "preset=draft"), 1, False)
    assert [(t.group, t.value) for t in trials] == [("preset", "draft"), ("volume.scale", "2"), ("volume.scale", "4")]
    trials, left_out = choose_trials(("delta-cones",), ("glossy", "gather"), 1, False)
    assert {t.group for t in trials} == {"gather"}
    assert "no surface of the stage is glossy" in left_out[0]
    trials, left_out = choose_trials(("delta-cones", "path-trace"), ("preset=draft", "gather.rays"), 1, False)
    assert {t.method for t in trials} == {"delta-cones"}
    assert left_out == ["path-trace: it has none of preset, gather.rays"]


@pytest.mark.parametrize(
    ("methods", "chosen", "message"),
    [
        ((), ("gather.raysx",), "did you mean 'gather.rays'"),
        ((), ("seed",), "needs values"),
        ((), ("gather.rays=",), "empty"),
        (("path-trace",), ("ism.size",), r"sweep is empty \(path-trace: it has none of ism.size"),
        (("delta-cones",), ("glossy.rays",), "sweep is empty .*glossy"),
        (("magic",), (), "method is 'magic'"),
        ((), ("gather.rays=0",), "outside"),
        ((), ("preset=best",), "presets are"),
        (("delta-cones",), ("joint=3",), "joint=3"),
    ],
)
def test_what_cannot_be_swept(methods, chosen, message):
    with pytest.raises(OptionError, match=message):
        choose_trials(methods, chosen, 8, False)


def test_front_of_known_points():
    costs, errors = [1.0, 2.0, 3.0, 1.5, 1.0, 4.0], [0.5, 0.3, 0.4, 0.3, 0.6, 0.1]
    assert pareto.front(costs, errors) == [0, 3, 5]
    rng = np.random.default_rng(2)
    x, y = rng.uniform(size=(2, 200))
    best = set(pareto.front(list(x), list(y)))
    beaten = [bool(np.any((x <= x[i]) & (y <= y[i]) & ((x < x[i]) | (y < y[i])))) for i in range(200)]
    assert best == {i for i in range(200) if not beaten[i]}


def row(value: str, seconds: float, flip: float) -> dict:
    """A point of one knob."""
    areas = {"picture": flip}
    case = {"method": "delta-cones", "group": "gather.rays", "value": value, "device": "cpu"}
    return {**case, "cpu_seconds": [seconds, 2 * seconds], "errors": {"FLIP": areas}}


def test_sentences_state_what_was_measured():
    lines = pareto.words([row("16", 0.50, 0.030), row("32", 0.51, 0.0301), row("64", 1.0, 0.02), row("96", 0.8, 0.025)])
    assert lines == [
        "delta-cones: halving gather.rays from 32 to 16 changes FLIP by less than 0.0004 (0.0301), changes the time by"
        " less than 5 %",
        "delta-cones: halving gather.rays from 64 to 32 costs 0.0101 FLIP (0.0200 to 0.0301), saves 49 % of the time",
        "delta-cones: changing gather.rays from 96 to 64 gains 0.0050 FLIP (0.0250 to 0.0200), takes 25 % more time",
    ]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """References that the tests of this file share."""
    return tmp_path_factory.mktemp("references")


SMALL = ["--width", "32", "--spp", "8", "--repeats", "1", "--no-peers", "--bounces", "1"]


def run(cache, out, *arguments: str):
    """The command on a tiny room."""
    words = ["tradeoff", *SMALL, "--cache", str(cache), "--out", str(out), *arguments]
    return CliRunner().invoke(bench, words, catch_exceptions=False)


@pytest.mark.cpu
def test_a_sweep_measures_draws_and_resumes(cache, tmp_path):
    """A stopped sweep goes on; more samples cost more and err less; flicker is measured; files are there."""
    common = ("--method", "path-trace", "--flicker", "2")
    first = run(cache, tmp_path, *common, "--knob", "samples=1")
    assert first.exit_code == 0
    text = (tmp_path / "rows.jsonl").read_text()
    second = run(cache, tmp_path, *common, "--knob", "samples=1,32", "--html", str(tmp_path / "page"))
    assert second.exit_code == 0
    assert (tmp_path / "rows.jsonl").read_text().startswith(text)
    low, high = read_rows(tmp_path / "rows.jsonl", "tradeoff")
    assert second.output.count("·") == 2  # in the head and beside the known point
    assert min(low["cpu_seconds"]) < min(high["cpu_seconds"])
    for metric in ("FLIP", "RMSE", "relMSE"):
        assert high["errors"][metric]["picture"] < low["errors"][metric]["picture"]
        assert set(high["errors"][metric]) == {"picture", "affected", "real", "object"}
    assert 0 < high["flicker"] < low["flicker"]
    assert low["truth_key"] == high["truth_key"]
    for name in ("front_room_area.svg", "front_room_area.png", "pictures/room_area_truth.png", "page/index.html"):
        assert (tmp_path / name).stat().st_size > 500
    assert "changing samples from 32 to 1 costs" in second.output
    content = json.loads((tmp_path / "page/index.html").read_text().split('id="data">')[1].split("</script>")[0])
    assert "--knob samples=1,32" in content["commands"][0]


def test_a_picture_that_belongs_to_two_sweeps_is_rendered_once(cache, tmp_path):
    """The preset is a value of each sweep; the file holds it once."""
    knobs_ = ("--knob", "vpls.tiles=4,8", "--knob", "ism.size=32,128", "--knob", "ism.points=1024")
    small = ("--method", "instant-radiosity", "--flicker", "0", "--html", str(tmp_path / "page"))
    result = run(cache, tmp_path, *knobs_, *small)
    assert result.exit_code == 0
    assert len(read_rows(tmp_path / "rows.jsonl")) == 3
    assert "doubling vpls.tiles from 4 to 8" in result.output or "halving vpls.tiles from 8 to 4" in result.output
    assert "quartering ism.size from 128 to 32" in result.output
    content = json.loads((tmp_path / "page/index.html").read_text().split('id="data">')[1].split("</script>")[0])
    assert len(content["stages"][0]["points"]) == 3


def test_every_method_is_measured(cache, tmp_path):
    """Presets of both fast methods at a tiny size: the same metrics, and passes that add up to the frame."""
    options = ("--flicker", "0", "--knob", "preset=draft", "--method", "delta-cones", "--method", "instant-radiosity")
    assert run(cache, tmp_path, *options).exit_code == 0
    rows = read_rows(tmp_path / "rows.jsonl")
    assert [r["method"] for r in rows] == ["delta-cones", "instant-radiosity"]
    for measured in rows:
        assert measured["flicker"] is None
        assert sum(measured["cpu_passes"].values()) == pytest.approx(min(measured["cpu_seconds"]), rel=0.2)
        assert 0 < measured["errors"]["FLIP"]["picture"] < 0.3


def test_a_stage_that_a_peer_cannot_load_is_named(cache, tmp_path, monkeypatch):
    """Mitsuba's spot differs from ours: the stage is left out of its rows, and said."""
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(tradeoff, "PEER_SAMPLES", (1,))
    monkeypatch.setattr(tradeoff, "choose_trials", lambda *_: ([], []))
    options = tradeoff.TradeoffOptions(width=32, samples=4, flicker=0, bounces=1, cache=cache, out=tmp_path)
    made = tradeoff.Bench("room_spot", options)
    assert made.run() == []
    assert [r for r in made.left_out if r.startswith("Mitsuba 3") and "spot" in r]


def test_unusable_input_writes_nothing(cache, tmp_path):
    file = tmp_path / "rows.jsonl"
    file.write_text("no row\n")
    with pytest.raises(FileError, match=r"rows\.jsonl:1 is not a row"):
        run(cache, tmp_path, "--knob", "samples=1")
    assert file.read_text() == "no row\n"
    for flags, message in (
        (("--flicker", "1"), "--flicker"),
        (("--repeats", "0"), "--repeats"),
        (("--width", "8"), "raise --width"),
        (("--knob", "nothing"), "no knob 'nothing'"),
    ):
        with pytest.raises(OptionError, match=message):
            run(cache, tmp_path / "new", *flags)
    assert not (tmp_path / "new").exists()

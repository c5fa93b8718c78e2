"""``bench budget`` and ``bench error-table``: rows of a tiny room, summaries and tables of known rows."""

from __future__ import annotations

import json
import math
from dataclasses import asdict

import pytest
from click.testing import CliRunner

from warp_dvct.accuracy import REFERENCE
from warp_dvct.bench import budget as module
from warp_dvct.bench import error_table
from warp_dvct.bench.__main__ import bench
from warp_dvct.bench.error import read, stage_file
from warp_dvct.bench.rows import append_row, read_rows
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.settings import make_settings
from warp_dvct.survey import survey


def row(seconds: float, flip: float | None = 0.03) -> dict:
    """A budget of 2 s, predicted to take 1.9 s and to err by 0.03."""
    settled = {"rays": 40, "planned": 64, "slowness": 0.5 * seconds, "ray_slowness": 1.0}
    predicted = {"seconds": 1.9, "cpu_seconds": 3.0, "error": 0.03, "settled": settled}
    return {
        "stage": "s",
        "budget": 2.0,
        "predicted": predicted,
        "seconds": seconds,
        "cpu_seconds": 1.5 * seconds,
        "flip": flip,
    }


def test_a_summary_counts_what_was_kept():
    text = module.summarise([row(2.0), row(1.4), row(2.6, 0.05), row(2.4, None), {"refused": "floor"}])
    assert "of 4 budgets, 2 were kept within 25% by the clock, and the latest took 1.30" in text
    assert "took from 0.70 to 1.30 of their prediction" in text
    assert "of 3 errors, 2 were predicted within a factor of 1.5" in text
    assert module.summarise([{"refused": "floor"}]) == "every budget was below the floor"


def test_a_line_says_what_was_planned_and_settled():
    head, line = module.HEAD.split(), module.format_row(row(2.2)).split()
    assert line[:6] == ["s", "2.00", "1.90", "2.20", "1.10", "3.30"]
    assert line[6:] == ["64", "40", "1.10", "0.0300", "0.0300", "1.00"]
    assert head.index("settled") > head.index("planned")
    unsettled = row(2.2)
    unsettled["predicted"] |= {"settled": None, "enough": True}
    assert module.format_row(unsettled).endswith("more would not show")
    traced = row(2.2) | {"method": "path-trace"}
    traced["predicted"] |= {"settled": {"samples": 12, "planned": 10, "slowness": 0.8}}
    assert module.format_row(traced).split()[6:9] == ["10", "12", "0.80"]
    assert "the frames' samples took from 0.80" in module.summarise([traced])
    assert "floor" in module.format_row({"stage": "s", "budget": 1.0, "refused": "below the floor"})


@pytest.mark.cpu
def test_a_tiny_room_keeps_a_budget(tmp_path, monkeypatch):
    """Predictions, times and errors are in the rows; a budget below the floor is said in its line."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setattr("warp_dvct.planning._slowness", lambda *args: 1.0)
    file = tmp_path / "rows.jsonl"
    words = ["budget", "--stage", "colour_bleeding", "--width", "48", "--spp", "16", "--cache", str(tmp_path)]
    flags = ["--budget", "0.001", "--budget", "0.7", "--set", "volume.resolution=64", "--out", str(file)]
    result = CliRunner().invoke(bench, [*words, *flags], catch_exceptions=False)
    assert result.exit_code == 0
    refused, kept = read_rows(file, "budget")
    assert "below the floor" in refused["refused"]
    assert 0.5 < kept["predicted"]["seconds"] <= 0.7
    assert 0 < kept["flip"] < 0.5
    assert kept["cpu_seconds"] > 0
    assert kept["predicted"]["settled"]["rays"] == kept["predicted"]["chosen"]["gather.rays"]
    assert "of 1 budgets" in result.output


def test_a_stopped_run_goes_on_where_it_stopped(tmp_path, monkeypatch):
    """Each row is in the file before the next is measured; rows of the same commit are not measured again, those of
    changed sources are."""
    measured, file = [], tmp_path / "rows.jsonl"
    stop_at, sources = [3.0], ["abc"]
    predicted = row(1.0)["predicted"]

    def keep(scene, budget, plate, options, size):
        if budget == stop_at[0]:
            raise KeyboardInterrupt
        measured.append(budget)
        return {**{k: row(budget)[k] for k in ("seconds", "cpu_seconds")}, "predicted": predicted, "comp": None}

    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setattr(module, "_keep", keep)
    monkeypatch.setattr(module, "commit", lambda: sources[0])
    monkeypatch.setattr("warp_dvct.bench.rows.commit", lambda: sources[0])
    words = ["budget", "--stage", "colour_bleeding", "--width", "48", "--spp", "0", "--out", str(file)]
    budgets = [word for budget in (1, 2, 3, 4) for word in ("--budget", str(budget))]

    def run() -> str:
        return CliRunner().invoke(bench, [*words, *budgets]).output

    assert "·" not in run()
    assert [r["budget"] for r in read_rows(file, "budget")] == measured == [1.0, 2.0]
    stop_at[0] = 0.0
    output = run()
    assert output.count("·") == 2
    assert "of 4 budgets" in output
    assert [r["budget"] for r in read_rows(file, "budget")] == measured == [1.0, 2.0, 3.0, 4.0]
    for commit, repeated in (("abc", 0), ("abd", 4), ("abd+", 4), ("abd+", 4)):
        sources[0] = commit
        before = len(measured)
        run()
        assert len(measured) - before == repeated, commit
    assert len({r["key"] for r in read_rows(file, "budget")}) == 12


@pytest.mark.parametrize("budget", ["0", "-1", "nan", "inf"])
def test_what_is_no_budget_is_refused_before_the_work(budget, tmp_path, monkeypatch):
    monkeypatch.setattr(module.ReferenceStore, "of", None)  # a truth would take its time
    words = ["budget", "--stage", "colour_bleeding", "--budget", "1", "--budget", budget, "--cache", str(tmp_path)]
    with pytest.raises(OptionError, match=r"--budget is .*; give a positive number"):
        CliRunner().invoke(bench, words, catch_exceptions=False)


@pytest.mark.parametrize("pair", ["gather=cone", "gather.ray=3", "bounces=-1"])
def test_a_wrong_setting_is_no_budget_below_the_floor(pair, tmp_path):
    words = ["budget", "--stage", "colour_bleeding", "--width", "48", "--spp", "0", "--budget", "1", "--set", pair]
    with pytest.raises(OptionError, match=pair.split("=")[0]):
        CliRunner().invoke(bench, [*words, "--out", str(tmp_path / "rows.jsonl")], catch_exceptions=False)
    assert not (tmp_path / "rows.jsonl").exists()


def sweep_row(stage: str, flip: float, noise: float = 0.0, **settings) -> dict:
    """A point of a sweep with a known error."""
    pairs = {k.replace("__", "."): v for k, v in settings.items()}
    row = {"kind": "tradeoff", "stage": stage, "method": "delta-cones", "quality": "balanced", "width": 320}
    row |= {"resolved": asdict(make_settings("balanced", {**REFERENCE, **pairs})), "settings": pairs}
    row |= {"truth": {"noise": noise, "bounces": 8}}
    return {**row, "errors": {"FLIP": {"picture": math.hypot(flip, noise)}}}


def test_a_table_holds_what_the_rows_say():
    """Known errors of two rooms: excess of squared FLIP, noise taken out, dearer values never worse."""
    rows = []
    for stage, base in (("room_area", 0.02), ("room_spot", 0.03)):
        for rays, factor in ((16, 2.0), (64, 1.0), (128, 1.1), (256, 0.8)):
            rays_ = {"gather__rays": rays, "gather__object_rays": rays}
            rows.append(sweep_row(stage, base * factor, noise=0.01, **rays_))
    fit = error_table.fit_table(rows)
    table, pairs = fit.table, fit.points
    values = dict(table.knobs["diffuse"]["gather.rays"])
    assert values[16.0] == pytest.approx(3.0, abs=1e-3)
    assert values[64.0] == values[128.0] == pytest.approx(0.105, abs=1e-3)  # pooled: 1 and 1.21
    assert values[256.0] == pytest.approx(-0.36, abs=1e-3)
    for name, measured, predicted in pairs:
        assert predicted == pytest.approx(measured, rel=0.35), name
    assert table.spread < 0.3


def test_a_table_knows_cones_and_missing_bounces():
    """By cones: their number and what asks for them; bounces are fitted to what the survey says of them."""
    rows = []
    for stage, base in (("room_area", 0.02), ("colour_bleeding", 0.06)):
        rows.append(sweep_row(stage, base))
        rows += [sweep_row(stage, base * f, gather="cones", cones__count=n) for n, f in ((4, 3.0), (9, 2.0))]
        rows.append(sweep_row(stage, base * 1.5, shadows="cone"))
        rows.append(sweep_row(stage, base * 4.0, bounces=1))
    fit = error_table.fit_table(rows)
    table, pairs = fit.table, fit.points
    assert table.knobs["diffuse"]["cones.count"] == [[4.0, 8.0], [9.0, 3.0]]
    assert table.knobs["diffuse"]["shadows=cone"] == [[1.0, 1.25]]
    assert table.base["bounces"] > 0
    cones = make_settings("balanced", {**REFERENCE, "gather": "cones", "cones.count": 9, "shadows": "cone"})
    plain = make_settings("balanced", REFERENCE)
    scene = read(stage_file("room_area"))
    found = survey(scene, make_settings(), Launcher("cpu"), scene.camera.aspect, has_plate=True)
    ratio = table.error(cones, found, 320) / table.error(plain, found, 320)
    assert ratio == pytest.approx(math.sqrt(1.0 + 3.0 + 1.25), abs=1e-3)
    for name, measured, predicted in pairs:
        assert predicted == pytest.approx(measured, rel=0.6), name


def test_noise_decides_and_outlines_are_left_where_there_is_none():
    """FLIP in proportion to the noise that a survey sees comes back, each stage from the others too; the furnace, where
    every ray brings the same light, says what outlines cost and nothing else."""
    rows = []
    for stage in ("room_area", "colour_bleeding", "ground_dome", "bunny"):
        scene = read(stage_file(stage))
        noise = survey(scene, make_settings(), Launcher("cpu"), scene.camera.aspect, has_plate=True).noise
        assert noise > 0.005
        rows += [sweep_row(stage, 0.8 * noise), sweep_row(stage, 1.6 * noise, gather__rays=16, gather__object_rays=16)]
    rows += [sweep_row("furnace", flip, antialias=n) for n, flip in ((0, 0.002), (8, 0.002 * 9**-0.7))]
    fit = error_table.fit_table(rows)
    assert set(fit.unseen) == {"room_area", "colour_bleeding", "ground_dome", "bunny"}
    for stage, (flip, expected) in fit.unseen.items():
        assert expected == pytest.approx(flip, rel=0.3), stage
    for name, measured, predicted in fit.points:
        assert predicted == pytest.approx(measured, rel=0.02 if "furnace" in name else 0.15), name
    assert fit.table.base["noise"] > 0.7


def test_a_table_needs_a_base_and_a_knob():
    with pytest.raises(OptionError, match="no stage has the reference point"):
        error_table.fit_table([sweep_row("room_area", 0.02, gather__rays=16, gather__object_rays=16)])
    with pytest.raises(OptionError, match="no knob was swept"):
        error_table.fit_table([sweep_row("room_area", 0.02)])


def test_the_command_writes_a_table(tmp_path):
    rows = [sweep_row("room_area", 0.02), sweep_row("room_area", 0.03, antialias=0)]
    for made in rows:
        append_row(tmp_path / "rows.jsonl", made)
    out = tmp_path / "table.json"
    words = ["error-table", str(tmp_path / "rows.jsonl"), "--out", str(out)]
    result = CliRunner().invoke(bench, words, catch_exceptions=False)
    assert "2 points; predicted within a factor of 1.5: 2" in result.output
    assert json.loads(out.read_text())["knobs"]["diffuse"]["antialias"] == [[0.0, 1.25], [8.0, 0.0]]

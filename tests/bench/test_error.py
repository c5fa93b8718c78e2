"""``bench error`` end to end on tiny pictures, and what it prints."""

import json
import math
import subprocess
import sys

import numpy as np
import OpenImageIO as oiio
import pytest
from click.testing import CliRunner

from warp_dvct.bench import error as module
from warp_dvct.bench.__main__ import bench, settings_of
from warp_dvct.bench.error import DIRECT, PASTED, Block, ErrorOptions, Report, Row
from warp_dvct.errors import OptionError
from warp_dvct.usd_scenes import path

WIDTH, SPP = 64, 32


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """References that the tests of this file share."""
    return tmp_path_factory.mktemp("references")


def measure(stage, cache, **options):
    return module.measure(stage, ErrorOptions(width=WIDTH, samples=SPP, bounces=3, cache=cache, **options))


def flips(block):
    return {row.name: row.errors["FLIP"]["picture"] for row in block.rows}


def test_converged_path_tracing_beats_the_baselines_and_the_regions_are_there(cache):
    """The same picture from other random numbers: its distance is noise, the baselines' is what they leave out."""
    report = measure("room_glossy", cache, method="path-trace", settings={"samples": "32", "seed": "5", "bounces": "3"})
    assert (report.width, report.height) == (64, 36)
    assert [b.truth_bounces for b in report.blocks] == [1, 3]
    for block in report.blocks:
        method, pasted, direct = flips(block)
        assert [method, pasted, direct] == ["path-trace balanced", PASTED, DIRECT]
        values = flips(block)
        assert values[method] < 0.75 * min(values[pasted], values[direct])
        assert block.pixels["object"] > 0
        assert block.pixels["reflection"] > 0
        assert block.pixels["object"] < block.pixels["affected"] < block.pixels["picture"] == 64 * 36
        assert block.rows[0].seconds > 0


def test_delta_cones_is_measured_against_both_truths(cache, tmp_path):
    report = measure("room_area", cache, quality="draft", out=tmp_path)
    for block in report.blocks:
        method, pasted, _direct = flips(block)
        assert flips(block)[method] < flips(block)[pasted], "inserting light must beat pasting"
        assert math.isnan(block.rows[0].errors["FLIP"]["reflection"]), "nothing in this room is glossy"
        assert block.rows[1].seconds is None
    expected = {f"room_area_{bounces}_{what}.png" for bounces in (1, 3) for what in ("truth", "comp", "flip")}
    assert {f.name for f in tmp_path.iterdir()} == expected
    picture = oiio.ImageBuf(str(tmp_path / "room_area_1_truth.png")).get_pixels(oiio.UINT8)
    assert picture.shape == (36, 64, 3)
    assert 40 < picture.mean() < 230


@pytest.mark.parametrize("stage", module.LIT_STAGES)
def test_balanced_is_close_to_the_truth_on_every_lit_stage(stage, cache, monkeypatch):
    """FLIP at most .06 at equal bounces, far below both baselines; a small picture and a noisy truth only add."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    options = ErrorOptions(width=96, samples=64, bounces=4, cache=cache)
    equal, many = (flips(block) for block in module.measure(stage, options).blocks)
    assert equal["delta-cones balanced"] <= 0.06
    assert many["delta-cones balanced"] <= 0.08
    for values in (equal, many):
        assert values["delta-cones balanced"] < 0.7 * min(values[PASTED], values[DIRECT])


def test_plate_pixels_that_nothing_changes_have_no_error(cache):
    """The plate is the truth's own 'before': outside of the affected pixels the pasted object has next to no error."""
    report = measure("ground_dome", cache, quality="draft")
    for block in report.blocks:
        pasted = block.rows[1].errors["RMSE"]
        affected = block.pixels["affected"] / block.pixels["picture"]
        outside = (pasted["picture"] ** 2 - affected * pasted["affected"] ** 2) / (1 - affected)
        assert math.sqrt(max(outside, 0)) < 0.01


def test_command_prints_the_table_and_writes_json(cache, tmp_path):
    file = tmp_path / "figures.json"
    arguments = ["error", "--stage", "room_area", "--quality", "draft", "--width", str(WIDTH), "--spp", str(SPP)]
    arguments += ["--bounces", "3", "--cache", str(cache), "--json", str(file), "--set", "gather.rays=8"]
    result = CliRunner().invoke(bench, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert "room_area 64x36, equal bounces: truth of 1 bounce(s), 32 spp" in result.output
    assert "many bounces: truth of 3" in result.output
    for word in ("FLIP", "RMSE", "relMSE", PASTED, DIRECT, "affected", "shadow", "bounce", "reflection"):
        assert word in result.output
    content = json.loads(file.read_text())
    assert content["options"]["settings"] == {"gather.rays": "8"}
    rows = content["stages"][0]["blocks"][0]["rows"]
    assert rows[0]["errors"]["FLIP"]["picture"] > 0
    assert rows[0]["errors"]["FLIP"]["reflection"] is None


def test_user_errors_end_in_one_line_and_status_1(tmp_path):
    for arguments, message in (
        (["--stage", "room_aera"], "did you mean 'room_area'"),
        (["--stage", str(tmp_path / "none.usda")], "none.usda"),
        (["--stage", "room_area", "--width", "8"], "--width is 8"),
        (["--stage", "room_area", "--set", "bounces"], "not KEY=VALUE"),
    ):
        done = subprocess.run(
            [sys.executable, "-m", "warp_dvct.bench", "error", *arguments], capture_output=True, text=True
        )
        assert done.returncode == 1
        assert message in done.stderr
        assert "Traceback" not in done.stderr


def test_stage_by_name_or_file(tmp_path):
    assert module.stage_file("room_spot") == path("room_spot")
    assert module.stage_file(str(tmp_path / "my.usda")) == tmp_path / "my.usda"
    with pytest.raises(OptionError, match="bundled are"):
        module.stage_file("my_room")


def test_default_stages_are_bundled():
    for stage in module.LIT_STAGES:
        assert path(stage).is_file()


def test_settings_of():
    assert settings_of(("a.b=1", "c=x=y")) == {"a.b": "1", "c": "x=y"}
    with pytest.raises(OptionError, match="KEY=VALUE"):
        settings_of(("=3",))


def test_format_report_lines_up():
    errors = {metric: dict.fromkeys(module.AREAS, 0.125) for metric in module.METRICS}
    errors["FLIP"]["reflection"] = math.nan
    pixels = dict.fromkeys(module.AREAS, 50) | {"picture": 100}
    block = Block("equal bounces", 1, 32, 0.004, pixels, [Row("method", 1.5, errors), Row(PASTED, None, errors)])
    head, columns, share, flip, rmse, *_ = module.format_report(Report("room", 64, 36, [block])).splitlines()
    assert head.endswith("its noise is FLIP 0.0040")
    assert len(columns) == len(share) == len(flip) == len(rmse)
    assert flip.split() == ["method", "1.50", "FLIP", *["0.1250"] * 5, "-"]
    assert share.split()[-6:] == ["100.0%", *["50.0%"] * 5]


def test_baselines_are_what_they_say(cache):
    """Recomputed from the cached truths: pasted is the direct light's object on the plate, nothing else."""
    options = ErrorOptions(width=WIDTH, samples=SPP, bounces=3, cache=cache, quality="draft")
    report = module.measure("room_area", options)
    scene = module.read(path("room_area"))
    from warp_dvct.launch import Launcher

    store = module.ReferenceStore(scene, 64, 36, samples=SPP, seed=1, cache=cache, launcher=Launcher("cpu"), quiet=True)
    truth, direct = store.get(1), store.get(0)
    pasted = direct.synthetic[..., :3] + (1 - direct.coverage[..., None]) * truth.before
    expected = np.sqrt(np.mean((pasted - truth.comp).astype(np.float64) ** 2))
    assert report.blocks[0].rows[1].errors["RMSE"]["picture"] == pytest.approx(expected, rel=1e-4)

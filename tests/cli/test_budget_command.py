"""``--budget``, ``--max-error`` and ``calibrate`` as commands."""

from __future__ import annotations

import json
import re

import pytest

from warp_dvct.cost_model import DEFAULT_FILE, model_file

pytestmark = pytest.mark.cpu  # costs of a GPU are known only once it is calibrated


@pytest.fixture(autouse=True)
def uncalibrated(tmp_path, monkeypatch):
    """A user who has never calibrated, on a machine that is as fast as ever."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setattr("warp_dvct.planning._slowness", lambda *args: 1.0)


def test_relight_says_what_it_chose(command, room, tmp_path):
    stats = tmp_path / "stats.json"
    arguments = ["-w", 64, "--budget", 0.4, "--set", "bounces=1", "--set", "volume.resolution=32", "--stats", stats]
    result = command("relight", room, tmp_path / "a.exr", *arguments)
    assert result.code == 0, result.err
    assert re.search(r"predicted: 0\.3[4-9] s .*FLIP 0\.", result.err)
    assert "bounces=1: given" in result.err
    budget = json.loads(stats.read_text())["budget"]
    assert budget["seconds"] <= 0.4
    assert not budget["enough"]
    assert budget["chosen"]["gather.rays"] == json.loads(stats.read_text())["plan"]["settings"]["gather_rays"]


def test_plan_prints_the_choice(command, room):
    shown = command("plan", room, "-w", 64, "--max-error", 0.08)
    assert shown.code == 0, shown.err
    assert "predicted: " in shown.out
    content = json.loads(command("plan", room, "-w", 64, "--max-error", 0.08, "--json").out)
    assert 0 < content["budget"]["error"] <= 0.08


@pytest.mark.parametrize(
    ("flags", "code", "message"),
    [
        (("--budget", 0.001), 1, "below the floor"),
        (("--budget", 0), 1, "positive number"),
        (("--budget", "soon"), 2, "not a valid float"),
        (("--budget", 1, "--max-error", 0.1), 1, "not both"),
        (("--budget", 1, "--quality", "draft"), 2, "--quality"),
        (("--max-error", 1e-6), 1, "below what delta-cones reaches"),
        (("--budget", 0.01, "--method", "instant-radiosity"), 1, "below the floor"),
        (("--max-error", 1e-6, "--method", "instant-radiosity"), 1, "below what instant-radiosity reaches"),
    ],
)
def test_requests_that_cannot_be_kept(flags, code, message, command, room, tmp_path):
    result = command("relight", room, tmp_path / "a.exr", "-w", 48, *flags)
    assert result.code == code
    assert message in result.err
    assert not (tmp_path / "a.exr").exists()


def test_a_broken_model_is_named(command, room):
    file = model_file("cpu")
    file.parent.mkdir(parents=True)
    file.write_text(DEFAULT_FILE.read_text()[:-9])
    result = command("plan", room, "-w", 48, "--budget", 2)
    assert result.code == 1
    assert f"{file} is no cost model" in result.err


def test_calibrate_keeps_a_model(command, room, monkeypatch):
    from warp_dvct import calibrate as module

    monkeypatch.setattr(module, "STAGES", ("colour_bleeding",))
    monkeypatch.setattr(module, "WIDTHS", (24,))
    result = command("calibrate", "--frames", 4)
    assert result.code == 0, result.err
    assert str(model_file("cpu")) in result.out
    assert "another machine" not in command("plan", room, "-w", 48, "--budget", 60).out
    assert command("calibrate", "--out", "/nowhere/cost.json").code == 1
    assert command("calibrate", "--frames", 1).code == 1

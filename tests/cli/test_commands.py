"""The smaller commands, and the progress display."""

from __future__ import annotations

import io
import json
from importlib.metadata import version

import click
import pytest

from warp_dvct import relighter, settings, usd_scenes
from warp_dvct.cli import options, progress
from warp_dvct.cli.progress import Progress
from warp_dvct.cli.relight import relight
from warp_dvct.cli.warmup import kernel_modules
from warp_dvct.passes.tonemap import CURVES
from warp_dvct.usd import refine


def test_choices_are_those_of_the_package():
    """They are written down twice, so that --help starts neither Warp nor USD."""
    assert options.METHODS == relighter.METHODS
    assert options.QUALITIES == settings.QUALITIES
    assert options.COMPLEXITIES == refine.COMPLEXITIES
    (curve,) = (option for option in relight.params if option.name == "curve")
    assert isinstance(curve.type, click.Choice)
    assert tuple(curve.type.choices) == tuple(CURVES)


def test_settings_are_listed(command):
    listing = command("settings").out.splitlines()
    assert [line.partition("=")[0] for line in listing] == list(settings.NAMES)


def test_help_and_version(command):
    assert "relight" in command("--help").out
    assert "--frames" in command("relight", "-h").out
    assert version("warp-dvct") in command("--version").out
    assert command("relit").code == 2


def test_scenes_are_listed_with_their_intent_and_found_by_name(command):
    listing = command("scenes").out.splitlines()
    assert [line.split()[0] for line in listing] == usd_scenes.names()
    assert all(len(line.split()) > 4 for line in listing)
    assert command("scenes", "room_area").out.strip() == str(usd_scenes.path("room_area"))
    wrong = command("scenes", "room_arae")
    assert wrong.code == 1
    assert "room_area" in wrong.err


def test_plan_says_what_is_left_out_and_why(command, room):
    text = command("plan", room, "--quality", "draft").out
    assert "needed" in text
    assert "left out" in text
    data = json.loads(command("plan", room, "--quality", "draft", "--json").out)
    assert data["width"] == 640


def test_plan_lists_what_is_not_modelled(command, moving_room):
    assert "not modelled: /World/Synthetic/Crate" in command("plan", moving_room, "--camera", "Close").out


@pytest.mark.cpu
def test_warmup_loads_every_kernel_module(command):
    result = command("warmup")
    assert result.code == 0
    assert result.out.startswith(f"{len(kernel_modules())} kernel modules are ready on cpu")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_terminals_get_a_bar(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(progress.sys, "stderr", screen)
    with Progress("a.exr") as shown:
        shown.update("gather", 0.25)
        shown.update("gather", 0.5)
    text = screen.getvalue()
    assert "a.exr: gather" in text
    assert "50%" in text
    assert "\n" not in text.strip("\r\n")


def test_others_get_few_plain_lines(capsys):
    with Progress("a.exr") as shown:
        for i in range(1000):
            shown.update("trace", i / 1000)
        shown.update("trace", 1.0)
    lines = capsys.readouterr().err.splitlines()
    assert 8 <= len(lines) <= 10
    assert lines[0] == "a.exr: 10% (trace)"

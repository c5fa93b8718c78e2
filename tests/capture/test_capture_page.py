"""Every command of the page on captures is run, in its order."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import datasets as data

from warp_dvct.capture.importers import import_capture
from warp_dvct.capture.stage import open_capture
from warp_dvct.cli import cli

PAGE = Path(__file__).parents[2] / "docs" / "captures.md"


def test_the_commands_run(tmp_path):
    data.redwood(tmp_path / "scan")
    text = PAGE.read_text()
    commands = [line for block in re.findall(r"^```sh\n(.*?)^```", text, re.M | re.S) for line in block.splitlines()]
    assert len(commands) >= 3
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for command in commands:
        small = f"{command} --quality draft" if " relight " in command else command
        done = subprocess.run(
            ["bash", "-euc", small],
            cwd=tmp_path,
            env={**os.environ, "PATH": path},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
    for file in ("capture.usda", "room/capture.usda", "room/truth.usda", "live.0002.exr", "live.0002.png"):
        assert (tmp_path / file).exists(), file


def test_the_options_of_the_page_exist():
    text = PAGE.read_text()
    known = {o for command in ("capture", "relight") for o in options(command)}
    for option in re.findall(r"`(--[a-z-]+)", text):
        assert option in known, option


def options(name: str) -> list[str]:
    """Long options of a command and of those below it."""
    found, waiting = [], [cli.commands[name]]
    while waiting:
        command = waiting.pop()
        waiting += list(getattr(command, "commands", {}).values())
        found += [o for p in command.params for o in p.opts if o.startswith("--")]
    return found


def test_the_stage_is_the_one_of_the_page(tmp_path):
    import_capture(data.redwood(tmp_path / "scan"), tmp_path / "capture.usda")
    capture = open_capture(tmp_path / "capture.usda")
    assert {capture.depth_path, capture.color_path} <= set(re.findall(r"/Capture[\w/]*", PAGE.read_text()))

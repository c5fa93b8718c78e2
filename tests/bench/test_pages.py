"""The pages of the benches: their commands are understood, their links and pictures are there, sizes are kept."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest

from warp_dvct.bench.__main__ import bench
from warp_dvct.bench.effects import FAILURES
from warp_dvct.cli import cli

ROOT = Path(__file__).parents[2]
PAGES = ("docs/tradeoff.md", "docs/choosing.md")
LARGEST = 200_000  # bytes of a picture


def commands() -> list[str]:
    """Lines of shell blocks."""
    fence = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
    found = [m.group(1) for page in PAGES for m in fence.finditer((ROOT / page).read_text())]
    return sorted({line.partition(" #")[0].strip() for block in found for line in block.splitlines() if line.strip()})


@pytest.mark.parametrize("line", commands())
def test_a_command_is_understood(line):
    """Its name exists and click takes its arguments; what it does has tests of its own."""
    words = shlex.split(line)
    group: click.Group = cli
    if words[:3] == ["python", "-m", "warp_dvct.bench"]:
        group, words = bench, words[3:]
    elif words[:2] == ["warp-dvct", "bench"]:
        group, words = bench, words[2:]
    else:
        assert words[0] == "warp-dvct", line
        words = words[1:]
    parent = click.Context(group, **group.context_settings)  # commands keep the help options of the first they see
    command = group.get_command(parent, words[0])
    assert command is not None, line
    command.make_context(words[0], words[1:], parent=parent)


def test_links_and_pictures_are_there():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", (ROOT / page).read_text()):
            assert (ROOT / page).parent.joinpath(target).exists(), f"{page}: {target}"


def test_every_failure_is_shown_beside_its_truth():
    text = (ROOT / "docs/choosing.md").read_text()
    for name in [*FAILURES, "thin_walls"]:
        picture = ROOT / "docs/images" / f"failure_{name}.jpg"
        assert f"images/{picture.name}" in text
        assert 2000 < picture.stat().st_size < LARGEST
    assert (ROOT / "docs/images/figure3.jpg").stat().st_size < LARGEST


def test_every_bench_is_documented():
    text = "".join(path.read_text() for path in (ROOT / "docs").glob("*.md"))
    for name in bench.commands:
        assert re.search(rf"bench {name}\b", text), name

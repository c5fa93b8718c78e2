"""Files that a bench would write: what cannot be is found out before anything is rendered."""

from __future__ import annotations

import pytest
from click.testing import CliRunner

from warp_dvct.bench.__main__ import bench
from warp_dvct.errors import FileError

WRITERS = {
    "error": ["error", "--json"],
    "eq9": ["eq9", "--json"],
    "peers": ["peers", "--json"],
    "motion": ["motion", "--json"],
    "table1": ["table1", "--json"],
    "figure3": ["figure3"],
}


@pytest.mark.parametrize("words", WRITERS.values(), ids=WRITERS)
def test_files_in_folders_that_are_not_there(words, tmp_path):
    result = CliRunner().invoke(bench, [*words, str(tmp_path / "none" / "figure.png")])
    assert isinstance(result.exception, FileError)
    assert "none does not exist; create it" in str(result.exception)
    assert list(tmp_path.iterdir()) == []


def test_folders_and_unknown_endings(tmp_path):
    result = CliRunner().invoke(bench, ["error", "--json", str(tmp_path)])
    assert "is a folder" in str(result.exception)
    result = CliRunner().invoke(bench, ["figure3", str(tmp_path / "figure.txt")])
    assert result.exit_code == 2
    assert "'.png', '.jpg'" in result.output or ".png or .jpg" in result.output


@pytest.mark.parametrize("command", [["eq9"], ["figure3", "f.png"]])
def test_pictures_without_a_pixel(command):
    result = CliRunner().invoke(bench, [*command, "--width", "0"])
    assert result.exit_code == 2
    assert "--width" in result.output

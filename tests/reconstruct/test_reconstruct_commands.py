"""The commands as a stranger would try them."""

from __future__ import annotations

from pathlib import Path

import pytest

from warp_dvct.cli import _run


@pytest.fixture
def command(capfd):
    def run(*arguments: object) -> tuple[int, str, str]:
        code = _run([str(a) for a in arguments])
        captured = capfd.readouterr()
        return code, captured.out, captured.err

    return run


def test_reconstruct_place_and_read_back(command, room_capture, tmp_path):
    from warp_dvct.scene import Role
    from warp_dvct.usd.read import read_stage

    scene, shot = tmp_path / "scene.usda", tmp_path / "shot.usda"
    code, out, err = command("reconstruct", room_capture.path, "-o", scene, "--voxel", 0.06, "--no-light")
    assert code == 0, err
    assert "12 of 12 frames" in out
    code, out, err = command(
        "capture", "place", scene, "bunny", "--pixel", "80,100", "--frame", 6, "--height", 0.3, "-o", shot
    )
    assert code == 0, err
    assert "/Synthetic/bunny stands at" in out
    meshes = read_stage(shot, allow_no_light=True).meshes
    assert {m.role for m in meshes} == {Role.REAL, Role.SYNTHETIC}


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["reconstruct", "absent.usda", "-o", "x.usda"], 1, "'absent.usda' does not exist"),
        (["reconstruct", "CAPTURE", "-o", "x.obj"], 2, "must end in .usda"),
        (["reconstruct", "CAPTURE", "-o", "CAPTURE"], 1, "give another name"),
        (["reconstruct", "CAPTURE", "-o", "nowhere/x.usda"], 1, "the folder nowhere does not exist"),
        (["reconstruct", "CAPTURE", "-o", "x.usda", "--voxel", "0"], 2, "--voxel"),
        (["reconstruct", "CAPTURE", "-o", "x.usda", "--near", "3", "--far", "2"], 1, "give 0 <= near < far"),
        (["reconstruct", "CAPTURE", "-o", "x.usda", "--markers"], 2, "--marker-size"),
        (["reconstruct", "CAPTURE", "-o", "x.usda", "--no-light", "--estimate-light"], 2, "--no-light"),
        (["capture", "place", "CAPTURE", "bunny", "-o", "x.usda"], 2, "either --pixel U,V or --marker ID"),
        (["capture", "place", "CAPTURE", "bunny", "-o", "x.usda", "--pixel", "3"], 2, "a column and a row"),
        (["capture", "place", "CAPTURE", "bunny", "-o", "x.usda", "--marker", "3"], 2, "--marker-size"),
        (["capture", "place", "CAPTURE", "no.usd", "-o", "x.usda", "--pixel", "3,4"], 1, "'no.usd' does not exist"),
        (["capture", "place", "CAPTURE", "bunny", "-o", "x.usda", "--pixel", "3,400"], 1, "outside of the 160 x 120"),
        (["capture", "place", "CAPTURE", "bunny", "-o", "x.usda", "--pixel", "3,4", "--color", "2,0,0"], 2, "--color"),
    ],
)
def test_wrong_use_is_explained(command, room_capture, tmp_path, monkeypatch, arguments, code, words):
    monkeypatch.chdir(tmp_path)
    before = Path(room_capture.path).read_text()
    got, _, err = command(*(room_capture.path if a == "CAPTURE" else a for a in arguments))
    assert got == code, err
    assert words in err
    assert "Traceback" not in err
    assert not list(tmp_path.iterdir())
    assert Path(room_capture.path).read_text() == before

"""Bad input: one line that names the trouble, the documented exit code, nothing half-written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from warp_dvct.cli.relight import Run
from warp_dvct.image import write_png

SMALL = ("-w", 32, "--quality", "draft")


@pytest.fixture
def out(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    return folder


def refuse(result, code, *words):
    """Check exit code, the message's form and that it contains ``words``."""
    assert result.code == code, result.err
    if code == 1:
        assert result.err.startswith("warp-dvct: error: ")
        assert result.err.count("\n") == 1
    for word in words:
        assert word in result.err, result.err


def test_frames_need_a_place_in_the_name_and_a_place_needs_frames(command, room, out):
    refuse(command("relight", room, out / "a.exr", "--frames", "1:2"), 2, "a.####.exr")
    refuse(command("relight", room, out / "a.##.exr"), 2, "--frames")
    refuse(command("relight", room, out / "a.##.exr", "--frames", "1:2x0.5"), 2, "1.5", "a.####.##.exr")
    refuse(command("relight", room, out / "a.png"), 2, "a.png", ".exr")
    refuse(command("relight", room, out / "a.##.exr", "--frames", "one"), 1, "'one'")
    assert not list(out.iterdir())


def test_missing_and_corrupt_stages(command, out):
    refuse(command("relight", "none.usda", out / "a.exr"), 1, "none.usda", "does not exist")
    (out / "bad.usda").write_text("#usda 1.0\ndef {")
    refuse(command("relight", out / "bad.usda", out / "a.exr"), 1, "bad.usda")
    assert [file.name for file in out.iterdir()] == ["bad.usda"]


def test_output_folder_is_checked_before_anything_else(command, out):
    refuse(command("relight", "none.usda", out / "missing" / "a.exr"), 1, "missing", "create it")
    refuse(command("relight", "none.usda", "/proc/a.exr"), 1, "/proc/a.exr", "cannot be written")
    refuse(command("relight", "none.usda", out / "a.exr", "--stats", out / "no" / "s.json"), 1, "s.json")


def test_plates_that_do_not_fit(command, room, out):
    write_png(out / "square.png", np.zeros((32, 32, 3), np.uint8))
    plate = ("--plate", out / "square.png")
    refuse(command("relight", room, out / "a.exr", *plate), 1, "square.png", "32 x 32", "32 x 18", "/World/Camera")
    refuse(command("relight", room, out / "a.exr", *plate, "-w", 64), 1, "square.png", "32 x 32", "--imageWidth 64")
    refuse(command("relight", room, out / "a.exr", "--plate", out / "none.png"), 1, "none.png")
    assert [file.name for file in out.iterdir()] == ["square.png"]


def test_cameras_to_choose_from_are_listed(command, moving_room, out):
    refuse(command("relight", moving_room, out / "a.exr"), 1, "--camera", "/World/Camera", "/World/Close")
    refuse(command("relight", moving_room, out / "a.exr", "-cam", "Far"), 1, "Far", "/World/Close")


def test_settings(command, room, out):
    refuse(command("relight", room, out / "a.exr", "--set", "bouncs=2"), 1, "bouncs", "bounces")
    refuse(command("relight", room, out / "a.exr", "--set", "bounces"), 2, "KEY=VALUE")
    refuse(command("relight", room, out / "a.exr", "--set", "bounces=many"), 1, "bounces", "many")
    refuse(command("relight", room, out / "a.exr", "--quality", "best"), 2, "balanced")
    refuse(command("relight", room, out / "a.exr", "-w", "0"), 2, "0")
    refuse(command("relight", room, out / "a.exr", "--purposes", "render,proxies"), 2, "proxies", "guide")
    refuse(command("relight", room, out / "a.exr", "--exposure", "nan"), 2, "nan")
    assert not list(out.iterdir())


def test_pictures_that_no_machine_holds(command, room, out):
    """Counted beyond 32 bits, or larger than the memory: refused before anything is rendered."""
    refuse(command("relight", room, out / "a.exr", "-w", 10**8), 1, "100000000 x 56250000", "--imageWidth")
    if os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") < 20 * 2**30:
        refuse(command("relight", room, out / "a.exr", "-w", 21840), 1, "21840 x 12285", "GiB", "--imageWidth")
    assert not list(out.iterdir())


def test_absent_devices_are_named_with_those_present(command, room, out):
    refuse(command("relight", room, out / "a.exr", "--device", "cuda:99"), 1, "cuda:99", "cpu")
    refuse(command("warmup", "--device", "gpu"), 1, "gpu", "cpu")


def test_a_stage_without_anything_synthetic_or_real_says_how_to_tag(command, room, out):
    refuse(command("relight", room, out / "a.exr", "--real", "/World"), 1, "synthetic", "primvars:dvct:reality")
    refuse(command("relight", room, out / "a.exr", "--synthetic", "/World"), 1, "real", "primvars:dvct:reality")


def test_strict_makes_notices_an_error(command, moving_room, out):
    arguments = ("relight", moving_room, out / "a.exr", *SMALL, "-cam", "Camera", "--strict")
    refuse(command(*arguments), 1, "/World/Synthetic/Crate")
    assert not list(out.iterdir())


def test_running_out_of_memory_is_an_error_like_others(command, room, out, monkeypatch):
    def exhaust(*_):
        raise MemoryError

    monkeypatch.setattr(Run, "render", exhaust)
    refuse(command("relight", room, out / "a.exr"), 1, "out of memory", "--imageWidth")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_runs_leave_nothing(room, out, number, code):
    script = "from warp_dvct.cli import main; main()"
    arguments = ["relight", str(room), str(out / "a.exr"), "-w", "64", "--method", "path-trace"]
    process = subprocess.Popen(
        [sys.executable, "-c", script, *arguments, "--set", "samples=4000"],
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        # A shell that runs the tests in the background hands SIGINT down as ignored; a user's terminal does not.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stderr is not None
    try:
        assert b"%" in process.stderr.readline()  # it is at work
        process.send_signal(number)
        assert process.wait(timeout=60) == code
    finally:
        process.kill()
        process.stderr.close()
    assert not list(out.iterdir())

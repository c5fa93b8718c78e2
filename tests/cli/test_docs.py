"""Every command and example of the documentation is run, or, where it sets up machines, checked against the sources."""

from __future__ import annotations

import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from warp_dvct.image import write_png

ROOT = Path(__file__).parents[2]
PAGES = (
    "README.md",
    "docs/index.md",
    "docs/usage.md",
    "docs/layers.md",
    "docs/reconstruct.md",
    "docs/numerics.md",
    "docs/cuda.md",
)
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)#\s]+)[^)]*\)|src=\"([^\"]+)\"")
SMALL = "-w 32 --quality draft"


def blocks(language: str) -> list:
    """Fenced blocks of a language with an id that says where they are."""
    found = []
    for page in PAGES:
        matches = [m.group(2) for m in FENCE.finditer((ROOT / page).read_text()) if m.group(1) == language]
        found += [pytest.param(text, id=f"{Path(page).stem}-{i}") for i, text in enumerate(matches)]
    return found


def lines() -> list:
    """Shell commands, without comments."""
    commands = [line.partition(" #")[0].strip() for block in blocks("sh") for line in block.values[0].splitlines()]
    return sorted({command for command in commands if command})


@pytest.fixture(scope="session")
def captured(tmp_path_factory) -> Path:
    """A folder with a simulated capture, lights for it, and what is made of it."""
    from warp_dvct import usd_scenes
    from warp_dvct.capture.noise import KinectNoise
    from warp_dvct.capture.simulate import Simulation, simulate

    folder = tmp_path_factory.mktemp("captured")
    options = Simulation(frames=2, path="handheld", noise=KinectNoise.only())
    simulate(usd_scenes.path("room_area"), folder, options)
    (folder / "lights.usda").write_text(
        '#usda 1.0\n(\n    defaultPrim = "Lights"\n    metersPerUnit = 1\n    upAxis = "Y"\n)\n'
        'def Xform "Lights"\n{\n    def DomeLight "Dome"\n    {\n    }\n}\n'
    )
    for command in (
        "reconstruct capture.usda -o scene.usda --voxel 0.05 --probe lights.usda --albedo color",
        "capture place scene.usda bunny --pixel 320,420 --height 0.25 -o placed.usda",
    ):
        done = shell(f"warp-dvct {command}", folder)
        assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def workplace(tmp_path, shot, request) -> Path:
    """A folder with the files that the examples name."""
    command = request.node.callspec.params.get("command", "")
    if any(name in command for name in ("capture.usda", "scene.usda", "placed.usda")):
        shutil.copytree(request.getfixturevalue("captured"), tmp_path, dirs_exist_ok=True)
    if " import scan " in command:
        runpy.run_path(str(ROOT / "tests" / "capture" / "datasets.py"))["redwood"](tmp_path / "scan")
    for name in ("photo.png", "photo.0001.png", "photo.0002.png", "photo.0003.png"):
        write_png(tmp_path / name, np.full((18, 32, 3), 90, np.uint8))
    return tmp_path


def shell(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(
        ["bash", "-euc", command], cwd=folder, env={**os.environ, "PATH": path}, capture_output=True, text=True
    )


def test_there_is_something_to_check():
    assert len(lines()) > 15
    assert len(blocks("python")) >= 3


@pytest.mark.parametrize("command", lines())
def test_shell_command(command, workplace):
    command = command.replace(".venv/bin/", "")
    if command.startswith("make "):
        check_make_target(command.split()[1])
    elif command.startswith(("pip install ", "python3 -m venv ")):
        check_installation(command)
    elif command.startswith(("python -m warp_dvct.bench ", "warp-dvct bench ", "warp-dvct calibrate")):
        check_bench(command, workplace)
    else:
        assert command.startswith("warp-dvct "), command
        # Smaller than shown, for speed: of an option given twice the last counts.
        done = shell(f"{command} {smaller(command)}", workplace)
        assert done.returncode == 0, done.stderr
        for output in re.findall(r" ([\w.#]+\.exr)", command):
            assert list(workplace.glob(output.replace("#", "?"))), f"{output} was not written"


def smaller(command: str) -> str:
    """Options that make a command quick."""
    if " relight " in command and "placed.usda" in command:
        return "--quality draft"  # its plate is not resampled
    if " relight " in command:
        return "-w 32" if "--budget" in command or "--max-error" in command else SMALL
    return "--voxel 0.08" if " reconstruct " in command else ""


def check_make_target(target: str) -> None:
    """The target exists, and all that it would run can be parsed."""
    done = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert subprocess.run(["bash", "-n"], input=done.stdout, text=True).returncode == 0


def check_installation(command: str) -> None:
    """What would be installed is here: a project of ours with the extras that are named."""
    if command.startswith("pip install "):
        target = command.split()[-1].strip("'\"")
        assert re.fullmatch(r"\.(\[\w+\])?", target), command
        extra = target[2:-1]
        assert not extra or f"\n{extra} = [" in (ROOT / "pyproject.toml").read_text()
    else:
        assert command == "python3 -m venv .venv"


def check_bench(command: str, folder: Path) -> None:
    """What measures the machine knows the options; to run it takes minutes."""
    words = command.split()
    named = {"python": 4, "warp-dvct": 3 if words[1] == "bench" else 2}[words[0]]
    done = shell(" ".join([*words[:named], "--help"]), folder)
    assert done.returncode == 0, done.stderr
    for option in words[named:]:
        assert not option.startswith("--") or option in done.stdout, f"{option} is unknown"


@pytest.mark.parametrize("source", blocks("python"))
def test_python_example(source, workplace):
    done = subprocess.run([sys.executable, "-c", source], cwd=workplace, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout


@pytest.mark.parametrize("source", blocks("usda"))
def test_usd_example(source, tmp_path):
    from pxr import Usd

    (tmp_path / "example.usda").write_text(f"#usda 1.0\n{source}")
    assert Usd.Stage.Open(str(tmp_path / "example.usda")).GetPseudoRoot().GetChildren()


def test_links_lead_somewhere():
    for page in PAGES:
        for match in LINK.finditer((ROOT / page).read_text()):
            target = match.group(1) or match.group(2)
            if "://" not in target:
                assert ((ROOT / page).parent / target).exists(), f"{page}: {target}"


def test_every_command_and_statistic_is_documented():
    from warp_dvct.cli import cli

    text = "".join((ROOT / page).read_text() for page in PAGES)
    for name in cli.commands:
        assert f"warp-dvct {name}" in text, name


def test_demo_relights_the_stage_that_it_names(tmp_path):
    """The recipe of ``make demo``, run on its own at a small size."""
    recipe = subprocess.run(["make", "-n", "demo"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    command = next(line for line in recipe.splitlines() if "warp-dvct relight" in line)
    (tmp_path / "out").mkdir()
    done = shell(f"{command.replace('.venv/bin/', '')} {SMALL}", tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "demo.png").stat().st_size > 100

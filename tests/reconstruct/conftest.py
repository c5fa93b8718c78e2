"""Small captures with a known answer, simulated once per run."""

from __future__ import annotations

from pathlib import Path

import pytest

from warp_dvct import usd_scenes
from warp_dvct.capture.noise import KinectNoise
from warp_dvct.capture.simulate import Simulation, simulate
from warp_dvct.capture.stage import Capture, open_capture
from warp_dvct.scene import Scene
from warp_dvct.usd.read import read_stage
from warp_dvct.usd_scenes import usda


@pytest.fixture(scope="session")
def room() -> Scene:
    """The bundled room, as it truly is."""
    return read_stage(usd_scenes.path("room_area"))


@pytest.fixture(scope="session")
def room_capture(tmp_path_factory) -> Capture:
    """Twelve frames of the bundled room along an arc, without noise."""
    folder = tmp_path_factory.mktemp("room")
    options = Simulation(frames=12, width=160, height=120, path="orbit", arc=70.0, noise=KinectNoise.only())
    return open_capture(simulate(usd_scenes.path("room_area"), folder, options).capture)


@pytest.fixture(scope="session")
def noisy_capture(tmp_path_factory) -> Capture:
    """The same with the sensor's noise, at half of its resolution."""
    folder = tmp_path_factory.mktemp("noisy")
    options = Simulation(frames=12, width=320, height=240, path="orbit", arc=70.0)
    return open_capture(simulate(usd_scenes.path("room_area"), folder, options).capture)


@pytest.fixture(scope="session")
def yard(tmp_path_factory) -> Path:
    """Things of several colours on the ground under a sun and a blue sky."""
    folder = tmp_path_factory.mktemp("yard")
    lights = [
        usda.prim("DomeLight", "Sky", ["float inputs:intensity = 0.4", "color3f inputs:color = (0.8, 0.95, 1.3)"]),
        usda.prim(
            "DistantLight",
            "Sun",
            [
                "float inputs:angle = 1",
                "color3f inputs:color = (1, 0.93, 0.82)",
                "float inputs:intensity = 9000",
                *usda.place(turn=-48, pitch=-42),
            ],
        ),
    ]
    things = [
        usda.quad("Ground", (-4, 0, 4), (8, 0, 0), (0, 0, -8), "Grey"),
        usda.box("Block", (0.7, 0.9, 0.7), (-0.8, 0, -0.9), "Brick", turn=20),
        usda.sphere("Ball", 0.4, (0.5, 0.4, -0.4), "White"),
        usda.box("Step", (0.5, 0.25, 0.9), (0.1, 0, -1.6), "Grey", turn=50),
        usda.cylinder("Drum", 0.3, 0.7, (1.2, 0, -1.5), "Teal"),
    ]
    materials = [
        usda.lambert("Grey", (0.4, 0.4, 0.4)),
        usda.lambert("Brick", (0.5, 0.24, 0.17)),
        usda.lambert("White", (0.75, 0.75, 0.75)),
        usda.lambert("Teal", (0.08, 0.4, 0.42)),
    ]
    children = [
        usda.camera("Camera", (0.15, 1.7, 2.2), 0, -25, 60),
        *lights,
        usda.role("Real", "real", things),
        usda.prim("Scope", "Materials", materials),
    ]
    file = folder / "yard.usda"
    file.write_text(usda.stage("yard", "Things in the sun.", children))
    return file

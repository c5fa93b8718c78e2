"""Fixtures shared by all tests."""

import pytest

from warp_dvct.launch import Launcher
from warp_dvct.settings import make_settings
from warp_dvct.survey import Survey, survey
from warp_dvct.usd.read import read_stage
from warp_dvct.usd_scenes import path


@pytest.fixture(scope="session")
def device() -> str:
    """The device that kernels are tested on."""
    return "cpu"


@pytest.fixture(scope="session")
def launcher(device: str) -> Launcher:
    """A launcher on :func:`device` with two threads, so that slabs are exercised."""
    return Launcher(device, threads=2)


@pytest.fixture(scope="session")
def surveys(launcher: Launcher) -> dict[str, Survey]:
    """Of three stages with a plate: a closed diffuse room, one with mirrors, an open scene."""
    scenes = {name: read_stage(path(name)) for name in ("room_area", "room_glossy", "ground_dome")}
    return {name: survey(scene, make_settings(), launcher, 16 / 9, has_plate=True) for name, scene in scenes.items()}

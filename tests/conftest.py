"""Fixtures shared by all tests."""

from collections.abc import Iterator

import pytest

from warp_dvct import launch
from warp_dvct.launch import Launcher, find_device
from warp_dvct.settings import make_settings
from warp_dvct.survey import Survey, survey
from warp_dvct.usd.read import read_stage
from warp_dvct.usd_scenes import path


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help="Where the tests' kernels run: cpu (the default), cuda or cuda:N.")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--device") != "cpu":
        for item in items:
            if item.get_closest_marker("cpu"):
                item.add_marker(pytest.mark.skip(reason="tests the CPU's own"))


@pytest.fixture(scope="session", autouse=True)
def _tested_device(request: pytest.FixtureRequest) -> Iterator[None]:
    """With ``--device``, whatever asks for the CPU gets that device: most code under test asks for the default."""
    chosen = request.config.getoption("--device")
    with pytest.MonkeyPatch.context() as patch:
        if chosen != "cpu":
            patch.setattr(launch, "find_device", lambda name: find_device(chosen if name == "cpu" else name))
        yield


@pytest.fixture(scope="session")
def device() -> str:
    """The device that kernels are tested on, by the name that stands for it."""
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

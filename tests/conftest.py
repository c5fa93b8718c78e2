"""Fixtures shared by all tests."""

import pytest

from warp_dvct.launch import Launcher


@pytest.fixture(scope="session")
def device() -> str:
    """The device that kernels are tested on."""
    return "cpu"


@pytest.fixture(scope="session")
def launcher(device: str) -> Launcher:
    """A launcher on :func:`device` with two threads, so that slabs are exercised."""
    return Launcher(device, threads=2)

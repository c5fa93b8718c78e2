"""What the tests of the command share: running it, and stages that are small and change over time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from warp_dvct.cli import _run
from warp_dvct.usd_scenes import path as bundled


@dataclasses.dataclass(frozen=True)
class Result:
    """Exit code and what was printed."""

    code: int
    out: str
    err: str


@pytest.fixture
def command(capfd) -> Callable[..., Result]:
    """Runs ``warp-dvct`` in this process, as its entry point does."""

    def run(*arguments: object) -> Result:
        code = _run([str(argument) for argument in arguments])
        captured = capfd.readouterr()
        return Result(code, captured.out, captured.err)

    return run


@pytest.fixture
def room() -> Path:
    """The bundled room."""
    return bundled("room_area")


@pytest.fixture
def shot(tmp_path, room) -> Path:
    """The room with a ball that moves and a mesh that asks for subdivision, which is not modelled."""
    stage = tmp_path / "shot.usda"
    stage.write_text(
        f"""#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Y"
    subLayers = [@{room}@]
)
over "World"
{{
    over "Synthetic"
    {{
        over "Ball"
        {{
            double3 xformOp:translate.timeSamples = {{ 1: (0.5, 0.25, -0.1), 3: (-0.5, 0.25, 0.3) }}
        }}
        over "Crate"
        {{
            uniform token subdivisionScheme = "bilinear"
        }}
    }}
}}
"""
    )
    return stage


@pytest.fixture
def moving_room(tmp_path, shot) -> Path:
    """The shot with a second camera."""
    stage = tmp_path / "moving.usda"
    stage.write_text(
        f"""#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Y"
    subLayers = [@{shot}@]
)
over "World"
{{
    def Camera "Close" (
        references = </World/Camera>
    )
    {{
        float focalLength = 60
    }}
}}
"""
    )
    return stage


class Picture:
    """The channels of an EXR, by name."""

    def __init__(self, path: Path) -> None:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            self.channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}

    def layer(self, name: str, letters: str = "RGB") -> np.ndarray:
        """A layer as float32 ``[h, w, n]``; the synthetic one has no name."""
        prefix = f"{name}." if name else ""
        return np.stack([self.channels[prefix + letter] for letter in letters], -1).astype(np.float32)


@pytest.fixture
def read_picture() -> Callable[[Path], Picture]:
    """Reads an EXR."""
    return Picture

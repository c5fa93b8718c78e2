"""A corner of a room with a block in it, the cameras that look at it, and its true depth."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np

from warp_dvct.bench.live_capture import angle as angle
from warp_dvct.bench.live_capture import paper_normals as paper_normals
from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.capture.paths import look_at
from warp_dvct.capture.simulate import DepthEye
from warp_dvct.launch import Launcher
from warp_dvct.scene import Scene

LENS = Intrinsics(160, 120, 146.25, 146.25, 79.5, 59.5)
UP = np.array([0.0, 1.0, 0.0])
TARGET = np.array([0.0, 0.4, 0.0])


def corner() -> Scene:
    """A floor, a wall behind and one at the left, and a block that hides a part of both; metres."""
    floor = lit.rectangle((0, 0, 0), (2, 0, 0), (0, 0, -2))
    wall = lit.rectangle((0, 1, -1), (2, 0, 0), (0, 1, 0))
    side = lit.rectangle((-1.2, 1, 0), (0, 0, -2), (0, 1, 0))
    block = lit.cuboid((0.2, 0.3, 0.0), (0.2, 0.3, 0.15), 20.0)
    return lit.scene_of(lit.mesh(np.concatenate([floor, wall, side, block])))


def poses(count: int, step: float = 0.03) -> list[np.ndarray]:
    """A camera that goes to the right and up, always looking at the block."""
    return [look_at(np.array([-0.3 + step * k, 0.9 + 0.3 * step * k, 1.3]), TARGET, UP) for k in range(count)]


def seen(launcher: Launcher, scene: Scene, lens: Intrinsics, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """True depth and normals."""
    return DepthEye(launcher, scene, lens).look(pose)

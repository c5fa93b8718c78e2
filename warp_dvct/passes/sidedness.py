"""Surfaces that light meets from behind, and that therefore need both sides in the volume."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_dvct.kernels import sidedness as kernels
from warp_dvct.kernels.rsm import Target
from warp_dvct.launch import Launcher

PROBE_SIZE = 32  # beams an edge, per light
PROBE_BOUNCES = 4


def lit_from_behind(
    launcher: Launcher, geometry: Any, materials: Any, lights: Any, center: np.ndarray, radius: float
) -> np.ndarray:
    """Triangles that beams of any light, or their diffuse bounces, meet from behind on their way to another surface:
    int indices, one per meeting.

    USD's meshes are single sided unless they say otherwise, and many a room is modelled as a box that faces outwards.

    Args:
        center, radius: A sphere around the scene, in volume space.
    """
    target = Target()
    target.center = wp.vec3(*center)
    target.radius = radius
    target.start = 2.0 * radius
    count = PROBE_SIZE * PROBE_SIZE
    found: list[Any] = [np.zeros(0, np.int32)]
    for light in range(int(lights.count)):
        back = launcher.empty(count * PROBE_BOUNCES, wp.int32)
        launcher.launch(
            kernels._meet_backs,
            count,
            [geometry, materials, lights, target, light, PROBE_SIZE, PROBE_BOUNCES],
            [back],
        )
        found.append(back.numpy())
    triangles = np.concatenate(found)
    return triangles[triangles >= 0]

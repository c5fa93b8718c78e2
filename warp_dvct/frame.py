"""The frame of the volumes: where volume space lies in the world, in steps, so that small motions leave it as it is.

What a moving shot keeps between frames (hits of rays on real triangles, fragments of these) is in volume space. If that
followed every millimetre of an object, nothing could be kept. Its unit, the fine volume's edge, goes by steps of a
quarter of an octave, measured on the real scene, which does not move; its origin is the middle of the real scene, or a
point of a wide grid around it. In it the fine volume follows the objects in eighths of its edge, and takes with it only
what is its own. A single frame makes the same choice as a frame of a shot, so both are equal bit for bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warp_dvct.scene import Role, Scene

STEPS_PER_OCTAVE = 4  # of the fine volume's edge: it is within 2**(1/8), 9 %, of what volume.scale asks for
STEPS_PER_EDGE = 8  # of the fine volume's centre: it is within a sixteenth of the edge from the objects' middle
# Of the fine volume, between two origins: it is never farther than half of that from the origin, which costs its
# coordinates two bits of 24.
EDGES_PER_ORIGIN = 8
SPLIT_TO = 0.25  # of the coarse volume's half edge: triangles that cross its border are split until they are that small
_UNIT = ([np.zeros(3)], [np.ones(3)])  # bounds of a scene without geometry
ALMOST = 0.05  # of a step: objects may stand out of the real scene that far, less than the coarse volume's margin


@dataclass(frozen=True)
class VolumeFrame:
    """Where the fine volume lies.

    Attributes:
        origin: World position of volume space's origin, metres, float64 ``[3]``.
        edge: Its unit, the fine volume's edge, in metres.
        fine: Lowest corner of the fine volume, in volume space.
        low, high: Bounds of the whole scene in volume space. They too move in steps of the objects.
    """

    origin: np.ndarray
    edge: float
    fine: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def middle(self) -> np.ndarray:
        """Of the fine volume, in volume space."""
        return self.fine + 0.5


def volume_frame(scene: Scene, volume_scale: float) -> VolumeFrame:
    """Choose the fine volume of a scene.

    Its edge is the step nearest to ``volume_scale`` times the largest edge of the synthetic objects' bounding box, and
    never so small that the box is not inside. Without real or without synthetic geometry nothing can be kept, and the
    volume is exactly that large and centred, its corner the origin.
    """
    synthetic, real = scene.bounds(Role.SYNTHETIC), scene.bounds(Role.REAL)
    lows, highs = zip(*(b for b in (synthetic, real) if b is not None), strict=True) if synthetic or real else _UNIT
    everything = np.min(lows, 0), np.max(highs, 0)
    low, high = synthetic if synthetic is not None else everything
    smallest = 1e-6 * (float(np.max(everything[1] - everything[0])) or 1.0)
    size = float(np.max(high - low))
    edge, center = max(volume_scale * size, smallest), 0.5 * (low + high)
    unit = float(np.max(real[1] - real[0])) if real is not None else 0.0
    if synthetic is None or real is None or unit <= 0.0:
        origin = center - 0.5 * edge
        return VolumeFrame(origin, edge, np.zeros(3), (everything[0] - origin) / edge, (everything[1] - origin) / edge)
    step = round(STEPS_PER_OCTAVE * math.log2(edge / unit))
    while unit * 2.0 ** (step / STEPS_PER_OCTAVE) * (1.0 - 1.0 / STEPS_PER_EDGE) < size:
        step += 1
    edge = unit * 2.0 ** (step / STEPS_PER_OCTAVE)
    middle = 0.5 * (real[0] + real[1])
    origin = middle + np.round((center - middle) / (EDGES_PER_ORIGIN * edge)) * (EDGES_PER_ORIGIN * edge)
    grid = edge / STEPS_PER_EDGE
    inner = (real[0] - origin) / edge, (real[1] - origin) / edge
    fine = inner[0] + np.round((center - real[0]) / grid) / STEPS_PER_EDGE - 0.5
    outer = tuple(
        inner[0] + toward((bound - real[0]) / grid) / STEPS_PER_EDGE
        for toward, bound in ((np.floor, low), (np.ceil, high))
    )
    # Where the objects are inside of the real scene's bounds, or all but inside, their motion does not show at all.
    slack = ALMOST * grid
    return VolumeFrame(
        origin,
        edge,
        fine,
        np.where(low < real[0] - slack, np.minimum(inner[0], outer[0]), inner[0]),
        np.where(high > real[1] + slack, np.maximum(inner[1], outer[1]), inner[1]),
    )


def share_beyond(scene: Scene, center: np.ndarray, half: float) -> float:
    """How much of the sphere of directions around ``center`` the real surfaces outside of a cube fill.

    Occlusion is not looked at, so the share is an upper bound. Triangles that lie outside count by their exact solid
    angle; those that cross the cube's border are split until they are small beside it, and then count by half.

    Args:
        center: The cube's middle, world metres. half: Half its edge, metres.
    """
    total = 0.0
    for mesh in scene.meshes:
        corners = mesh.points[mesh.triangles] - center if mesh.role == Role.REAL else np.zeros((0, 3, 3))
        while len(corners):
            low, high = corners.min(1), corners.max(1)
            apart = np.any((low > half) | (high < -half), 1)
            total += _solid_angle(corners[apart])
            crossing = ~apart & np.any((low < -half) | (high > half), 1)
            small = np.max(high - low, 1) < SPLIT_TO * half
            total += 0.5 * _solid_angle(corners[crossing & small])
            corners = _quarters(corners[crossing & ~small])
    return total / (4.0 * math.pi)


def _solid_angle(corners: np.ndarray) -> float:
    """Sum over triangles ``[t, 3, 3]`` seen from the origin (Van Oosterom and Strackee 1983)."""
    a, b, c = (corners[:, k] for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
    volume = np.abs(np.einsum("ij,ij->i", a, np.cross(b, c)))
    ab, ac, bc = (np.einsum("ij,ij->i", x, y) for x, y in ((a, b), (a, c), (b, c)))
    return float(2.0 * np.arctan2(volume, la * lb * lc + ab * lc + ac * lb + bc * la).sum())


def _quarters(corners: np.ndarray) -> np.ndarray:
    """Each triangle split into four at the middles of its edges."""
    a, b, c = (corners[:, k] for k in range(3))
    ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(part, 1) for part in parts])

"""Real triangles that can lie between a surface and a light: shadow rays ask these alone.

A triangle on the convex hull of everything, as the walls of most rooms and the ground are, parts no two points of the
scene, and so hides no light that is in it, nor a parallel light that comes from its inner side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warp_dvct.kernels.geometry import OFFSET_RELATIVE
from warp_dvct.scene import Light, LightKind

LEAST_SHARE = 0.25  # of the real surface, below which leaving triangles out saves less than a second tree takes


@dataclass(frozen=True)
class RealHull:
    """The real triangles on the convex hull of the real scene, in volume space.

    Attributes:
        index: Which triangles, ``[h]``. normal: Their unit normals, away from the scene, float64 ``[h, 3]``.
        level: Distance of their planes from the origin along the normal, ``[h]``.
        slack: How far above its plane a point still counts as on it, ``[h]``: half the step by which rays leave it.
        area: Of all real triangles, ``[t]``; 0 where none is on the hull.
    """

    index: np.ndarray
    normal: np.ndarray
    level: np.ndarray
    slack: np.ndarray
    area: np.ndarray

    @staticmethod
    def of(triangles: np.ndarray, index: np.ndarray) -> RealHull:
        """From all real triangles ``[t, 3, 3]`` and which of them are on the hull."""
        if not len(index):
            return RealHull(index, np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(len(triangles)))
        corners = triangles.astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        twice = np.linalg.norm(cross, axis=-1)
        normal = cross[index] / twice[index, None]
        level = np.einsum("ij,ij->i", normal, corners[index, 0])
        middle = corners.reshape(-1, 3).mean(0)
        side = np.where(normal @ middle > level, -1.0, 1.0)
        slack = 0.5 * float(OFFSET_RELATIVE) * np.abs(corners[index]).max((1, 2), initial=0.0)
        return RealHull(index, normal * side[:, None], level * side, slack, 0.5 * twice)

    def blocking(self, boxes: np.ndarray, lights: Sequence[Light], origin: np.ndarray, scale: float) -> np.ndarray:
        """Which real triangles shadow rays have to ask, bool ``[t]``: all where leaving some out would save little.

        Args:
            boxes: Low and high corners of the synthetic objects' boxes, ``[m, 2, 3]``, in volume space.
            lights: Domes do not count: rays to them end nowhere.
            origin, scale: Of volume space.
        """
        if not len(self.index):
            return np.ones(len(self.area), bool)
        below = self._holds(boxes.astype(np.float64))
        for light in lights:
            below &= self._lit_from_inside(light, origin, scale)
        blocking = np.ones(len(self.area), bool)
        blocking[self.index[below]] = False
        if self.area[~blocking].sum() < LEAST_SHARE * self.area.sum():
            return np.ones(len(self.area), bool)
        return blocking

    def _holds(self, boxes: np.ndarray) -> np.ndarray:
        """Whether all boxes are below each plane."""
        middle, half = boxes.mean(1), 0.5 * (boxes[:, 1] - boxes[:, 0])
        top = self.normal @ middle.T + np.abs(self.normal) @ half.T
        return top.max(1, initial=-np.inf) <= self.level + self.slack

    def _lit_from_inside(self, light: Light, origin: np.ndarray, scale: float) -> np.ndarray:
        """Whether each plane has a light below it, or on the side from which its beams come."""
        if light.kind == LightKind.DOME:
            return np.ones(len(self.index), bool)
        if light.kind == LightKind.DISTANT:
            toward = -np.asarray(light.direction, np.float64)
            return self.normal @ (toward / np.linalg.norm(toward)) <= -np.sin(0.5 * light.angle)
        middle = (np.asarray(light.position, np.float64) - origin) * scale
        # A disk is within its parallelogram.
        reach = sum(np.abs(self.normal @ (np.asarray(axis) * scale)) for axis in (light.axis_x, light.axis_y))
        return self.normal @ middle + reach + light.radius * scale <= self.level + self.slack

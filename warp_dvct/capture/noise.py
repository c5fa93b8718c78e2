"""The Kinect v1 as a noise model on true depth: what structured light measures, effect by effect.

Khoshelham and Elberink 2012 (disparity noise and its steps), Nguyen et al. 2012 (lateral noise and incidence), Barron
and Malik 2013 (the order: jitter, then disparity). No model of interference, of dark or specular materials, nor of the
projector's own shadow beside objects, for which drop-outs at depth jumps stand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.errors import OptionError

EFFECTS = ("disparity", "quantization", "lateral", "jumps", "incidence", "range")
JUMP = 0.03  # of depth: a neighbour farther off the tangent plane is another surface
JUMP_LOSS = 0.5  # probability that a pixel beside a jump measures nothing


@dataclass(frozen=True)
class KinectNoise:
    """Each effect with its size; :meth:`only` switches them.

    Attributes:
        disparity: Standard deviation of disparity [pixels], 1/6; 0 for none.
        steps: Steps of disparity per pixel, 8; 0 for no quantisation.
        lateral: Standard deviation of the place that a pixel looks at [pixels], 0.5.
        jumps: Whether pixels beside depth jumps may be lost.
        incidence: Angles [degrees] between which the chance of a loss goes from 0 to 1, (75, 80); None for no loss.
        range: Nearest and farthest depth [m] that is measured, (0.5, 4); None for all.
        baseline: Between projector and camera [m].
        focal: Focal length of the sensor in its own pixels, in which disparity is measured; images may be coarser.
    """

    disparity: float = 1.0 / 6.0
    steps: float = 8.0
    lateral: float = 0.5
    jumps: bool = True
    incidence: tuple[float, float] | None = (75.0, 80.0)
    range: tuple[float, float] | None = (0.5, 4.0)
    baseline: float = 0.075
    focal: float = 585.0

    @classmethod
    def only(cls, *effects: str) -> KinectNoise:
        """The effects of :data:`EFFECTS` that are named, at their usual sizes, and no others.

        Raises:
            OptionError: An effect is unknown.
        """
        unknown = [effect for effect in effects if effect not in EFFECTS]
        if unknown:
            raise OptionError(f"there is no effect '{unknown[0]}' of noise; there are {', '.join(EFFECTS)}")
        usual = cls()
        return cls(
            disparity=usual.disparity if "disparity" in effects else 0.0,
            steps=usual.steps if "quantization" in effects else 0.0,
            lateral=usual.lateral if "lateral" in effects else 0.0,
            jumps="jumps" in effects,
            incidence=usual.incidence if "incidence" in effects else None,
            range=usual.range if "range" in effects else None,
        )

    def apply(self, depth: np.ndarray, normal: np.ndarray, lens: Intrinsics, seed: int, frame: int) -> np.ndarray:
        """What the sensor would measure.

        Args:
            depth: True depth along the view axis [m], ``[h, w]``; 0 or infinite where there is nothing.
            normal: True unit normals in camera axes (OpenCV), ``[h, w, 3]``.
            lens: The depth camera.
            seed, frame: Decide the random numbers; frames are independent of each other.
        Returns:
            float32 ``[h, w]``; 0 where nothing was measured.
        """
        rng = np.random.default_rng([seed, frame])
        shape = depth.shape
        # Every effect draws its numbers whether it is on or off, so that switching one leaves the others as they are.
        shift, wobble, luck = rng.normal(size=(2, *shape)), rng.normal(size=shape), rng.random((2, *shape))
        true = np.where(np.isfinite(depth) & (depth > 0.0), depth, 0.0).astype(np.float64)
        seen = true
        if self.lateral > 0.0:
            v, u = np.indices(shape)
            u = np.clip(np.rint(u + self.lateral * shift[0]), 0, shape[1] - 1).astype(np.int64)
            v = np.clip(np.rint(v + self.lateral * shift[1]), 0, shape[0] - 1).astype(np.int64)
            seen = true[v, u]
        measured = self._measure(seen, wobble)
        lost = (true <= 0.0) | (seen <= 0.0) | (measured <= 0.0)
        if self.jumps:
            lost |= beside_jump(true, normal, lens) & (luck[0] < JUMP_LOSS)
        if self.incidence is not None:
            rays = lens.rays()
            cosine = -np.sum(rays * normal, -1) / np.linalg.norm(rays, axis=-1)
            angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
            first, last = self.incidence
            lost |= luck[1] < (angle - first) / (last - first)
        if self.range is not None:
            lost |= (measured < self.range[0]) | (measured > self.range[1])
        return np.where(lost, 0.0, measured).astype(np.float32)

    def _measure(self, depth: np.ndarray, wobble: np.ndarray) -> np.ndarray:
        """Through disparity and back; 0 where disparity vanishes."""
        if self.disparity <= 0.0 and self.steps <= 0.0:
            return depth
        scale = self.focal * self.baseline
        disparity = scale / np.where(depth > 0.0, depth, np.inf) + self.disparity * wobble
        if self.steps > 0.0:
            disparity = np.rint(disparity * self.steps) / self.steps
        return np.where(disparity > 0.0, scale / np.where(disparity > 0.0, disparity, 1.0), 0.0)


def beside_jump(depth: np.ndarray, normal: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Pixels with one of their eight neighbours on another surface, bool ``[h, w]``.

    A neighbour is on another surface where it lies farther than :data:`JUMP` of its depth off the pixel's tangent
    plane, or where one of both has no depth.
    """
    points = lens.rays() * depth[..., None]
    jump = np.zeros(depth.shape, bool)
    padded = np.pad(points, ((1, 1), (1, 1), (0, 0)), mode="edge")
    height, width = depth.shape
    for dy in (0, 1, 2):
        for dx in (0, 1, 2):
            other = padded[dy : dy + height, dx : dx + width]
            off = np.abs(np.sum((other - points) * normal, -1))
            jump |= off > JUMP * np.maximum(depth, other[..., 2])
            jump |= (other[..., 2] > 0.0) != (depth > 0.0)
    return jump

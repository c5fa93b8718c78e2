"""Twin of aimed rays: the part of the disk that objects take up, and each ray's weight in the mean of a point's."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from warp_dvct.bench.twins.numbers import dot, from_frame
from warp_dvct.kernels.aim import FEWEST, MOST, NARROWEST, PER_SHARE, ROUND, WIDEST


@dataclass(frozen=True)
class Sectors:
    """By point: the middle azimuth and half the width [rad], squared radii, and the share of the disk, 0 for none."""

    middle: np.ndarray
    half: np.ndarray
    inner: np.ndarray
    outer: np.ndarray
    share: np.ndarray

    @staticmethod
    def of(center: np.ndarray, extent: np.ndarray, position: np.ndarray, normal: np.ndarray) -> Sectors:
        """Of a box, by its middle and half its edges."""
        axes = [from_frame(np.broadcast_to(e, normal.shape), normal) for e in np.eye(3)]
        corners = center + np.array(list(product((-1.0, 1.0), repeat=3))) * extent
        x, y, height = (dot((corners[:, None] - position), axis) for axis in axes)  # [corner, n]
        start = np.arctan2(dot(center - position, axes[1]), dot(center - position, axes[0]))
        turn = (np.arctan2(y, x) - start + np.pi) % (2 * np.pi) - np.pi
        left, right = np.minimum(turn.min(0), 0.0), np.maximum(turn.max(0), 0.0)
        around = right - left >= float(ROUND)
        half = np.where(around, np.pi, np.maximum(0.5 * (right - left), float(NARROWEST)))
        square, high, low = x * x + y * y, height.max(0), np.maximum(height.min(0), 0.0)
        outer = square.max(0) / (square.max(0) + low**2)
        near = square.min(0) * np.cos(half) ** 2
        inner = np.where(around, 0.0, np.minimum(near / (near + high**2), outer - float(NARROWEST)))
        share = np.where(high > 0.0, (outer - inner) * half / np.pi, 0.0)
        return Sectors(start + 0.5 * (left + right) * ~around, half, inner, outer, share)

    def contain(self, disk: np.ndarray) -> np.ndarray:
        """Whether a point of the disk lies in each."""
        square = (disk**2).sum(-1)
        away = np.abs((np.arctan2(disk[..., 1], disk[..., 0]) - self.middle + np.pi) % (2 * np.pi) - np.pi)
        return (square >= self.inner) & (square <= self.outer) & (away <= self.half)

    def point(self, xi: np.ndarray) -> np.ndarray:
        """A uniformly distributed point of each."""
        radius = np.sqrt(self.inner + (self.outer - self.inner) * xi[..., 0])
        turn = self.middle + self.half * (2.0 * xi[..., 1] - 1.0)
        return np.stack([radius * np.cos(turn), radius * np.sin(turn)], -1)


@dataclass(frozen=True)
class Aims:
    """By point, how many of its rays go into each target's sector; ``aimed`` says whether any do."""

    aimed: np.ndarray
    sectors: tuple[Sectors, ...]
    rays: np.ndarray  # [targets, n]

    @staticmethod
    def of(targets: Any, position: np.ndarray, normal: np.ndarray, even: int) -> Aims:
        """Rays of points that send ``even`` others, spread over the sectors of ``Targets``."""
        boxes = [(targets.center, targets.extent), (targets.other_center, targets.other_extent)][: targets.count]
        sectors = tuple(Sectors.of(np.array([*c], float), np.array([*e], float), position, normal) for c, e in boxes)
        shares = np.array([sector.share for sector in sectors])
        whole = shares.sum(0)
        aimed = (whole > 0.0) & (whole < float(WIDEST)) & (even > 0)
        rays = np.maximum(np.floor(even * np.clip(float(PER_SHARE) * whole, float(FEWEST), float(MOST)) + 0.5), 1.0)
        first = np.floor(rays * shares[0] / np.where(whole > 0.0, whole, 1.0) + 0.5)
        return Aims(aimed, sectors, np.stack([first, rays - first])[: len(sectors)])

    def draw(self, k: int, xi: np.ndarray) -> np.ndarray:
        """The point of the disk of the ``k``-th aimed ray: the first ones go to the first target."""
        points = [sector.point(xi) for sector in self.sectors]
        return points[0] if len(points) < 2 else np.where((k < self.rays[0])[:, None], *points)

    def density(self, disk: np.ndarray) -> np.ndarray:
        """Aimed rays to the disk's area at a point of it."""
        found = np.zeros(len(disk))
        for sector, rays in zip(self.sectors, self.rays, strict=True):
            found += np.where(sector.contain(disk) & (rays > 0), rays / np.maximum(sector.share, 1e-30), 0.0)
        return found

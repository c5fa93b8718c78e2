"""Boxes along the axes, as kernels take them: their middle and half their edges."""

from __future__ import annotations

import numpy as np

MARGIN = 1e-3  # of the largest edge: keeps rounding from culling a ray at the border, and flat boxes from being empty


def middle_and_half(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middles and half edges, ``[m, 3]`` each, of boxes a little larger than they are.

    Args:
        boxes: Low and high corners of each, ``[m, 2, 3]``.
    """
    low, high = boxes[:, 0], boxes[:, 1]
    return 0.5 * (low + high), 0.5 * (high - low) + MARGIN * (high - low).max(1, initial=0.0, keepdims=True)


def around_runs(points: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Low and high corners, ``[m, 2, 3]``, of the boxes around runs of points ``[p, 3]`` that begin at ``starts``."""
    if not len(starts):
        return np.zeros((0, 2, 3), points.dtype)
    return np.stack([np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)], 1)

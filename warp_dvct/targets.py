"""Where rays are aimed: at most two boxes that hold the synthetic objects, as tightly as two can."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_dvct.boxes import middle_and_half
from warp_dvct.kernels.aim import Targets

MANY = 24  # boxes from which on neighbours are joined first: all pairs are compared, in every frame
APART = 0.5  # of the surface of the box around all, below which two boxes pay: at 0.7, as in rooms, nothing is gained


def targets_of(boxes: np.ndarray) -> Any:
    """``Targets`` of objects.

    Args:
        boxes: Low and high corners of each, ``[m, 2, 3]``.
    """
    return make_targets(two_boxes(boxes) if len(boxes) else boxes)


def make_targets(boxes: np.ndarray) -> Any:
    """``Targets`` of up to two boxes, ``[0 to 2, 2, 3]``, a little larger than they are."""
    targets = Targets()
    targets.count = len(boxes)
    center, extent = ([wp.vec3(*v) for v in vectors] for vectors in middle_and_half(boxes))
    if len(boxes) > 0:
        targets.center, targets.extent = center[0], extent[0]
    if len(boxes) > 1:
        targets.other_center, targets.other_extent = center[1], extent[1]
    return targets


def two_boxes(boxes: np.ndarray) -> np.ndarray:
    """One box around all, or two where these have much less surface: those that are left when the two boxes whose
    common box grows least are joined, again and again. ``[1 or 2, 2, 3]``."""
    left = _neighbours_joined(np.asarray(boxes, np.float64))
    whole = _joined(left)
    while len(left) > 2:
        both = np.stack(
            [np.minimum(left[:, None, 0], left[None, :, 0]), np.maximum(left[:, None, 1], left[None, :, 1])], 2
        )
        growth = _surface(both) - _surface(left)[:, None] - _surface(left)[None]
        growth[np.tril_indices(len(left))] = np.inf
        i, j = np.unravel_index(int(np.argmin(growth)), growth.shape)
        left = np.concatenate([np.delete(left, [i, j], 0), both[i, j][None]])
    return left if _surface(left).sum() < APART * _surface(whole).sum() else whole


def _neighbours_joined(boxes: np.ndarray) -> np.ndarray:
    """At most ``MANY`` boxes: those in the same slice of the longest axis are joined."""
    if len(boxes) <= MANY:
        return boxes
    centers = boxes.mean(1)
    along = centers[:, int(np.argmax(np.ptp(centers, axis=0)))]
    slices = np.minimum((along - along.min()) / max(np.ptp(along), 1e-30) * MANY, MANY - 1).astype(int)
    return np.concatenate([_joined(boxes[slices == k]) for k in np.unique(slices)])


def _joined(boxes: np.ndarray) -> np.ndarray:
    return np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])[None]


def _surface(boxes: np.ndarray) -> np.ndarray:
    """Half of it, of boxes ``[..., 2, 3]``."""
    x, y, z = np.moveaxis(boxes[..., 1, :] - boxes[..., 0, :], -1, 0)
    return x * y + y * z + z * x

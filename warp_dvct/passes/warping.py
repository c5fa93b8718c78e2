"""Sample warping by a 2-D importance of any size: reflective shadow maps and environment images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.kernels import warping as kernels
from warp_dvct.kernels.warping import Chain
from warp_dvct.launch import Launcher


@dataclass(frozen=True)
class Importance:
    """A 2-D importance that points can be warped by.

    Attributes:
        chain: ``Chain``: the values and their sums.
        width, height: Texels.
        total: Sum of the importance; 0 where nothing can be picked.
    """

    chain: Any
    width: int
    height: int
    total: float


def build_importance(launcher: Launcher, values: Any, width: int, height: int) -> Importance:
    """Sum an importance into a chain of levels (Clarberg et al. 2005).

    Args:
        values: float32 ``[width * height]`` on the device, or a NumPy array of that size; row 0 first. NaN, infinite
            and negative values count as 0. The sum has to stay below 3e38.
    Raises:
        ValueError: The size is below 1 x 1 or does not fit ``values``.
    """
    if isinstance(values, np.ndarray):
        values = launcher.array(np.asarray(values, np.float32).reshape(-1), wp.float32)
    if width < 1 or height < 1 or values.shape[0] != width * height:
        raise ValueError(f"an importance of {width} x {height} does not fit {values.shape[0]} values")
    sizes = [(width, height)]
    while sizes[-1] != (1, 1):
        sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
    counts = [w * h for w, h in sizes]
    chain = Chain()
    chain.width, chain.height, chain.levels = width, height, len(sizes)
    chain.level_first = launcher.array(np.cumsum([0, *counts])[:-1].astype(np.int32), wp.int32)
    chain.value = launcher.empty(sum(counts), wp.float32)
    launcher.launch(kernels._clean_importance, counts[0], [values], [chain.value])
    for level in range(1, len(sizes)):
        launcher.launch(kernels._sum_level, counts[level], [level, chain], [chain.value])
    return Importance(chain, width, height, float(chain.value[-1:].numpy()[0]))


def warp_points(
    launcher: Launcher, importance: Importance, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Warp points of the unit square.

    Args:
        points: ``[n, 2]`` in [0, 1).
    Returns:
        Places in the unit square ``[n, 2]``, texel indices ``[n]``, and the texels' probabilities ``[n]``, which are 0
        where the importance is 0 everywhere. The density at a place is the probability times width times height.
    """
    count = len(points)
    place = launcher.empty(count, wp.vec2)
    texel, probability = launcher.empty(count, wp.int32), launcher.empty(count, wp.float32)
    source = launcher.array(np.asarray(points, np.float64), wp.vec2d)
    launcher.launch(kernels._warp_points, count, [importance.chain, source], [place, texel, probability])
    return place.numpy(), texel.numpy(), probability.numpy()


def texel_probabilities(launcher: Launcher, importance: Importance) -> np.ndarray:
    """The probability of each texel, float32 ``[height, width]``."""
    probability = launcher.empty(importance.width * importance.height, wp.float32)
    launcher.launch(kernels._texel_probabilities, probability.shape[0], [importance.chain], [probability])
    return probability.numpy().reshape(importance.height, importance.width)

"""TM(L_rho) - TM(L_mu): the difference of the two solutions for a plate of low dynamic range."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp

from warp_dvct.kernels.difference import _tonemap_difference
from warp_dvct.launch import Launcher
from warp_dvct.layers import Radiance


def tonemap_difference(launcher: Launcher, radiance: Radiance, plate: np.ndarray) -> Radiance:
    """Replace the linear difference by the one that a display shows.

    A camera's curve bends bright light down. The plate of such a camera is already bent, so a linear difference in
    its highlights is too large; the difference of the two tone-mapped solutions is bent alike (Knecht et al. 2012,
    section 3.1). Where the model's before is the plate and neither leaves [0, 1], both differences are equal.

    Args:
        radiance: With ``before``.
        plate: Linear ``[h, w, 3]`` in [0, 1], as a display-referred file decodes.
    Raises:
        ValueError: ``radiance.before`` is None.
    """
    if radiance.before is None:
        raise ValueError("the tone-mapped difference needs the radiance before: render it with the plate")
    count = radiance.width * radiance.height
    delta = launcher.empty(count, wp.vec3)
    base = launcher.array(np.asarray(plate, np.float32).reshape(-1, 3), wp.vec3)
    launcher.launch(_tonemap_difference, count, [base, radiance.before, radiance.delta, radiance.synthetic], [delta])
    return replace(radiance, delta=delta)

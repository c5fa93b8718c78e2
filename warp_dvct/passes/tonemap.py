"""Display-referred 8-bit pictures for previews; the EXR stays scene-linear."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from warp_dvct.errors import OptionError
from warp_dvct.kernels.tonemap import CURVE_FILMIC, CURVE_SRGB, _tonemap_pixels
from warp_dvct.launch import Launcher

CURVES = {"srgb": int(CURVE_SRGB), "filmic": int(CURVE_FILMIC)}


def tonemap(launcher: Launcher, linear: np.ndarray, *, exposure: float = 0.0, curve: str = "srgb") -> np.ndarray:
    """Map scene-linear colours to 8-bit sRGB codes.

    ``srgb`` shows values up to 1 as they are (an 8-bit photograph used as the plate keeps its codes where nothing
    changed) and fades brighter colours to white with their hue kept: with m the largest channel, c becomes
    1 - (1 - c/m)/m. ``filmic`` is Narkowicz' 2015 fit to the ACES curve: more contrast, a soft shoulder, and the plate
    looks different too.

    Args:
        launcher: Device to run on.
        linear: Linear Rec.709, shape ``[h, w, 3]``.
        exposure: Stops; +1 doubles the brightness.
        curve: ``"srgb"`` or ``"filmic"``.
    Returns:
        uint8 ``[h, w, 3]``.
    Raises:
        OptionError: Unknown curve, or an exposure that is not finite or beyond +-64 stops.
    """
    if curve not in CURVES:
        raise OptionError(f"unknown tone curve '{curve}'; choose one of {', '.join(CURVES)}")
    if not math.isfinite(exposure) or abs(exposure) > 64.0:
        raise OptionError(f"exposure is {exposure} stops; give a number between -64 and 64")
    height, width = linear.shape[:2]
    with launcher.scope("tonemap"):
        colors = launcher.array(np.asarray(linear, np.float32).reshape(-1, 3), wp.vec3)
        display = launcher.empty((height * width, 3), wp.uint8)
        launcher.launch(_tonemap_pixels, height * width, [colors, 2.0**exposure, CURVES[curve]], [display])
        return display.numpy().reshape(height, width, 3).copy()

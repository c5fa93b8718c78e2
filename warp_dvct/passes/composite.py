"""The last step of every method: plate, delta and synthetic objects become layers and the finished picture."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_dvct.errors import OptionError
from warp_dvct.kernels.composite import _composite_pixels
from warp_dvct.launch import Launcher
from warp_dvct.layers import Layers, Radiance


def composite(launcher: Launcher, radiance: Radiance, plate: np.ndarray | None = None) -> Layers:
    """Composite the synthetic objects and the change of light over the plate.

    Per channel, with plate P, coverage a and the mean change over the pixel's real part D = delta / (1 - a), everything
    rounded to half precision::

        shadow = clamp((P + min(D, 0)) / P, 0, 1)        1 where D >= 0 or P is below 2**-14
        added  = max(D, 0)
        comp   = rgba + (1 - a) * (P * shadow + added)

    A compositor that recombines the stored layers gets ``comp``; where D and the object's coverage are 0 it is the
    plate bit for bit. What half precision cannot hold is clamped to +-65504 and NaN becomes 0; ``Layers.clamped`` and
    ``Layers.invalid`` count both, so that nothing is mended in silence.

    Args:
        launcher: Where the arrays of ``radiance`` live.
        radiance: Result of a method, whose surface layers become the frame's.
        plate: The photograph, linear, float32 ``[h, w, 3]``; None takes ``radiance.before``.
    Returns:
        The finished frame. Its colour layers hold half-precision numbers as float32.
    Raises:
        OptionError: The plate's size is not the picture's (a plate is never resampled).
        ValueError: There is neither a plate nor ``radiance.before``.
    """
    count = radiance.width * radiance.height
    with launcher.scope("composite"):
        base = _plate_array(launcher, radiance, plate)
        rgba = launcher.empty(count, wp.vec4)
        comp, used, shadow, added, delta = (launcher.empty(count, wp.vec3) for _ in range(5))
        clamped, invalid = (launcher.empty(count, wp.int32) for _ in range(2))
        launcher.launch(
            _composite_pixels,
            count,
            [base, radiance.delta, radiance.synthetic],
            [rgba, comp, used, shadow, added, delta, clamped, invalid],
        )
        wp.synchronize_device(launcher.device)
        shape = (radiance.height, radiance.width)

        def picture(array: Any) -> np.ndarray:
            values = launcher.hand_over(array)
            return values.reshape(*shape, *values.shape[1:])

        rgba_host = picture(rgba)
        return Layers(
            rgba=rgba_host,
            comp=picture(comp),
            plate=picture(used),
            shadow=picture(shadow),
            added=picture(added),
            delta=picture(delta),
            albedo=picture(radiance.albedo),
            normal=picture(radiance.normal),
            position=picture(radiance.position),
            depth=picture(radiance.depth),
            mask_real=picture(radiance.mask_real),
            mask_synthetic=rgba_host[..., 3].copy(),
            clamped=int(clamped.numpy().sum()),
            invalid=int(invalid.numpy().sum()),
        )


def _plate_array(launcher: Launcher, radiance: Radiance, plate: np.ndarray | None) -> Any:
    if plate is None:
        if radiance.before is None:
            raise ValueError("the method rendered no 'before' and no plate was given: there is nothing to composite on")
        return radiance.before
    expected = (radiance.height, radiance.width, 3)
    if plate.shape != expected:
        have, need = (" x ".join(str(n) for n in shape) for shape in (plate.shape, expected))
        raise OptionError(
            f"the plate's array is {have} but the picture needs {need} (rows, columns, RGB); give width and height of"
            " the plate, it is not resampled"
        )
    return launcher.array(np.asarray(plate, np.float32).reshape(-1, 3), wp.vec3)

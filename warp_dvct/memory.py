"""Refusing a picture that cannot be held, before the system ends the process for it."""

from __future__ import annotations

import os
from typing import Any

from warp_dvct.errors import DeviceError, OptionError
from warp_dvct.plan import Plan

MAX_PIXELS = 2**28  # 16384 x 16384; kernels count the values of a picture in 32 bits
PICTURE_PASSES = ("gbuffer", "path trace", "composite")  # whose memory goes by the pixels alone


def require_countable(width: int, height: int) -> None:
    """Refuse a size that no picture has.

    Raises:
        OptionError: Below 1 x 1, or more than ``MAX_PIXELS``.
    """
    if width < 1 or height < 1:
        raise OptionError(f"the picture is {width} x {height}; give sizes of at least 1 pixel")
    if width * height > MAX_PIXELS:
        raise OptionError(
            f"the picture is {width} x {height}, more than the {MAX_PIXELS} pixels that can be rendered; lower"
            " --imageWidth"
        )


def require_memory(plan: Plan, device: Any) -> None:
    """Refuse a picture larger than the device's memory: it would be granted, and the process ended while it is filled.

    Args:
        device: A Warp device.
    Raises:
        DeviceError: The picture alone needs more than the device has.
    """
    needed = max((p.bytes for p in plan.passes if p.needed and p.name in PICTURE_PASSES), default=0)
    there = device.total_memory if device.is_cuda else os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > there:
        raise DeviceError(
            f"a picture of {plan.width} x {plan.height} pixels needs {needed / 2**30:.1f} GiB, and {device.alias} has"
            f" {there / 2**30:.1f}; lower --imageWidth"
        )

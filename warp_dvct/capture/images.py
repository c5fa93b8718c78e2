"""Depth and colour images of captures. A damaged or unsuitable one is an error that names the file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from warp_dvct.errors import FileError


def image_size(file: str, what: str) -> tuple[int, int]:
    """Width and height from an image's header.

    Raises:
        FileError: Missing, or no image.
    """
    source = _open(file, what)
    try:
        spec = source.spec()
        return spec.width, spec.height
    finally:
        source.close()


def is_depth_image(file: str) -> bool:
    """Whether a file is an image of one channel with more than 8 bits."""
    import OpenImageIO as oiio

    try:
        source = _open(file, "image")
    except FileError:
        return False
    spec = source.spec()
    source.close()
    return spec.nchannels == 1 and spec.format.basetype != oiio.UINT8


def read_depth(
    file: str, unit: float, invalid: Sequence[int] = (0,), size: tuple[int, int] | None = None, what: str = "depth"
) -> np.ndarray:
    """Depth along the view axis in metres.

    Args:
        file: A 16-bit one-channel image (PNG, TIFF), or a float one (EXR).
        unit: Metres per step.
        invalid: Stored values that mean that nothing was measured; 0 always does, and so do NaN, infinity and
            negative values of float images.
        size: Width and height that the image must have.
        what: Name of the frame, for messages.
    Returns:
        float32 ``[h, w]``, contiguous; 0 where nothing was measured.
    Raises:
        FileError: Missing, damaged, of another size, not of one channel, or with 8 bits.
    """
    import OpenImageIO as oiio

    source = _open(file, what)
    try:
        spec = source.spec()
        if spec.format.basetype == oiio.UINT8:
            raise FileError(f"{what} '{file}' has 8 bits; depth needs 16-bit integers or floats: export it again")
        if spec.nchannels != 1:
            raise FileError(f"{what} '{file}' has {spec.nchannels} channels; depth has one: is it the colour image?")
        _check_size(file, what, (spec.width, spec.height), size)
        stored = _pixels(source, file, what, "uint16" if spec.format.basetype == oiio.UINT16 else "float")[..., 0]
    finally:
        source.close()
    bad = np.isin(stored, np.asarray(invalid, stored.dtype)) if len(invalid) else np.zeros(stored.shape, bool)
    with np.errstate(invalid="ignore"):
        bad |= ~(stored > 0) | ~np.isfinite(stored)
    return np.where(bad, np.float32(0.0), stored.astype(np.float32) * np.float32(unit))


def read_color(file: str, size: tuple[int, int] | None = None, what: str = "color") -> np.ndarray:
    """A photograph as stored: sRGB codes, uint8 ``[h, w, 3]``.

    Raises:
        FileError: Missing, damaged, of another size, or not with 8 bits.
    """
    import OpenImageIO as oiio

    source = _open(file, what)
    try:
        spec = source.spec()
        if spec.format.basetype != oiio.UINT8:
            raise FileError(f"{what} '{file}' is stored as {spec.format}; the camera's 8-bit image is needed")
        _check_size(file, what, (spec.width, spec.height), size)
        pixels = _pixels(source, file, what, "uint8")
    finally:
        source.close()
    return np.ascontiguousarray(pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, 2))


def _open(file: str, what: str) -> Any:
    import OpenImageIO as oiio

    if not os.path.isfile(file):
        raise FileError(f"{what} '{file}' does not exist; check the path")
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(file, hints)
    if source is None:
        raise FileError(f"{what} '{file}' cannot be read as an image ({oiio.geterror().strip()}); copy it again")
    return source


def _pixels(source: Any, file: str, what: str, kind: str) -> np.ndarray:
    pixels = source.read_image(0, 0, 0, source.spec().nchannels, kind)
    error = source.geterror()
    if pixels is None or error:
        raise FileError(f"{what} '{file}' is damaged ({error.split(chr(10))[0].strip() or 'truncated'}); copy it again")
    return pixels


def _check_size(file: str, what: str, found: tuple[int, int], size: tuple[int, int] | None) -> None:
    if size is not None and found != size:
        raise FileError(
            f"{what} '{file}' is {found[0]} x {found[1]} pixels but its camera has {size[0]} x {size[1]}; all frames of"
            " a capture have one size"
        )

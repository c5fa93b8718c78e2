"""Image files to linear Rec.709 float32 arrays, read by OpenImageIO."""

from __future__ import annotations

import os
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.errors import StageError

if TYPE_CHECKING:
    from pxr import Sdf, Usd


def srgb_to_linear(values: np.ndarray) -> np.ndarray:
    """The sRGB transfer function, IEC 61966-2-1; values in [0, 1]."""
    return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0.0) + 0.055) / 1.055) ** 2.4)


_SRGB_BYTES = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)


def asset_file(attribute: Usd.Attribute, value: Sdf.AssetPath, what: str) -> str:
    """The resolved file of an asset-valued attribute.

    Raises:
        StageError: It does not resolve to a file that exists.
    """
    resolved = value.resolvedPath
    package = resolved.split("[", 1)[0]
    if not resolved or not os.path.exists(package):
        authored = value.path or "(empty)"
        raise StageError(f"{attribute.GetPath()}: {what} '{authored}' does not exist; correct the path or add the file")
    return resolved


class ImageCache:
    """Reads image files once; keep one over frames, so that only files that changed are read again."""

    def __init__(self) -> None:
        self._images: dict[tuple[str, int, str], np.ndarray] = {}

    def read(self, file: str, color_space: str, owner: str) -> np.ndarray:
        """Channels as float32 ``[h, w, c]``, row 0 on top; colour channels linear, alpha untouched.

        Args:
            file: Resolved path; ``package.usdz[inner.png]`` reads from the package.
            color_space: "raw", "sRGB" or "auto": sRGB for 8-bit images of three or more channels, else linear.
            owner: Prim path for messages.
        Raises:
            StageError: The file cannot be read as an image.
        """
        key = (file, os.stat(file.split("[", 1)[0]).st_mtime_ns, color_space)
        if key not in self._images:
            pixels = _read_packaged(file, owner) if file.endswith("]") else _read_image(file, owner)
            self._images[key] = _linear(pixels, color_space)
        return self._images[key]


def _linear(pixels: np.ndarray, color_space: str) -> np.ndarray:
    is_byte = pixels.dtype == np.uint8
    encoded = color_space == "sRGB" or (color_space == "auto" and is_byte and pixels.shape[2] >= 3)
    if not encoded:
        return pixels.astype(np.float32) / np.float32(255.0) if is_byte else pixels
    colours = min(3, pixels.shape[2]) if pixels.shape[2] != 2 else 1  # two channels are grey and alpha
    linear = _SRGB_BYTES[pixels] if is_byte else srgb_to_linear(pixels).astype(np.float32)
    if pixels.shape[2] > colours:
        rest = pixels[..., colours:]
        linear[..., colours:] = rest / np.float32(255.0) if is_byte else rest
    return linear


def _read_image(file: str, owner: str) -> np.ndarray:
    """uint8 as stored for 8-bit files, else float32; ``[h, w, c]``."""
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # a material reads the channels as stored, not times alpha
    source: Any = oiio.ImageInput.open(file, config)
    if source is None:
        raise StageError(f"{owner}: '{file}' cannot be read as an image ({oiio.geterror().strip()}); replace the file")
    try:
        kind = "uint8" if source.spec().format == oiio.UINT8 else "float"
        pixels = source.read_image(0, 0, 0, source.spec().nchannels, kind)
        error = source.geterror()
    finally:
        source.close()
    if pixels is None or error:
        raise StageError(f"{owner}: '{file}' is damaged ({error.strip()}); replace the file")
    return pixels


def _read_packaged(file: str, owner: str) -> np.ndarray:
    """An image inside a usdz package, which is a zip archive."""
    package, inner = file[:-1].split("[", 1)
    try:
        with zipfile.ZipFile(package) as archive:
            data = archive.read(inner)
    except (OSError, KeyError, zipfile.BadZipFile) as error:
        raise StageError(f"{owner}: '{inner}' cannot be read from '{package}' ({error})") from error
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / Path(inner).name
        copy.write_bytes(data)
        return _read_image(str(copy), owner)


def as_rgb(pixels: np.ndarray) -> np.ndarray:
    """Three channels: grey is repeated, alpha left out."""
    return pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, 2)

"""Images in and out: layered EXR, PNG previews, photographs as plates. Only this module knows files and sRGB input.

Files are written under a temporary name in their own folder and renamed, so nobody sees half of one.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import numpy as np

from warp_dvct.errors import FileError
from warp_dvct.layers import Layers
from warp_dvct.scene import Camera

HALF_MAX = 65504.0


def write_exr(
    path: str | Path, layers: Layers, *, camera: Camera | None = None, metadata: Mapping[str, str] | None = None
) -> None:
    """Write a frame as one half-float ZIP EXR with ``layer.channel`` names.

     ``R G B A`` is the synthetic part, premultiplied; ``comp plate shadow added delta albedo`` have ``.R .G .B``, ``N``
     and ``P`` have ``.X .Y .Z``; ``depth.Z``, ``mask_real``, ``mask_synthetic`` and, of captures, ``holes`` are single.
    ``P`` and ``depth.Z`` are
     32-bit. The header says ``software`` and, of the camera, ``camera`` (its prim path) and ``worldToCamera`` (for row
     vectors as OpenEXR defines it; the camera looks along -z).

     Raises:
         FileError: The file cannot be written; nothing is left behind.
    """
    import OpenEXR

    header: dict[str, object] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "software": f"warp-dvct {version('warp-dvct')}",
        "colorInteropID": "lin_rec709_scene",
        **(metadata or {}),
    }
    if camera is not None:
        header["camera"] = camera.path
        header["worldToCamera"] = np.ascontiguousarray(np.linalg.inv(camera.to_world).T, np.float32)
    with replacing(Path(path)) as temporary:
        try:
            with OpenEXR.File(header, exr_channels(layers)) as file:
                file.write(str(temporary))
        except (RuntimeError, OSError) as error:
            raise FileError(f"{path} cannot be written: {error}") from error


def write_radiance(path: str | Path, pixels: np.ndarray) -> None:
    """Write linear RGB ``[h, w, 3]`` as a 32-bit EXR: the sun does not fit into half floats.

    Raises:
        FileError: The file cannot be written; nothing is left behind.
    """
    _write_float(path, {"RGB": np.ascontiguousarray(pixels, np.float32)})


def write_depth_exr(path: str | Path, depth: np.ndarray) -> None:
    """Write depth ``[h, w]`` as an EXR with the one 32-bit channel ``Z``.

    Raises:
        FileError: The file cannot be written; nothing is left behind.
    """
    _write_float(path, {"Z": np.ascontiguousarray(depth, np.float32)})


def _write_float(path: str | Path, channels: Mapping[str, np.ndarray]) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with replacing(Path(path)) as temporary:
        try:
            with OpenEXR.File(header, dict(channels)) as file:
                file.write(str(temporary))
        except (RuntimeError, OSError) as error:
            raise FileError(f"{path} cannot be written: {error}") from error


def exr_channels(layers: Layers) -> dict[str, np.ndarray]:
    """The channels of :func:`write_exr` by name, float16 or float32, each ``[h, w]``."""
    channels = _planes("", "RGBA", layers.rgba)
    for name in ("comp", "plate", "shadow", "added", "delta", "albedo"):
        channels |= _planes(f"{name}.", "RGB", getattr(layers, name))
    channels |= _planes("N.", "XYZ", layers.normal)
    channels |= _planes("P.", "XYZ", layers.position, np.float32)
    channels["depth.Z"] = np.ascontiguousarray(layers.depth, np.float32)
    for name in ("mask_real", "mask_synthetic"):
        channels[name] = _to_half(getattr(layers, name))
    if layers.holes is not None:
        channels["holes"] = _to_half(layers.holes)
    return channels


def _planes(prefix: str, letters: str, values: np.ndarray, dtype: type = np.float16) -> dict[str, np.ndarray]:
    values = _to_half(values) if dtype is np.float16 else np.asarray(values, dtype)
    return {prefix + letter: np.ascontiguousarray(values[..., i]) for i, letter in enumerate(letters)}


def _to_half(values: np.ndarray) -> np.ndarray:
    return np.clip(values, -HALF_MAX, HALF_MAX).astype(np.float16)


def write_png(path: str | Path, pixels: np.ndarray) -> None:
    """Write codes as they are, uint8 or uint16 ``[h, w, channels]``, as PNG: display-referred sRGB, or stored depth.

    Raises:
        FileError: The file cannot be written; nothing is left behind.
    """
    import OpenImageIO as oiio

    height, width, channels = pixels.shape
    kind = np.uint16 if pixels.dtype == np.uint16 else np.uint8
    spec = oiio.ImageSpec(width, height, channels, kind.__name__)
    with replacing(Path(path)) as temporary:
        output = oiio.ImageOutput.create("png")
        assert output is not None  # every build of OpenImageIO has PNG
        done = output.open(str(temporary), spec) and output.write_image(np.ascontiguousarray(pixels, kind))
        message = "" if done else output.geterror()
        closed = output.close()
        if not (done and closed):
            raise FileError(f"{path} cannot be written: {message or output.geterror()}")


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text, all of it or nothing.

    Raises:
        FileError: The file cannot be written; nothing is left behind.
    """
    with replacing(Path(path)) as temporary:
        try:
            temporary.write_text(text, encoding="utf-8")
        except OSError as error:
            raise FileError(f"{path} cannot be written: {error.strerror}") from error


def read_plate(path: str | Path, width: int | None = None, height: int | None = None) -> np.ndarray:
    """Read a photograph as scene-linear Rec.709.

    Integer images are taken to be sRGB (embedded profiles are not read), float images (EXR, HDR, float TIFF) linear.
    Grey becomes RGB, alpha is dropped without being multiplied in, EXIF orientation is applied, and an EXR's data
    window is placed in its display window.

    Args:
        path: Any file that OpenImageIO reads.
        width, height: Required size in pixels; None where any will do.
    Returns:
        float32 ``[h, w, 3]``, row 0 on top.
    Raises:
        FileError: Missing or corrupt, or not of the required size: a plate is never resampled.
    """
    import OpenImageIO as oiio

    name = str(path)
    if not os.path.isfile(name):
        raise FileError(f"plate '{name}' does not exist or is not a file; check the path")
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    image = oiio.ImageBuf(name, 0, 0, hints)
    if not image.read(0, 0, True):
        raise FileError(f"plate '{name}' cannot be read: {_once(image.geterror())}; is it an image?")
    native = image.nativespec()
    is_float = native.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
    image = oiio.ImageBufAlgo.reorient(image)
    pixels = _display_window(_rgb(image), image.spec())
    rows, columns = pixels.shape[:2]
    if height is None and width not in (None, columns):
        raise FileError(
            f"plate '{name}' is {columns} x {rows} pixels and --imageWidth {width}; a plate is not resampled: leave"
            " --imageWidth out, it decides the size"
        )
    if (width or columns, height or rows) != (columns, rows):
        raise FileError(
            f"plate '{name}' is {columns} x {rows} pixels but the picture is {width or columns} x {height or rows};"
            " a plate is not resampled: give --imageWidth and a camera that match it, or another plate"
        )
    return pixels if is_float else srgb_to_linear(pixels)


def _once(message: str) -> str:
    """OpenImageIO's error with each of its lines once; it tries to open twice, and says so."""
    return "; ".join(dict.fromkeys(line.strip() for line in message.splitlines() if line.strip()))


def is_display_referred(path: str | Path) -> bool:
    """Whether a photograph holds codes of a display: integers, which :func:`read_plate` decodes from sRGB.

    Raises:
        FileError: Missing, or no image.
    """
    import OpenImageIO as oiio

    image = oiio.ImageInput.open(str(path))
    if image is None:
        raise FileError(f"plate '{path}' cannot be read: {oiio.geterror()}; is it an image?")
    try:
        return image.spec().format.basetype not in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
    finally:
        image.close()


def _rgb(image) -> np.ndarray:
    """Colour channels of an OpenImageIO buffer, float32 ``[h, w, 3]``; grey is repeated."""
    spec = image.spec()
    pixels = np.asarray(image.get_pixels("float"), np.float32).reshape(spec.height, spec.width, spec.nchannels)
    names = list(spec.channelnames)
    if all(letter in names for letter in "RGB"):
        return np.ascontiguousarray(pixels[..., [names.index(letter) for letter in "RGB"]])
    return np.ascontiguousarray(pixels[..., :3] if spec.nchannels >= 3 else np.repeat(pixels[..., :1], 3, 2))


def _display_window(pixels: np.ndarray, spec) -> np.ndarray:
    """Place the data window in the display window; black where there is no data."""
    if (spec.x, spec.y, spec.width, spec.height) == (spec.full_x, spec.full_y, spec.full_width, spec.full_height):
        return pixels
    left, top = spec.x - spec.full_x, spec.y - spec.full_y
    full = np.zeros((spec.full_height, spec.full_width, 3), np.float32)
    x0, x1 = max(left, 0), min(left + spec.width, spec.full_width)
    y0, y1 = max(top, 0), min(top + spec.height, spec.full_height)
    if x0 < x1 and y0 < y1:
        full[y0:y1, x0:x1] = pixels[y0 - top : y1 - top, x0 - left : x1 - left]
    return full


def srgb_to_linear(values: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1 decoding, float32; [0, 1] to [0, 1]."""
    wide = np.asarray(values, np.float64)
    return np.where(wide <= 0.04045, wide / 12.92, (np.maximum(wide, 0.04045) + 0.055) ** 2.4 / 1.055**2.4).astype(
        np.float32
    )


def check_writable(path: str | Path) -> None:
    """Find out before the work whether a file can be written, by making and removing one beside it.

    Raises:
        FileError: The folder is missing or cannot be written, or ``path`` is a folder.
    """
    target = Path(path)
    if target.is_dir():
        raise FileError(f"{target} is a folder; give the name of a file in it")
    if not target.parent.is_dir():
        raise FileError(f"{target} cannot be written: the folder {target.parent} does not exist; create it")
    probe = _temporary(target)
    try:
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        raise FileError(
            f"{target} cannot be written: {error.strerror or error} in {target.parent}; choose another folder"
        ) from error


def _temporary(path: Path) -> Path:
    """A hidden name in the same folder (a rename across file systems is a copy) with the same ending."""
    return path.with_name(f".{path.stem}.{uuid.uuid4().hex[:12]}{path.suffix}")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name that becomes ``path`` at the end, and is removed if that is not reached."""
    temporary = _temporary(path)
    try:
        yield temporary
        try:
            os.replace(temporary, path)
        except OSError as error:
            raise FileError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)

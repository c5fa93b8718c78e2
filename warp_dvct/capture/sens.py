"""ScanNet's ``.sens`` container: one file with compressed colour and depth frames, unpacked to images."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from warp_dvct.capture.formats import Dataset
from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.capture.stage import FrameFiles, rigid_problem
from warp_dvct.errors import FileError
from warp_dvct.image import replacing, write_png

VERSION = 4
COLOR_ENDINGS = {1: "png", 2: "jpg"}
RAW, ZLIB = 0, 1  # of 16-bit depth


@dataclass(frozen=True)
class _Header:
    color: np.ndarray
    color_to_rig: np.ndarray
    depth: np.ndarray
    depth_to_rig: np.ndarray
    color_kind: int
    depth_kind: int
    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    shift: float
    count: int


def read_sens(file: Path, target: Path, progress: Callable[[int, int], None] = lambda done, total: None) -> Dataset:
    """Unpack a ``.sens`` file.

    Args:
        file: The container.
        target: Folder for ``depth/`` and ``color/``; made where it is absent. Images that are there are replaced one
            by one, each whole.
        progress: Called with frames done and in all.
    Raises:
        FileError: It is no such file, or of another version, or holds no frame; a file that breaks off is read up to
            its last whole frame, and that is said in the notes.
    """
    for name in ("depth", "color"):
        (target / name).mkdir(parents=True, exist_ok=True)
    frames: list[FrameFiles] = []
    notes: list[str] = []
    try:
        with file.open("rb") as stream:
            header = _read_header(stream, file)
            for number in range(header.count):
                try:
                    frames.append(_read_frame(stream, header, number, target, notes))
                except (EOFError, zlib.error, struct.error) as error:
                    notes.append(f"the file breaks off in frame {number} of {header.count} ({error})")
                    break
                progress(number + 1, header.count)
    except OSError as error:
        raise FileError(f"'{file}' cannot be read or unpacked: {error.strerror or error}") from error
    if not frames:
        raise FileError(f"'{file}' holds no whole frame; {'; '.join(notes) or 'the capture is empty'}")
    return Dataset(
        "scannet",
        frames,
        _lens(header.depth, header.depth_size),
        _lens(header.color, header.color_size),
        np.linalg.inv(header.color_to_rig) @ header.depth_to_rig,
        1.0 / header.shift,
        (0,),
        notes,
    )


def _take(stream: BinaryIO, count: int) -> bytes:
    data = stream.read(count)
    if len(data) != count:
        raise EOFError(f"{count - len(data)} bytes are missing")
    return data


def _matrix(stream: BinaryIO) -> np.ndarray:
    return np.frombuffer(_take(stream, 64), "<f4").reshape(4, 4).astype(np.float64)


def _read_header(stream: BinaryIO, file: Path) -> _Header:
    try:
        version, length = struct.unpack("<IQ", _take(stream, 12))
        if version != VERSION or length > 4096:
            raise FileError(f"'{file}' is not a .sens file of version {VERSION} (it says {version})")
        _take(stream, length)
        color, color_to_rig, depth, depth_to_rig = (_matrix(stream) for _ in range(4))
        color_kind, depth_kind, *sizes = struct.unpack("<ii4I", _take(stream, 24))
        shift, count = struct.unpack("<fQ", _take(stream, 12))
    except EOFError as error:
        raise FileError(f"'{file}' is too short for a .sens file ({error})") from error
    if color_kind not in COLOR_ENDINGS or depth_kind not in (RAW, ZLIB):
        raise FileError(
            f"'{file}' stores colour by method {color_kind} and depth by {depth_kind}; PNG (1) or JPEG (2), and raw (0)"
            " or zlib (1) are understood: export it with ScanNet's SensReader and import the folder"
        )
    if not shift > 0.0:
        raise FileError(f"'{file}': its depth shift is {shift}; it must be positive")
    return _Header(
        color,
        color_to_rig,
        depth,
        depth_to_rig,
        color_kind,
        depth_kind,
        (sizes[0], sizes[1]),
        (sizes[2], sizes[3]),
        shift,
        count,
    )


def _read_frame(stream: BinaryIO, header: _Header, number: int, target: Path, notes: list[str]) -> FrameFiles:
    pose = _matrix(stream)
    _, time, color_bytes, depth_bytes = struct.unpack("<4Q", _take(stream, 32))
    color, packed = _take(stream, color_bytes), _take(stream, depth_bytes)
    stored = np.frombuffer(zlib.decompress(packed) if header.depth_kind == ZLIB else packed, "<u2")
    width, height = header.depth_size
    if stored.size != width * height:
        raise EOFError(f"its depth has {stored.size} values, not {width} x {height}")
    depth_file = target / "depth" / f"{number:06d}.png"
    color_file = target / "color" / f"{number:06d}.{COLOR_ENDINGS[header.color_kind]}"
    write_png(depth_file, stored.reshape(height, width, 1).astype(np.uint16))
    with replacing(color_file) as temporary:
        temporary.write_bytes(color)
    problem = rigid_problem(pose)
    if problem:
        notes.append(f"frame {number}: its pose {problem} and is taken as lost")
    return FrameFiles(str(depth_file), str(color_file), None if problem else pose, timestamp=time * 1e-6)


def _lens(matrix: np.ndarray, size: tuple[int, int]) -> Intrinsics:
    return Intrinsics(*size, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])

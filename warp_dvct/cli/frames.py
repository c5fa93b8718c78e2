"""Frame numbers in file names, as usdrecord has them: ``OUT.####.exr``, or ``OUT.####.##.exr`` for parts of frames."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

PLACEHOLDER = re.compile(r"(#+)(?:\.(#+))?")


def has_placeholder(path: str) -> bool:
    """Whether the file name (not its folder) has a place for the frame number."""
    return bool(PLACEHOLDER.search(Path(path).name))


def decimals(path: str) -> int:
    """Digits after the point that the file name has room for."""
    match = PLACEHOLDER.search(Path(path).name)
    return len(match.group(2) or "") if match else 0


def frame_path(path: str, frame: float) -> str:
    """Put a frame number, padded with zeros, where the file name has its #; unchanged where it has none."""
    name = Path(path).name
    match = PLACEHOLDER.search(name)
    if not match:
        return path
    digits, places = len(match.group(1)), len(match.group(2) or "")
    width = digits + 1 + places if places else digits
    number = f"{frame:0{width + (frame < 0)}.{places}f}"
    return str(Path(path).with_name(name[: match.start()] + number + name[match.end() :]))


def lost_frame(path: str, frames: Sequence[float]) -> float | None:
    """The first frame whose number the file name cannot tell from another's; None where all fit."""
    places = decimals(path)
    return next((frame for frame in frames if abs(round(frame, places) - frame) > 1e-9), None)

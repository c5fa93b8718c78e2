"""What reconstruction takes of a capture: frames one at a time, each with why it cannot be used where it cannot."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from warp_dvct.errors import DvctError, FileError

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class RgbdFrame:
    """A depth image with the colours that its pixels see.

    Attributes:
        name: For messages.
        depth: Along the view axis in metres, float32 ``[h, w]``; 0 where nothing was measured.
        color: Linear Rec.709 registered to the depth image, float32 ``[h, w, 3]``; NaN where the colour camera does not
            see the point; None where there is no photograph.
        K: Intrinsics of the depth image, float64 ``[3, 3]``, the centre of the top left pixel at (0, 0).
        pose: Camera (x right, y down, z forward) to world in metres, 4x4; None where it is not known.
    """

    name: str
    depth: np.ndarray
    color: np.ndarray | None
    K: np.ndarray
    pose: np.ndarray | None


class FrameSource(Protocol):
    """Frames that are read when asked for; asking raises ``DvctError`` where a frame is damaged."""

    def __len__(self) -> int: ...

    def name(self, index: int) -> str:
        """What messages call the frame."""
        ...

    def frame(self, index: int, *, color: bool = True) -> RgbdFrame:
        """Read a frame, without its colour where that is not needed."""
        ...


@dataclass
class Skipped:
    """Frames that are left out, by index, and why. It only grows: a frame found bad once is not read again."""

    reasons: dict[int, str] = field(default_factory=dict)

    def add(self, index: int, reason: str) -> None:
        """Leave a frame out; the first reason counts."""
        self.reasons.setdefault(index, reason)


def usable_frames(
    source: FrameSource, skipped: Skipped, *, color: bool = True, posed: bool = True
) -> Iterator[tuple[int, RgbdFrame]]:
    """The frames that can be read, in order; the others go to ``skipped``.

    Args:
        posed: Frames without a pose are left out too.
    Raises:
        FileError: No frame can be used; it gives the first reason.
    """
    count = len(source)
    for index in range(count):
        if index in skipped.reasons:
            continue
        try:
            frame = source.frame(index, color=color)
        except DvctError as error:
            skipped.add(index, str(error))
            continue
        if posed and frame.pose is None:
            skipped.add(index, f"{frame.name}: its pose is not known; find it by --track or --markers")
        elif not (frame.depth > 0.0).any():
            skipped.add(index, f"{frame.name}: no pixel has a depth")
        else:
            yield index, frame
    if len(skipped.reasons) >= count:
        first = next(iter(skipped.reasons.values()), "there are no frames")
        raise FileError(f"none of {count} frames can be used; the first: {first}")


@dataclass(frozen=True)
class FrameList:
    """Frames that are in memory already."""

    frames: Sequence[RgbdFrame]

    def __len__(self) -> int:
        return len(self.frames)

    def name(self, index: int) -> str:
        """The frame's own."""
        return self.frames[index].name

    def frame(self, index: int, *, color: bool = True) -> RgbdFrame:
        """The frame, with its colour in any case."""
        return self.frames[index]

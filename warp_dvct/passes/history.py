"""Means over the frames of a shot in which nothing but the camera moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from warp_dvct.kernels.history import Past, _blend_past, _blend_same
from warp_dvct.launch import Launcher
from warp_dvct.passes.gbuffer import GBuffer


@dataclass(frozen=True)
class History:
    """What a frame leaves to the next.

    Attributes:
        view: Key of the camera and of what else decides the shading points.
        with_before: Whether both solutions are known, or only their difference.
        steady: Frames in a row, up to this one, with that view.
        past: ``kernels.history.Past``: irradiance of places, before and after.
        seen: What depends on the view, by name: vec3 arrays.
    """

    view: str
    with_before: bool
    steady: int
    past: Any
    seen: dict[str, Any]


class Blender:
    """Blends one frame with the frames before it.

    Args:
        history: The last frame's; None for a first frame, which is then left as it is.
        view, with_before: Of this frame; ``with_before`` as in ``history``.
        camera: ``kernels.geometry.CameraFrame`` of this frame.
        most: Frames that a mean is of at most; older ones fade.
    """

    def __init__(
        self,
        launcher: Launcher,
        history: History | None,
        buffer: GBuffer,
        view: str,
        with_before: bool,
        camera: Any,
        most: int,
    ) -> None:
        self._launcher, self._buffer, self._camera, self._most = launcher, buffer, camera, most
        self._view, self._with_before = view, with_before
        self._old = history
        self._still = history is not None and history.view == view
        self._seen: dict[str, Any] = {}
        self._past: Any = None

    def irradiance(self, before: Any, after: Any) -> None:
        """Blend irradiance at the buffer's points in place, by what the past knows of their places."""
        launcher, buffer = self._launcher, self._buffer
        frames = launcher.full(buffer.count, 1.0, wp.float32)
        if self._old is not None:
            launcher.launch(
                _blend_past,
                buffer.count,
                [self._old.past, buffer.points, int(self._still), float(self._most)],
                [before, after, frames],
            )
        past = Past()
        past.camera, past.width, past.height = self._camera, buffer.width, buffer.height
        past.points, past.frames, past.before, past.after = buffer.points, frames, before, after
        self._past = past

    def seen(self, name: str, values: Any) -> None:
        """Blend what depends on the view in place, where the view is the last frame's."""
        if self._old is not None and self._still:
            frames = float(min(self._old.steady, self._most - 1))
            self._launcher.launch(_blend_same, values.shape[0], [self._old.seen[name], frames], [values])
        kept = self._launcher.empty(values.shape[0], wp.vec3)
        wp.copy(kept, values)
        self._seen[name] = kept

    def history(self) -> History:
        """What this frame leaves; :meth:`irradiance` was called before."""
        steady = self._old.steady + 1 if self._old is not None and self._still else 1
        return History(self._view, self._with_before, steady, self._past, self._seen)

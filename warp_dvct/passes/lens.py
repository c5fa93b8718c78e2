"""Lens distortion of the photograph, put on the rendering: a pinhole that sees more draws it, then it is bent."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.errors import StageError
from warp_dvct.kernels import lens as kernels
from warp_dvct.launch import Launcher
from warp_dvct.layers import Radiance
from warp_dvct.lens import undistort
from warp_dvct.scene import Camera

MARGIN = 2.5  # pixels around what the lens shows; the half lets pixels of a lens that hardly bends coincide
MOST_WIDENED = 3.0  # times the picture's edge that a pinhole may need


@dataclass(frozen=True)
class LensView:
    """How a picture behind a lens is rendered.

    Attributes:
        width, height: Of the finished picture.
        camera: Pinhole that sees all that the lens shows.
        drawn_width, drawn_height: Of its picture, with pixels as large as the lens's in its middle.
        place: Where in it the lens's pixels are taken from, float32 ``[width * height, 2]``; -1 where the lens shows
            nothing.
    """

    width: int
    height: int
    camera: Camera
    drawn_width: int
    drawn_height: int
    place: np.ndarray

    @classmethod
    def of(cls, camera: Camera, width: int, height: int) -> LensView | None:
        """The view of a camera with distortion, or None where it has none.

        Raises:
            StageError: The lens bends too far for a pinhole.
        """
        if not any(camera.distortion):
            return None
        edges = camera.tan_left, camera.tan_right, camera.tan_bottom, camera.tan_top
        low, pixel, drawn, place = _widened(edges, camera.distortion, width, height, camera.path)
        high = low + drawn * pixel
        pinhole = replace(
            camera, tan_left=low[0], tan_right=high[0], tan_top=-low[1], tan_bottom=-high[1], distortion=()
        )
        return cls(width, height, pinhole, int(drawn[0]), int(drawn[1]), place)

    def bend(self, launcher: Launcher, radiance: Radiance) -> Radiance:
        """A rendering of :attr:`camera` as the lens shows it: means bilinearly, surfaces from the nearest pixel."""
        count = self.width * self.height
        with_before = radiance.before is not None
        source, out = _structs(launcher, radiance, count, with_before)
        place = launcher.array(self.place.astype(np.float32), wp.vec2)
        launcher.launch(
            kernels._resample,
            count,
            [*source, place, self.drawn_width, self.drawn_height, int(with_before), float("inf")],
            list(out),
        )
        filtered, surfaces = out
        return Radiance(
            width=self.width,
            height=self.height,
            before=filtered.before if with_before else None,
            delta=filtered.delta,
            synthetic=filtered.synthetic,
            albedo=surfaces.albedo,
            normal=surfaces.normal,
            position=surfaces.position,
            depth=surfaces.depth,
            mask_real=filtered.mask_real,
        )


@lru_cache(maxsize=2)  # frames of a shot share a lens
def _widened(
    edges: tuple[float, float, float, float], distortion: tuple[float, ...], width: int, height: int, path: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The least x and y that the lens shows, a pixel's size, the pinhole's size in pixels, and ``LensView.place``."""
    left, right, bottom, top = edges
    pixel = np.array([(right - left) / width, (top - bottom) / height])
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    seen = np.stack(undistort(left + pixel[0] * u, -top + pixel[1] * v, distortion), -1).reshape(-1, 2)
    if not np.isfinite(seen).any():
        raise StageError(f"{path}: its lens distortion shows nothing; correct omni:lensdistortion")
    low = np.nanmin(seen, 0) - MARGIN * pixel
    drawn = np.ceil((np.nanmax(seen, 0) + MARGIN * pixel - low) / pixel).astype(int)
    if (drawn > MOST_WIDENED * np.array([width, height])).any():
        raise StageError(
            f"{path}: its lens distortion needs a picture of {drawn[0]} x {drawn[1]} pixels behind {width} x {height};"
            " a fish-eye is not a pinhole with opencvPinhole coefficients"
        )
    return low, pixel, drawn, np.nan_to_num((seen - low) / pixel - 0.5, nan=-1.0)


def _structs(launcher: Launcher, radiance: Radiance, count: int, with_before: bool) -> tuple[tuple, tuple]:
    """The kernel's structs over a rendering, and new ones for ``count`` pixels."""
    source: list[Any] = []
    out: list[Any] = []
    for kind in (kernels.Filtered, kernels.Surfaces):
        given, made = kind(), kind()
        for name, variable in kind.vars.items():
            absent = name == "before" and not with_before
            setattr(given, name, launcher.zeros(1, wp.vec3) if absent else getattr(radiance, name))
            setattr(made, name, launcher.zeros(1 if absent else count, variable.type.dtype))
        source.append(given)
        out.append(made)
    return tuple(source), tuple(out)

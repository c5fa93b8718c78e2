"""What a method hands to the composite, and what a frame hands to the user."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Radiance:
    """Per-pixel results of a method, as flat device arrays of length ``width * height``, row 0 on top.

    Attributes:
        width, height: Size in pixels.
        before: vec3, mean radiance of the real scene alone over the whole pixel; it is the plate where there is none.
            None where a plate is given and the method had no need of it.
        delta: vec3, after minus before over the part of the pixel that shows real surface (or background) in the after
            picture, summed over that part and divided by the whole pixel; 0 where there is no such part.
        synthetic: vec4, synthetic radiance premultiplied by its coverage, and the coverage.
        albedo, normal, position: vec3 of the first surface seen (synthetic or real) at the pixel's centre; normal and
            position in world space and metres; 0 where there is none.
        depth: float, distance along the view axis in metres; inf where there is no surface.
        mask_real: float, coverage of the pixel by real surface in the after picture.
    """

    width: int
    height: int
    before: Any
    delta: Any
    synthetic: Any
    albedo: Any
    normal: Any
    position: Any
    depth: Any
    mask_real: Any


@dataclass(frozen=True)
class Layers:
    """A finished frame: scene-linear float32 NumPy arrays, shape ``[h, w, channels]``, row 0 on top.

    ``comp = rgba over (plate * shadow + added)`` to half precision, and where nothing changed comp is the plate bit
    for bit.

    Attributes:
        rgba: ``[h, w, 4]``, synthetic objects alone, premultiplied.
        comp: ``[h, w, 3]``, the finished picture.
        plate: ``[h, w, 3]``, as used, linear.
        shadow: ``[h, w, 3]``, ratio in [0, 1] with / without the synthetic objects on real surfaces; 1 is unchanged.
        added: ``[h, w, 3]``, light added on real surfaces, non-negative.
        delta: ``[h, w, 3]``, signed after minus before on real surfaces.
        albedo, normal, position: ``[h, w, 3]``; position in metres, world space.
        depth: ``[h, w]``, metres along the view axis; inf where nothing is seen.
        mask_real, mask_synthetic: ``[h, w]``, coverage in [0, 1].
        holes: ``[h, w]``, the share of the pixel in which a capture knows no real surface, so that the plate is kept;
            None where the real scene comes from no capture.
        clamped: Channel values that half precision cannot hold and that were clamped to +-65504.
        invalid: NaN channel values that were set to 0.
    """

    rgba: np.ndarray
    comp: np.ndarray
    plate: np.ndarray
    shadow: np.ndarray
    added: np.ndarray
    delta: np.ndarray
    albedo: np.ndarray
    normal: np.ndarray
    position: np.ndarray
    depth: np.ndarray
    mask_real: np.ndarray
    mask_synthetic: np.ndarray
    holes: np.ndarray | None = None
    clamped: int = 0
    invalid: int = 0

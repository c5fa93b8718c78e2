"""Live filtering of depth images: warp the last result, merge, fill, smooth (Knecht et al. 2012, section 4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.errors import OptionError
from warp_dvct.kernels import depth_filter as kernels
from warp_dvct.kernels import edge_snapping
from warp_dvct.launch import Launcher

# Of Kinect v1's inverse depth [1/m]: a sixth of a pixel of disparity at f = 585 px and b = 75 mm (Khoshelham 2012).
KINECT_NOISE = (1.0 / 6.0) / (585.0 * 0.075)


@dataclass(frozen=True)
class FilterOptions:
    """Knobs of the filter.

    Attributes:
        noise: Standard deviation of inverse depth [1/m]; thresholds are multiples of it.
        frames: Most frames that are averaged.
        edge: Difference between neighbours on one surface, in ``noise``; plus ``edge_share`` of the inverse depth.
        agree: Difference between two measurements of one point, in ``noise``; plus ``agree_share``.
        fill: Pixels from their edge that holes are filled; 0 for none.
        smooth: A-trous levels; 0 for none.
        snap: Times that jumps are moved to the photograph's edges, where there is one; 0 for never.
        contrast: Difference of colours (of codes in [0, 1], all channels together) from which they tell surfaces apart.
        smooth_limit: Bend that is taken for noise at the first level, in ``noise``; half of it at each further one.
    """

    noise: float = KINECT_NOISE
    frames: int = 32
    edge: float = 5.0
    edge_share: float = 0.02
    agree: float = 5.0
    agree_share: float = 0.01
    fill: int = 12
    smooth: int = 4
    smooth_limit: float = 4.0
    snap: int = 2
    contrast: float = 0.08

    def __post_init__(self) -> None:
        if self.noise <= 0.0 or self.frames < 1 or min(self.fill, self.smooth) < 0:
            raise OptionError(f"{self}: noise and frames must be positive, fill and smooth not negative")


@dataclass(frozen=True)
class Guide:
    """A photograph that tells where surfaces end.

    Attributes:
        codes: uint8 ``[h, w, 3]``, as stored.
        lens: ``(fx, fy, cx, cy)`` of its camera, which does not distort.
        depth_to_color: 4x4, from the depth camera to it.
    """

    codes: np.ndarray
    lens: tuple[float, float, float, float]
    depth_to_color: np.ndarray


@dataclass(frozen=True)
class FilteredDepth:
    """One filtered depth image, as flat device arrays, row 0 on top.

    Attributes:
        width, height: In pixels.
        inverse: float, 1 / depth along the view axis [1/m], smoothed; 0 where nothing is known.
        normal: vec3, unit, towards the camera, in camera axes (OpenCV); 0 where there is none.
        kind: int, ``NOTHING``, ``MEASURED``, ``CARRIED`` or ``FILLED`` of ``kernels.depth_filter``.
        weight: float, frames that were averaged; 0 where filled.
    """

    width: int
    height: int
    inverse: Any
    normal: Any
    kind: Any
    weight: Any

    def depth(self) -> np.ndarray:
        """Metres, float32 ``[h, w]``; 0 where nothing is known."""
        inverse = self.inverse.numpy().reshape(self.height, self.width)
        return np.divide(1.0, inverse, out=np.zeros_like(inverse), where=inverse > 0.0)

    def normals(self) -> np.ndarray:
        """float32 ``[h, w, 3]``."""
        return self.normal.numpy().reshape(self.height, self.width, 3)

    def kinds(self) -> np.ndarray:
        """int32 ``[h, w]``."""
        return self.kind.numpy().reshape(self.height, self.width)


class DepthFilter:
    """Keeps the filtered depth of the last frame and takes it on to the next.

    Args:
        launcher: Device.
        lens: ``(fx, fy, cx, cy)`` in pixels, pixel centres at whole numbers.
        size: Width and height.
        options: Knobs.
    """

    def __init__(
        self,
        launcher: Launcher,
        lens: tuple[float, float, float, float],
        size: tuple[int, int],
        options: FilterOptions | None = None,
    ) -> None:
        self._launcher, self._options = launcher, options or FilterOptions()
        self._lens = _lens_of(lens, size)
        self._limits = _limits(self._options)
        self._state: tuple[Any, Any, np.ndarray] | None = None

    def reset(self) -> None:
        """Forget the past, as after a cut."""
        self._state = None

    def update(self, depth: np.ndarray, pose: np.ndarray, guide: Guide | None = None) -> FilteredDepth:
        """Filter the next frame.

        Args:
            depth: Metres along the view axis, float32 ``[h, w]``; 0 where nothing was measured.
            pose: Camera (OpenCV axes) to world, 4x4.
            guide: The frame's photograph.
        Raises:
            OptionError: The image is not of the lens's size.
        """
        launcher, lens = self._launcher, self._lens
        if depth.shape != (lens.height, lens.width):
            raise OptionError(f"the depth image has shape {depth.shape}; the lens has {(lens.height, lens.width)}")
        count = lens.width * lens.height
        measured = launcher.empty(count, wp.float32)
        stored = launcher.array(depth.astype(np.float32).ravel(), wp.float32)
        launcher.launch(kernels._invert, count, [stored], [measured])
        with launcher.scope("warp"):
            warped, warped_weight = self._warp(pose)
        inverse, weight = launcher.empty(count, wp.float32), launcher.empty(count, wp.float32)
        kind = launcher.empty(count, wp.int32)
        with launcher.scope("merge"):
            launcher.launch(
                kernels._merge,
                count,
                [self._limits, measured, warped, warped_weight, float(self._options.frames)],
                [inverse, weight, kind],
            )
        self._state = inverse, weight, np.array(pose, np.float64)
        with launcher.scope("fill"):
            filled, kind = self._fill(inverse, kind)
        if guide is not None and self._options.snap > 0:
            with launcher.scope("snap"):
                filled = self._snap(filled, guide)
        with launcher.scope("smooth"):
            smooth = self._smooth(filled)
        normal = launcher.empty(count, wp.vec3)
        with launcher.scope("normals"):
            launcher.launch(kernels._find_normals, count, [lens, self._limits, smooth], [normal])
        return FilteredDepth(lens.width, lens.height, smooth, normal, kind, weight)

    def _warp(self, pose: np.ndarray) -> tuple[Any, Any]:
        """The last result as the camera at ``pose`` sees it; 0 where it does not."""
        launcher, lens = self._launcher, self._lens
        count = lens.width * lens.height
        warped, weight = launcher.zeros(count, wp.float32), launcher.zeros(count, wp.float32)
        if self._state is None:
            return warped, weight
        inverse, old_weight, old_pose = self._state
        relative = np.linalg.inv(pose) @ old_pose
        moved = launcher.empty(count, wp.vec3)
        turn, shift = wp.mat33(*relative[:3, :3].ravel().tolist()), wp.vec3(*relative[:3, 3].tolist())
        launcher.launch(kernels._move_vertices, count, [lens, inverse, turn, shift], [moved])
        across, down = (-(-n // int(kernels.SOURCE_TILE)) for n in (lens.width, lens.height))
        box = launcher.empty(across * down, wp.vec4)
        launcher.launch(kernels._bound_tiles, across * down, [lens, moved, across], [box])
        wide, high = (-(-n // int(kernels.TARGET_TILE)) for n in (lens.width, lens.height))
        inputs = [lens, self._limits, inverse, old_weight, moved, box, across, wide]
        launcher.launch(kernels._draw_tiles, wide * high, inputs, [warped, weight])
        return warped, weight

    def _fill(self, inverse: Any, kind: Any) -> tuple[Any, Any]:
        launcher, lens = self._launcher, self._lens
        count = lens.width * lens.height
        for _ in range(self._options.fill):
            inverse_out, kind_out = launcher.empty(count, wp.float32), launcher.empty(count, wp.int32)
            launcher.launch(kernels._fill, count, [lens, self._limits, inverse, kind], [inverse_out, kind_out])
            inverse, kind = inverse_out, kind_out
        return inverse, kind

    def _snap(self, inverse: Any, guide: Guide) -> Any:
        launcher, lens = self._launcher, self._lens
        count = lens.width * lens.height
        height, width = guide.codes.shape[:2]
        photo = launcher.array((guide.codes.reshape(-1, 3) / np.float32(255.0)).astype(np.float32), wp.vec3)
        m = guide.depth_to_color
        turn, shift = wp.mat33(*m[:3, :3].ravel().tolist()), wp.vec3(*m[:3, 3].tolist())
        for _ in range(self._options.snap):
            color, mark = launcher.empty(count, wp.vec3), launcher.empty(count, wp.int32)
            out = launcher.empty(count, wp.float32)
            inputs = [lens, inverse, turn, shift, _lens_of(guide.lens, (width, height)), photo]
            launcher.launch(edge_snapping._sample_guide, count, inputs, [color])
            launcher.launch(edge_snapping._mark_jumps, count, [lens, self._limits, inverse], [mark])
            across, down = (-(-n // int(edge_snapping.TILE)) for n in (lens.width, lens.height))
            flag = launcher.empty(across * down, wp.int32)
            launcher.launch(edge_snapping._flag_tiles, across * down, [lens, mark, across], [flag])
            inputs = [lens, inverse, color, mark, flag, across, self._options.contrast]
            launcher.launch(edge_snapping._snap, count, inputs, [out])
            inverse = out
        return inverse

    def _smooth(self, inverse: Any) -> Any:
        launcher, lens, options = self._launcher, self._lens, self._options
        for level in range(options.smooth):
            out = launcher.empty(lens.width * lens.height, wp.float32)
            limit = options.smooth_limit * options.noise * 0.5**level
            launcher.launch(kernels._smooth, lens.width * lens.height, [lens, limit, 1 << level, inverse], [out])
            inverse = out
        return inverse


def _lens_of(numbers: tuple[float, float, float, float], size: tuple[int, int]) -> Any:
    lens = kernels.Lens()
    lens.fx, lens.fy, lens.cx, lens.cy = numbers
    lens.width, lens.height = size
    return lens


def _limits(options: FilterOptions) -> Any:
    limits = kernels.Limits()
    limits.edge_fixed, limits.edge_share = options.edge * options.noise, options.edge_share
    limits.agree_fixed, limits.agree_share = options.agree * options.noise, options.agree_share
    return limits

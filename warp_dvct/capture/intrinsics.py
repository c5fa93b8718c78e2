"""Cameras of captures: pinhole intrinsics with OpenCV's lens distortion.

Pixel coordinates are OpenCV's: the centre of the top left pixel is (0, 0). Camera axes are OpenCV's too: x right,
y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_dvct.errors import OptionError
from warp_dvct.lens import COEFFICIENTS, distort, undistort
from warp_dvct.scene import Camera

# OpenCV's camera axes as seen from USD's (x right, y up, z backward), and back: its own inverse.
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Intrinsics:
    """A camera of ``width`` x ``height`` pixels.

    Attributes:
        width, height: Size in pixels.
        fx, fy: Focal lengths [pixels].
        cx, cy: Principal point [pixels]; the image's middle is ((width - 1) / 2, (height - 1) / 2).
        distortion: OpenCV's coefficients k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4, as many as there are.
    Raises:
        OptionError: A size or focal length is not positive, or a number is not finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not np.isfinite(numbers).all():
            raise OptionError(f"intrinsics {numbers}: every number must be finite")
        if min(self.width, self.height) < 1 or min(self.fx, self.fy) <= 0.0:
            raise OptionError(
                f"intrinsics of {self.width} x {self.height} pixels with fx={self.fx:g}, fy={self.fy:g}: size and focal"
                " lengths must be positive"
            )
        if len(self.distortion) > len(COEFFICIENTS):
            raise OptionError(f"{len(self.distortion)} distortion coefficients; at most {len(COEFFICIENTS)} are known")

    @property
    def K(self) -> np.ndarray:
        """The matrix, float64 ``[3, 3]``."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        """Whether any coefficient is not zero."""
        return any(self.distortion)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.width, self.height

    def scene_camera(self, pose: np.ndarray, path: str = "") -> Camera:
        """The camera for rendering.

        Args:
            pose: Camera (OpenCV axes) to world, 4x4 for column vectors.
            path: Prim path, for messages.
        """
        return Camera(
            to_world=np.asarray(pose, np.float64) @ FLIP,
            tan_left=(-0.5 - self.cx) / self.fx,
            tan_right=(self.width - 0.5 - self.cx) / self.fx,
            tan_bottom=(self.cy - self.height + 0.5) / self.fy,
            tan_top=(self.cy + 0.5) / self.fy,
            distortion=self.distortion if self.is_distorted else (),
            path=path,
        )

    @classmethod
    def of_scene_camera(cls, camera: Camera, width: int, height: int) -> Intrinsics:
        """The inverse of :meth:`scene_camera` for a picture of that size."""
        fx = width / (camera.tan_right - camera.tan_left)
        fy = height / (camera.tan_top - camera.tan_bottom)
        cx, cy = -camera.tan_left * fx - 0.5, camera.tan_top * fy - 0.5
        return cls(width, height, fx, fy, cx, cy, camera.distortion)

    def rays(self) -> np.ndarray:
        """Undistorted directions through all pixel centres with z = 1, float64 ``[h, w, 3]``."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        x, y = undistort((u - self.cx) / self.fx, (v - self.cy) / self.fy, self.distortion)
        return np.stack([x, y, np.ones_like(x)], -1)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Distorted pixel coordinates ``[..., 2]`` of points ``[..., 3]`` in camera axes; NaN where z <= 0."""
        z = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
        x, y = distort(points[..., 0] / z, points[..., 1] / z, self.distortion)
        return np.stack([x * self.fx + self.cx, y * self.fy + self.cy], -1)

"""A capture stage as frames to reconstruct from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warp_dvct.capture.frames import RgbdFrame
from warp_dvct.capture.registration import register_color, undistorted_depth
from warp_dvct.capture.stage import Capture, CaptureRig, rigid_problem
from warp_dvct.errors import FileError
from warp_dvct.image import srgb_to_linear

LINEAR = srgb_to_linear(np.arange(256, dtype=np.float32) / 255.0)
NEAREST = 0.5  # metres, where a distance between the two cameras shows most
SAME_PIXEL = 0.05  # pixels; the stage keeps intrinsics as float32


class CaptureFrames:
    """Frames of a capture: depth in metres, linear colour registered to depth, poses in the stage's world.

    Args:
        capture: The opened stage.
        poses: Depth camera to the stage's world for every frame, in place of the capture's; None for a lost frame.
    """

    def __init__(self, capture: Capture, poses: Sequence[np.ndarray | None] | None = None) -> None:
        self.capture = capture
        self.poses = poses

    def __len__(self) -> int:
        return len(self.capture)

    def name(self, index: int) -> str:
        """Frame number and stage."""
        return self.capture.name(index)

    def frame(self, index: int, *, color: bool = True) -> RgbdFrame:
        """Read a frame.

        Raises:
            FileError: An image is missing or damaged, or the pose is not rigid. StageError: The stage is wrong there.
        """
        capture = self.capture
        pose = capture.pose(index) if self.poses is None else self.poses[index]
        problem = None if pose is None else rigid_problem(pose)
        if problem:
            raise FileError(f"{self.name(index)}: its pose {problem}; leave the frame out or repair it")
        rig = capture.rig
        depth = capture.depth(index)
        if rig.depth.is_distorted:
            depth, lens = undistorted_depth(depth, rig.depth)
            rig = replace(rig, depth=lens)
        codes = capture.color(index) if color else None
        registered = None if codes is None else _registered(LINEAR[codes], depth, rig)
        return RgbdFrame(self.name(index), depth, registered, rig.depth.K, pose)


def _registered(color: np.ndarray, depth: np.ndarray, rig: CaptureRig) -> np.ndarray:
    """The photograph as the depth camera would have taken it; NaN where it does not show what has a depth."""
    if is_registered(rig):
        return color
    found = register_color(depth, color, rig)
    return np.where(found.visible[..., None], found.color, np.float32(np.nan))


def is_registered(rig: CaptureRig) -> bool:
    """Whether both cameras show a point at the same pixel, to a twentieth of one at NEAREST metres."""
    depth, color = rig.depth, rig.color
    if color is None or depth.size != color.size or depth.distortion != color.distortion:
        return False
    corners = np.array([[0.0, 0.0], [depth.width, 0.0], [0.0, depth.height], [depth.width, depth.height]])
    rays = (corners - [depth.cx, depth.cy]) / [depth.fx, depth.fy]
    points = NEAREST * np.column_stack([rays, np.ones(4)]) @ rig.depth_to_color[:3, :3].T + rig.depth_to_color[:3, 3]
    seen = points[:, :2] / points[:, 2:] * [color.fx, color.fy] + [color.cx, color.cy]
    return bool(np.abs(seen - corners).max() < SAME_PIXEL)

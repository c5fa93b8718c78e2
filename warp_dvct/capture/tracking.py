"""Camera poses from the images alone, by Open3D: from frame to frame, or from frame to the model fused so far.

Where it is wrong: errors add up (5 cm over 1.2 m were measured for frame to frame), walls without texture slip, and a
place that comes into view again is not recognised.

Steinbruecker et al. 2011, "Real-Time Visual Odometry from Dense RGB-D Images"; Newcombe et al. 2011, "KinectFusion".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_dvct.capture.frames import FrameSource, Progress, RgbdFrame, Skipped, usable_frames
from warp_dvct.capture.fusion import FusionOptions, clean_depth, open3d_for_reconstruction
from warp_dvct.capture.source import CaptureFrames
from warp_dvct.capture.stage import Capture, rigid_problem
from warp_dvct.errors import FileError, OptionError

TRACKERS = ("odometry", "model")
ITERATIONS = (20, 10, 5)  # from the coarsest of three levels to the finest
LEAST_FITNESS = 0.3  # share of pixels that must agree with what they are aligned to
MOST_RMSE = 0.05  # metres, of those that do
MOST_MOVE, MOST_TURN = 0.4, np.radians(30.0)  # between two frames: more is a jump, not a motion
DEPTH_DIFFERENCE = 0.07  # metres, beyond which two pixels are not of one surface (Open3D's own)
MODEL_BLOCKS = 20000


@dataclass(frozen=True)
class Track:
    """Poses of a capture.

    Attributes:
        poses: Depth camera (OpenCV axes) to world by frame, 4x4; None where the frame is lost.
        lost: Why, by index.
    """

    poses: tuple[np.ndarray | None, ...]
    lost: dict[int, str]


def track(
    source: FrameSource,
    tracker: str,
    start: np.ndarray,
    options: FusionOptions,
    *,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Track:
    """Find every frame's pose. A frame that cannot be aligned is lost; the next is tried against the last good one.

    Args:
        source: Frames in the order in which they were taken; their own poses are not read.
        tracker: ``odometry`` aligns frames with the one before, ``model`` with what has been fused so far.
        start: Pose of the first frame that can be read.
        options: Depth range; voxel of the model.
    Raises:
        OptionError: Open3D is missing, or there is no such tracker. FileError: No frame can be used.
    """
    if tracker not in TRACKERS:
        raise OptionError(f"--track is '{tracker}'; choose one of {', '.join(TRACKERS)}")
    report = progress or (lambda name, share: None)
    o3d = open3d_for_reconstruction(threads)
    skipped = Skipped()
    poses: list[np.ndarray | None] = [None] * len(source)
    aligner: Any = None
    pose = np.asarray(start, np.float64)
    for index, frame in usable_frames(source, skipped, posed=False):
        if tracker == "odometry" and frame.color is None:
            raise FileError(f"{frame.name} has no photograph; odometry needs them: use --track model")
        depth = clean_depth(o3d, frame.depth, options)
        if aligner is None:
            aligner = (_Odometry if tracker == "odometry" else _Model)(o3d, frame, options)
        else:
            move, problem = aligner.align(frame, depth, pose)
            if problem:
                skipped.add(index, f"{frame.name}: lost: {problem}")
                report("tracking", (index + 1) / len(source))
                continue
            pose = pose @ move
        poses[index] = pose
        aligner.accept(frame, depth, pose)
        report("tracking", (index + 1) / len(source))
    return Track(tuple(poses), dict(skipped.reasons))


def track_capture(
    capture: Capture,
    tracker: str,
    options: FusionOptions,
    *,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Track:
    """As :func:`track`, for a capture: it starts at the first known pose of the capture, or level where there is
    none."""
    known = (capture.pose(index) for index in capture)
    start = next((pose for pose in known if pose is not None and rigid_problem(pose) is None), capture.world)
    return track(
        CaptureFrames(capture, [np.eye(4)] * len(capture)), tracker, start, options, threads=threads, progress=progress
    )


def _problem(move: np.ndarray, fitness: float, rmse: float) -> str:
    """Why an alignment is not believed; empty where it is."""
    if not np.isfinite(move).all():
        return "the alignment is not finite"
    if fitness < LEAST_FITNESS:
        return f"only {fitness:.0%} of its pixels agree with what was seen before"
    if rmse > MOST_RMSE:
        return f"it is {100 * rmse:.1f} cm off what was seen before"
    turn = float(np.arccos(np.clip(0.5 * (np.trace(move[:3, :3]) - 1.0), -1.0, 1.0)))
    if np.linalg.norm(move[:3, 3]) > MOST_MOVE or turn > MOST_TURN:
        return f"it jumps by {np.linalg.norm(move[:3, 3]):.2f} m and {np.degrees(turn):.0f} degrees"
    return ""


class _Odometry:
    """Aligns a frame with the last good one, by depth and brightness."""

    def __init__(self, o3d: Any, first: RgbdFrame, options: FusionOptions) -> None:
        self._o3d, self._far, self._last = o3d, options.far, None
        self._K = o3d.core.Tensor(first.K)

    def align(self, frame: RgbdFrame, depth: np.ndarray, _pose: np.ndarray) -> tuple[np.ndarray, str]:
        """The frame's camera to that of the last good frame, and why it is lost, if it is."""
        odometry = self._o3d.t.pipelines.odometry
        criteria = [odometry.OdometryConvergenceCriteria(n) for n in ITERATIONS]
        try:
            result = odometry.rgbd_odometry_multi_scale(
                self._image(frame, depth),
                self._last,
                self._K,
                depth_scale=1.0,
                depth_max=self._far,
                criteria_list=criteria,
                method=odometry.Method.Hybrid,
            )
        except RuntimeError as error:  # a singular system: nothing overlaps
            return np.eye(4), str(error).strip().splitlines()[-1]
        move = result.transformation.numpy()
        return move, _problem(move, float(result.fitness), float(result.inlier_rmse))

    def accept(self, frame: RgbdFrame, depth: np.ndarray, _pose: np.ndarray) -> None:
        """The next frame is aligned with this one."""
        self._last = self._image(frame, depth)

    def _image(self, frame: RgbdFrame, depth: np.ndarray) -> Any:
        tensor, image = self._o3d.core.Tensor, self._o3d.t.geometry.Image
        return self._o3d.t.geometry.RGBDImage(image(tensor(_shown(frame))), image(tensor(depth)))


class _Model:
    """Aligns a frame with the surface fused from those before it."""

    def __init__(self, o3d: Any, first: RgbdFrame, options: FusionOptions) -> None:
        self._o3d, self._options = o3d, options
        slam, tensor = o3d.t.pipelines.slam, o3d.core.Tensor
        rows, columns = first.depth.shape
        cpu = o3d.core.Device("CPU:0")
        self._model = slam.Model(options.voxel, 16, MODEL_BLOCKS, tensor(np.eye(4)), cpu)
        self._input = slam.Frame(rows, columns, tensor(first.K), cpu)
        self._seen = slam.Frame(rows, columns, tensor(first.K), cpu)
        self._first: np.ndarray | None = None
        self._number = 0

    def align(self, frame: RgbdFrame, depth: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, str]:
        """The frame's camera to that of the last good frame, and why it is lost, if it is."""
        self._fill(frame, depth)
        try:
            result = self._model.track_frame_to_model(self._input, self._seen, 1.0, self._options.far, DEPTH_DIFFERENCE)
        except RuntimeError as error:
            return np.eye(4), str(error).strip().splitlines()[-1]
        move = result.transformation.numpy()
        return move, _problem(move, float(result.fitness), float(result.inlier_rmse))

    def accept(self, frame: RgbdFrame, depth: np.ndarray, pose: np.ndarray) -> None:
        """Fuse the frame into the model, and look at it from there."""
        self._fill(frame, depth)
        if self._first is None:
            self._first = pose
        options = self._options
        self._model.update_frame_pose(self._number, self._o3d.core.Tensor(np.linalg.inv(self._first) @ pose))
        self._model.integrate(self._input, 1.0, options.far, options.truncation)
        self._model.synthesize_model_frame(
            self._seen, 1.0, max(options.near, 0.1), options.far, options.truncation, False
        )
        self._number += 1

    def _fill(self, frame: RgbdFrame, depth: np.ndarray) -> None:
        tensor, image = self._o3d.core.Tensor, self._o3d.t.geometry.Image
        self._input.set_data_from_image("depth", image(tensor(depth)))
        self._input.set_data_from_image("color", image(tensor(_shown(frame))))


def _shown(frame: RgbdFrame) -> np.ndarray:
    """The photograph about as a display shows it, in which brightness errors are even: float32 in [0, 1]."""
    if frame.color is None:
        return np.zeros((*frame.depth.shape, 3), np.float32)
    return np.ascontiguousarray(np.sqrt(np.clip(np.nan_to_num(frame.color), 0.0, 1.0)), np.float32)

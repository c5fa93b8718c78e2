"""From a folder with depth and colour images to a capture stage, with everything checked that can be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warp_dvct.capture import formats
from warp_dvct.capture.clouds import read_organised
from warp_dvct.capture.images import image_size, read_color, read_depth
from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.capture.sens import read_sens
from warp_dvct.capture.stage import CaptureRig, FrameFiles, write_capture
from warp_dvct.errors import FileError, OptionError
from warp_dvct.image import check_writable

NEAREST, FARTHEST = 0.3, 8.0  # m: median depths outside of this are no room seen by a depth camera
UPS = ("auto", "x", "-x", "y", "-y", "z", "-z")
READERS = {
    "redwood": formats.read_redwood,
    "tum": formats.read_tum,
    "7scenes": formats.read_seven_scenes,
    "pair": formats.read_pair,
}

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class ImportOptions:
    """What the user says over what the format says; None leaves it.

    Attributes:
        format: One of :data:`warp_dvct.capture.formats.FORMATS`, or ``auto``.
        intrinsics, color_intrinsics: A file or ``FX,FY,CX,CY``. The first counts for both where colour is registered.
        distortion, color_distortion: OpenCV's coefficients. Depth images are taken as undistorted without the first.
        depth_unit: Metres per step; said so, no plausibility is asked for.
        color_extrinsic: File of the 4x4 from the depth camera to the colour camera, ``registered`` where both images
            show the same view, ``kinect`` for the factory's 25 mm, or ``none`` to leave colour out.
        up: World axis that points up, one of :data:`UPS`; ``auto`` takes the one that the cameras' tops point to.
        size: Width and height of organised point clouds.
        fps: Time codes per second.
    """

    format: str = "auto"
    intrinsics: str | None = None
    color_intrinsics: str | None = None
    distortion: tuple[float, ...] | None = None
    color_distortion: tuple[float, ...] | None = None
    depth_unit: float | None = None
    color_extrinsic: str | None = None
    up: str = "auto"
    size: tuple[int, int] | None = None
    fps: float = 30.0


@dataclass(frozen=True)
class Imported:
    """What was imported.

    Attributes:
        format: The format that it was read as.
        frames, posed, colored: How many frames there are, with a known pose, and with a photograph.
        skipped: Frames that were left out, each with its reason.
        notes: What else the user should know.
        median_depth: Metres, over frames spread through the capture.
        up: World axis of the capture that became the stage's +y.
    """

    format: str
    frames: int
    posed: int
    colored: int
    skipped: tuple[str, ...]
    notes: tuple[str, ...]
    median_depth: float
    up: str


def import_capture(
    source: str | Path,
    output: str | Path,
    options: ImportOptions | None = None,
    progress: Progress = lambda done, total: None,
) -> Imported:
    """Read a dataset, check every image, and write the capture stage.

    Frames whose images are missing or damaged are left out and counted. Images stay where they are, but for ``.sens``
    containers and point clouds, which are unpacked into a folder named as ``output``.

    Raises:
        FileError: Nothing is usable, images differ in size, the median depth is implausible, or the output cannot be
            written. OptionError: An option does not fit.
    """
    options = options or ImportOptions()
    check_writable(output)
    folder = Path(source)
    data = _read(folder, Path(output), options, progress)
    data = _override(data, options)
    if data.color is not None and data.depth_to_color is None:
        raise OptionError(
            f"'{folder}' ({data.format}): colour is not registered to depth; give --color-extrinsic FILE with the 4 x 4"
            " from depth to colour, 'kinect' for the factory's 25 mm, 'registered' if your copy is, or 'none'"
        )
    frames, skipped, median = _check_frames(data, progress)
    if options.depth_unit is None and not NEAREST <= median <= FARTHEST:
        raise FileError(
            f"'{folder}': the median depth is {median:.3g} m with {data.unit:g} m per step, which no depth camera"
            " sees in a room; give --depth-unit (0.001 for mm, 0.0002 for TUM), the same one to insist"
        )
    if not NEAREST <= median <= FARTHEST:
        data.notes.append(f"the median depth is {median:.3g} m: is --depth-unit {data.unit:g} right? (0.001 is mm)")
    up = options.up
    if up == "auto":
        up = "y" if data.format == "points" else _find_up(frames)  # a stage says what is up
    extrinsic = np.eye(4) if data.depth_to_color is None else data.depth_to_color
    rig = CaptureRig(data.depth, data.color, extrinsic, data.unit, data.invalid)
    write_capture(output, rig, frames, world=up_matrix(up), fps=options.fps)
    posed = sum(frame.pose is not None for frame in frames)
    colored = sum(frame.color is not None for frame in frames)
    return Imported(data.format, len(frames), posed, colored, tuple(skipped), tuple(data.notes), median, up)


def _read(folder: Path, output: Path, options: ImportOptions, progress: Progress) -> formats.Dataset:
    name = options.format if options.format != "auto" else formats.detect_format(folder)
    if not folder.exists():
        raise FileError(f"'{folder}' does not exist; give the folder that holds the capture")
    unpacked = output.with_name(f"{output.stem}_frames")
    if name == "points":
        if options.size is None:
            raise OptionError(f"'{folder}': give --size WIDTH HEIGHT of the organised cloud")
        return read_organised(folder, options.size, unpacked, progress)
    if name != "scannet":
        return READERS[name](folder)
    sens = [folder] if folder.is_file() else sorted(folder.glob("*.sens"))
    if len(sens) > 1:
        raise FileError(f"'{folder}' holds {len(sens)} .sens files; give one of them, as '{sens[0]}'")
    if sens:
        return read_sens(sens[0], unpacked, progress)
    return formats.read_scannet_folder(folder)


def _override(data: formats.Dataset, options: ImportOptions) -> formats.Dataset:
    """Apply what the user says."""
    aligned = data.color == data.depth
    if options.depth_unit is not None:
        if not (np.isfinite(options.depth_unit) and options.depth_unit > 0.0):
            raise OptionError(f"--depth-unit {options.depth_unit}: give positive metres per step, as 0.001 for mm")
        data = replace(data, unit=options.depth_unit)
    if options.intrinsics is not None:
        lens = formats.read_intrinsics(options.intrinsics, data.depth.size)
        data = replace(data, depth=lens, color=lens if aligned else data.color)
    data = replace(data, depth=_distorted(data.depth, options.distortion))
    extrinsic = options.color_extrinsic
    if extrinsic == "none":
        data = replace(data, color=None, frames=[replace(frame, color=None) for frame in data.frames])
    if data.color is None:
        return data
    if extrinsic == "registered":
        data = replace(data, color=data.depth, depth_to_color=np.eye(4))
    elif extrinsic == "kinect":
        matrix = np.eye(4)
        matrix[:3, 3] = formats.KINECT_BASELINE
        data = replace(data, depth_to_color=matrix)
    elif extrinsic is not None:
        data = replace(data, depth_to_color=formats.read_matrix(extrinsic))
    color = data.color
    first = next((frame.color for frame in data.frames if frame.color), None)
    if first is not None:
        size = image_size(first, "color")
        if options.color_intrinsics is not None:
            color = formats.read_intrinsics(options.color_intrinsics, size)
        elif color is not None and size != color.size:
            raise OptionError(
                f"photograph '{first}' is {size[0]} x {size[1]} pixels but its camera is known for {color.width} x"
                f" {color.height}; give --color-intrinsics"
            )
    assert color is not None
    return replace(data, color=_distorted(color, options.color_distortion))


def _distorted(lens: Intrinsics, coefficients: tuple[float, ...] | None) -> Intrinsics:
    return lens if coefficients is None else replace(lens, distortion=coefficients)


def _check_frames(data: formats.Dataset, progress: Progress) -> tuple[list[FrameFiles], list[str], float]:
    """Read every image: usable frames, why the others are left out, and the median depth in metres."""
    kept: list[FrameFiles] = []
    skipped: list[str] = []
    medians: list[float] = []

    def check(frame: FrameFiles) -> float:
        depth = read_depth(frame.depth, data.unit, data.invalid, data.depth.size)
        if frame.color is not None and data.color is not None:
            read_color(frame.color, data.color.size)
        measured = depth[::4, ::4]
        measured = measured[measured > 0.0]
        return float(np.median(measured)) if len(measured) else float("nan")

    with ThreadPoolExecutor() as pool:
        waiting = [pool.submit(check, frame) for frame in data.frames]
        for number, (frame, job) in enumerate(zip(data.frames, waiting, strict=True)):
            try:
                medians.append(job.result())
                kept.append(frame)
            except FileError as error:
                skipped.append(f"frame {number}: {error}")
            progress(number + 1, len(data.frames))
    if not kept:
        raise FileError(f"none of {len(data.frames)} frames is usable: {skipped[0]}")
    if np.isnan(medians).all():
        raise FileError(f"all {len(kept)} depth images are empty; '{kept[0].depth}' is the first")
    return kept, skipped, float(np.nanmedian(medians))


def _find_up(frames: Sequence[FrameFiles]) -> str:
    """The world axis nearest to where the cameras' tops point on average; that of OpenCV's cameras without poses."""
    tops = [-frame.pose[:3, 1] for frame in frames if frame.pose is not None]
    if not tops:
        return "-y"
    mean = np.mean(tops, 0)
    axis = int(np.argmax(np.abs(mean)))
    return ("" if mean[axis] >= 0.0 else "-") + "xyz"[axis]


def up_matrix(up: str) -> np.ndarray:
    """4x4 rotation that brings a world axis (``x`` … ``-z``) to +y by a turn about one axis."""
    matrix = np.eye(4)
    matrix[:3, :3] = {
        "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
        "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
        "y": np.eye(3),
        "-y": np.diag([1, -1, -1]),
        "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
        "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    }[up]
    return matrix

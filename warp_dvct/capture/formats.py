"""Folders of RGB-D datasets: which files belong together, their poses, and what each format says about its cameras."""

from __future__ import annotations

import json
import re
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from warp_dvct.capture.images import image_size, is_depth_image
from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.capture.stage import FrameFiles, rigid_problem
from warp_dvct.errors import FileError, OptionError

FORMATS = ("redwood", "tum", "7scenes", "scannet", "pair", "points")
ASSOCIATION = 0.02  # seconds between a depth image and its photograph or pose, at most (the TUM benchmark's tool)
PRIMESENSE = (525.0, 525.0, 319.5, 239.5)  # OpenNI's default, of 640 x 480; Redwood and TUM say to use it
KINECT_FUSION = (585.0, 585.0, 320.0, 240.0)  # what 7-Scenes' authors used for depth; its colour is uncalibrated
KINECT_BASELINE = (-0.025, 0.0, 0.0)  # m: the colour camera is 25 mm to the right of the depth camera
IMAGES = (".png", ".jpg", ".jpeg")


@dataclass
class Dataset:
    """What a folder holds.

    Attributes:
        format: One of :data:`FORMATS`.
        frames: In order.
        depth, color: Cameras; ``color`` is None without photographs.
        depth_to_color: 4x4; None where the format does not say, which must be asked for.
        unit: Metres per step of the depth images.
        invalid: Stored depths that mean nothing was measured.
        notes: What was left out, for the user.
    """

    format: str
    frames: list[FrameFiles]
    depth: Intrinsics
    color: Intrinsics | None
    depth_to_color: np.ndarray | None
    unit: float
    invalid: tuple[int, ...] = (0,)
    notes: list[str] = field(default_factory=list)


def detect_format(folder: Path) -> str:
    """Which format a folder has.

    Raises:
        FileError: There is no such folder, or it fits none.
    """
    if folder.is_file() and folder.suffix == ".sens":
        return "scannet"
    if folder.is_file() and folder.suffix in (".usd", ".usda", ".usdc", ".usdz"):
        return "points"
    if not folder.is_dir():
        raise FileError(f"'{folder}' is not a folder; give the one that holds the capture")
    if (folder / "depth.txt").is_file():
        return "tum"
    if next(folder.glob("frame-*.depth.png"), None):
        return "7scenes"
    if next(folder.glob("*.sens"), None) or (folder / "pose").is_dir():
        return "scannet"
    if (folder / "depth").is_dir():
        return "redwood"
    depth, color = _pair(folder)
    if len(depth) == 1 and len(color) <= 1:
        return "pair"
    raise FileError(
        f"'{folder}' fits no known format: redwood has folders depth/ and color/, tum depth.txt and rgb.txt, 7scenes"
        " frame-*.depth.png, scannet a .sens file or depth/, color/ and pose/, pair one 16-bit and one 8-bit image"
    )


def read_redwood(folder: Path) -> Dataset:
    """Open3D's and Redwood's layout: ``depth/``, ``color/`` (or ``image/``, ``rgb/``), ``camera_intrinsic.json``,
    ``trajectory.log`` with camera-to-world poses. Depth is in mm and registered to colour."""
    depth = _images(folder / "depth")
    color = next((found for name in ("color", "image", "rgb") if (found := _images(folder / name))), [])
    if not depth:
        raise FileError(f"'{folder / 'depth'}' holds no images; the capture is empty")
    notes: list[str] = []
    frames_of = [file.stem for file in depth]
    shared = {file.stem for file in depth} & {file.stem for file in color}
    if color and len(shared) < len(depth) + len(color) - len(shared) and (shared or len(color) != len(depth)):
        pairs, lost = _by_stem(depth, color)
        names = ", ".join(file.name for file in lost[:5]) + (" …" if len(lost) > 5 else "")
        notes.append(f"{len(lost)} images have no partner of the same name and are left out: {names}")
        frames_of = [file.stem for file in _in_order({file.stem: file for file in (*depth, *color)}.values())]
    else:
        pairs = list(zip(depth, color or [None] * len(depth), strict=True))
    trajectory = next((f for f in (folder / "trajectory.log", folder / "odometry.log") if f.is_file()), None)
    poses = _read_trajectory(trajectory) if trajectory else {}
    if not trajectory:
        notes.append("there is no trajectory.log: no pose is known")
    places = _pose_indices(frames_of, poses, str(trajectory))
    frames = []
    for number, (one, other) in enumerate(pairs):
        frames.append(_frame(one, other, poses.get(places[one.stem]), notes, number, bool(poses)))
    size = image_size(str(frames[0].depth), "depth")
    file = folder / "camera_intrinsic.json"
    lens = read_intrinsics(file, size) if file.is_file() else _default_lens(PRIMESENSE, size)
    return Dataset("redwood", frames, lens, lens if color else None, np.eye(4), 0.001, (0,), notes)


def read_tum(folder: Path) -> Dataset:
    """TUM RGB-D: ``depth.txt``, ``rgb.txt`` and ``groundtruth.txt`` by time stamps; depth in 1/5000 m, registered."""
    depth, rgb = _read_list(folder / "depth.txt"), _read_list(folder / "rgb.txt")
    truth = folder / "groundtruth.txt"
    poses = _read_stamped_poses(truth) if truth.is_file() else []
    notes: list[str] = [] if poses else ["there is no groundtruth.txt: no pose is known"]
    colors = associate([t for t, _ in depth], [t for t, _ in rgb])
    placed = associate([t for t, _ in depth], [t for t, _ in poses], exclusive=False)
    frames = []
    for k, (time, name) in enumerate(depth):
        if k not in colors:
            continue
        pose = poses[placed[k]][1] if k in placed else None
        frame = _frame(folder / name, folder / rgb[colors[k]][1], pose, notes, len(frames), bool(poses))
        frames.append(FrameFiles(frame.depth, frame.color, frame.pose, timestamp=time))
    if not frames:
        raise FileError(
            f"'{folder}': no depth image has a photograph within {1000 * ASSOCIATION:.0f} ms; do rgb.txt and depth.txt"
            " belong together?"
        )
    if len(frames) < len(depth):
        notes.append(f"{len(depth) - len(frames)} depth images have no photograph within {1000 * ASSOCIATION:.0f} ms")
    size = image_size(frames[0].depth, "depth")
    lens = _default_lens(PRIMESENSE, size)
    return Dataset("tum", frames, lens, lens, np.eye(4), 1.0 / 5000.0, (0,), notes)


def read_seven_scenes(folder: Path) -> Dataset:
    """7-Scenes: ``frame-*.{depth,color}.png`` and ``.pose.txt``; mm, 0 and 65535 invalid, colour **not** registered."""
    depth = sorted(folder.glob("frame-*.depth.png"))
    if not depth:
        raise FileError(f"'{folder}' holds no frame-*.depth.png; the capture is empty")
    notes: list[str] = []
    frames = []
    for file in depth:
        stem = file.name.removesuffix(".depth.png")
        color, pose = folder / f"{stem}.color.png", folder / f"{stem}.pose.txt"
        matrix = read_matrix(pose) if pose.is_file() else None
        frames.append(_frame(file, color if color.is_file() else None, matrix, notes, len(frames), True))
    size = image_size(str(depth[0]), "depth")
    has_color = any(frame.color for frame in frames)
    return Dataset(
        "7scenes",
        frames,
        _default_lens(KINECT_FUSION, size),
        _default_lens(PRIMESENSE, size) if has_color else None,
        None,
        0.001,
        (0, 65535),
        notes,
    )


def read_scannet_folder(folder: Path) -> Dataset:
    """ScanNet's exported layout: ``depth/``, ``color/``, ``pose/`` and ``intrinsic/`` with 4x4 text matrices; mm."""
    depth = _images(folder / "depth")
    if not depth:
        raise FileError(f"'{folder / 'depth'}' holds no images; the capture is empty")
    color = {file.stem: file for file in _images(folder / "color")}
    notes: list[str] = []
    frames = []
    for file in depth:
        pose = folder / "pose" / f"{file.stem}.txt"
        matrix = read_matrix(pose) if pose.is_file() else None
        frames.append(_frame(file, color.get(file.stem), matrix, notes, len(frames), True))
    said = folder / "intrinsic"
    lens = read_intrinsics(said / "intrinsic_depth.txt", image_size(str(depth[0]), "depth"))
    other = None
    extrinsic = np.eye(4)
    if color:
        photo = next(iter(color.values()))
        other = read_intrinsics(said / "intrinsic_color.txt", image_size(str(photo), "color"))
        files = [said / f"extrinsic_{name}.txt" for name in ("depth", "color")]
        if all(f.is_file() for f in files):
            extrinsic = np.linalg.inv(read_matrix(files[1])) @ read_matrix(files[0])
    return Dataset("scannet", frames, lens, other, extrinsic, 0.001, (0,), notes)


def read_pair(folder: Path) -> Dataset:
    """One depth image and one photograph, told apart by their bits; the camera defines the world."""
    depth, color = _pair(folder)
    if len(depth) != 1 or len(color) > 1:
        raise FileError(
            f"'{folder}' holds {len(depth)} 16-bit one-channel images and {len(color)} others; a pair is one of each"
        )
    frame = FrameFiles(str(depth[0]), str(color[0]) if color else None, np.eye(4))
    lens = _default_lens(PRIMESENSE, image_size(frame.depth, "depth"))
    # TUM writes 1/5000 m and the others mm; the check of the median depth asks where this choice cannot be right.
    unit = 1.0 / 5000.0 if "tum" in depth[0].name.lower() else 0.001
    return Dataset("pair", [frame], lens, lens if color else None, np.eye(4), unit)


def associate(
    times: Sequence[float], others: Sequence[float], *, limit: float = ASSOCIATION, exclusive: bool = True
) -> dict[int, int]:
    """Pair time stamps: the closest pairs first, none further apart than ``limit`` seconds.

    Args:
        times, others: Seconds, ascending.
        exclusive: Use each of ``others`` at most once.
    Returns:
        Index into ``others`` by index into ``times``.
    """
    candidates = []
    for k, time in enumerate(times):
        at = bisect_left(others, time)
        for j in range(max(at - 2, 0), min(at + 2, len(others))):
            if abs(others[j] - time) <= limit:
                candidates.append((abs(others[j] - time), k, j))
    found: dict[int, int] = {}
    used: set[int] = set()
    for _, k, j in sorted(candidates):
        if k not in found and not (exclusive and j in used):
            found[k] = j
            used.add(j)
    return found


def read_intrinsics(file: Path | str, size: tuple[int, int]) -> Intrinsics:
    """Intrinsics from Open3D's JSON (column-major), a text file with a 3x3 or 4x4 matrix, or ``fx,fy,cx,cy``.

    Raises:
        FileError: The file cannot be read. OptionError: The text is neither numbers nor a file.
    """
    text = str(file)
    if re.fullmatch(r"[-+\d.eE]+(\s*,\s*[-+\d.eE]+){3}", text.strip()):
        return _default_lens(tuple(float(part) for part in text.split(",")), size, scale=False)
    path = Path(file)
    if not path.is_file():
        raise OptionError(f"intrinsics '{file}' are neither a file nor FX,FY,CX,CY")
    if path.suffix == ".json":
        try:
            stored = json.loads(path.read_text())
            K = np.array(stored["intrinsic_matrix"], np.float64).reshape(3, 3).T
            size_said = int(stored.get("width", size[0])), int(stored.get("height", size[1]))
        except (ValueError, KeyError, TypeError) as error:
            raise FileError(f"'{path}' has no intrinsic_matrix of nine numbers ({error})") from error
        if size_said != size:
            raise FileError(
                f"'{path}' is for {size_said[0]} x {size_said[1]} pixels, the images are {size[0]} x {size[1]}"
            )
    else:
        K = read_matrix(path)
    return Intrinsics(*size, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))


def read_matrix(file: Path | str) -> np.ndarray:
    """A square matrix of 9 or 16 numbers as text; it may hold -inf, as lost poses do.

    Raises:
        FileError: It cannot be read, or has another number of numbers.
    """
    try:
        values = np.array([float(word) for word in Path(file).read_text().replace(",", " ").split()])
    except (OSError, ValueError) as error:
        raise FileError(f"'{file}' is not a matrix in text form ({error})") from error
    if len(values) not in (9, 16):
        raise FileError(f"'{file}' has {len(values)} numbers; a 4 x 4 or 3 x 3 matrix is needed")
    edge = 3 if len(values) == 9 else 4
    return values.reshape(edge, edge)


def _default_lens(numbers: Sequence[float], size: tuple[int, int], *, scale: bool = True) -> Intrinsics:
    """Numbers for 640 x 480 at the images' size; pixel centres scale about the image's corner, half a pixel away."""
    fx, fy, cx, cy = numbers
    s = size[0] / 640.0 if scale else 1.0
    return Intrinsics(*size, fx * s, fy * s, (cx + 0.5) * s - 0.5, (cy + 0.5) * s - 0.5)


def _frame(
    depth: Path, color: Path | None, pose: np.ndarray | None, notes: list[str], number: int, posed: bool
) -> FrameFiles:
    """A frame; a pose that is not rigid is left out and said."""
    problem = rigid_problem(pose) if pose is not None else ("is missing" if posed else None)
    if problem:
        notes.append(f"frame {number} ('{depth.name}'): its pose {problem} and is taken as lost")
        pose = None
    return FrameFiles(str(depth), None if color is None else str(color), pose)


def _images(folder: Path) -> list[Path]:
    """A folder's images in the order of the numbers in their names."""
    return _in_order(f for f in folder.iterdir() if f.suffix.lower() in IMAGES) if folder.is_dir() else []


def _in_order(files: Iterable[Path]) -> list[Path]:
    """By the numbers in their names, so that 10.png follows 9.png."""

    def key(file: Path) -> list:
        return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", file.stem)]

    return sorted(files, key=key)


def _by_stem(depth: list[Path], color: list[Path]) -> tuple[list[tuple[Path, Path]], list[Path]]:
    """Depth images and photographs of one name, and the images that have no partner."""
    photos, images = {file.stem: file for file in color}, {file.stem for file in depth}
    pairs = [(file, photos[file.stem]) for file in depth if file.stem in photos]
    if not pairs:
        raise FileError(
            f"{len(depth)} depth images and {len(color)} photographs in '{depth[0].parent.parent}', and none have the"
            " same name; which belong together?"
        )
    alone = [file for file in depth if file.stem not in photos] + [file for file in color if file.stem not in images]
    return pairs, alone


def _pose_indices(stems: list[str], poses: dict[int, np.ndarray], file: str) -> dict[str, int]:
    """Index in a trajectory of each frame's name: its place among all frames, or its number where frames are missing.

    Raises:
        FileError: There are other numbers of frames and poses, and names do not tell which belong together.
    """
    places = {stem: k for k, stem in enumerate(stems)}
    if not poses or len(poses) == len(stems):
        return places
    numbers = [re.findall(r"\d+", stem) for stem in stems]
    if all(numbers):
        for first in (0, 1):
            named = {stem: int(n[-1]) - first for stem, n in zip(stems, numbers, strict=True)}
            if all(index in poses for index in named.values()):
                return named
    raise FileError(
        f"'{file}' has {len(poses)} poses for {len(stems)} frames, and the numbers in their names are not its indices;"
        " which belong together? Give each frame its pose, or none"
    )


def _pair(folder: Path) -> tuple[list[Path], list[Path]]:
    images = _images(folder)
    if len(images) > 2:
        return [], []
    depth = [file for file in images if is_depth_image(str(file))]
    return depth, [file for file in images if file not in depth]


def _read_trajectory(file: Path) -> dict[int, np.ndarray]:
    """Redwood's log: a line of three numbers, the first the frame's index, then a 4x4 from camera to world."""
    lines = [line for line in file.read_text().splitlines() if line.strip()]
    poses, k = {}, 0
    try:
        for k in range(0, len(lines), 5):
            index = int(float(lines[k].split()[0]))
            poses[index] = np.array([[float(v) for v in line.split()] for line in lines[k + 1 : k + 5]])
            if poses[index].shape != (4, 4):
                raise ValueError(f"a pose has the shape {poses[index].shape}")
    except (ValueError, IndexError) as error:
        raise FileError(f"'{file}', line {k + 1}: {error}; five lines a pose are expected") from error
    return poses


def _read_list(file: Path) -> list[tuple[float, str]]:
    """Lines ``timestamp name``, sorted by time."""
    if not file.is_file():
        raise FileError(f"'{file}' does not exist; a TUM capture has rgb.txt and depth.txt")
    entries = []
    for number, line in enumerate(file.read_text().splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            entries.append((float(words[0]), words[1]))
        except (ValueError, IndexError) as error:
            raise FileError(f"'{file}', line {number}: '{line}' is not a time stamp and a file") from error
    if not entries:
        raise FileError(f"'{file}' lists no images; the capture is empty")
    return sorted(entries)


def _read_stamped_poses(file: Path) -> list[tuple[float, np.ndarray]]:
    """Lines ``timestamp tx ty tz qx qy qz qw``, camera to world."""
    poses = []
    for number, line in enumerate(file.read_text().splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            time, x, y, z, qx, qy, qz, qw = (float(word) for word in words[:8])
        except ValueError as error:
            raise FileError(f"'{file}', line {number}: not a time stamp with seven numbers") from error
        pose = np.eye(4)
        pose[:3, :3] = quaternion_matrix(qw, qx, qy, qz)
        pose[:3, 3] = x, y, z
        poses.append((time, pose))
    return sorted(poses, key=lambda entry: entry[0])


def quaternion_matrix(w: float, x: float, y: float, z: float) -> np.ndarray:
    """The rotation of a quaternion of any length but 0, for which every number is NaN."""
    with np.errstate(all="ignore"):
        w, x, y, z = np.array([w, x, y, z]) / np.sqrt(np.float64(w * w + x * x + y * y + z * z))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )

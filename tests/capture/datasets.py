"""Small datasets in every format that is imported, and their images."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import numpy as np

from warp_dvct.capture.paths import look_at
from warp_dvct.image import write_png

WIDTH, HEIGHT = 64, 48
COUNT = 3


def depth_codes(number: int) -> np.ndarray:
    """A slanted wall between 1.5 and 2.5 m in millimetres, with a hole; uint16 ``[h, w]``."""
    _, u = np.indices((HEIGHT, WIDTH))
    codes = (1500 + u * 1000 // WIDTH + 3 * number).astype(np.uint16)
    codes[10:14, 20:30] = 0
    return codes


def photo(number: int) -> np.ndarray:
    rng = np.random.default_rng(number)
    return rng.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def pose(number: int) -> np.ndarray:
    """y up, looking along -z, a little to the right each time."""
    return look_at(np.array([0.1 * number, 1.0, 2.0]), np.array([0.1 * number, 0.9, 0.0]), np.array([0.0, 1.0, 0.0]))


def text(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(f"{v:.12g}" for v in row) for row in matrix) + "\n"


def write_depth(file: Path, codes: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    write_png(file, codes[..., None])


def write_photo(file: Path, pixels: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    write_png(file, pixels)


def redwood(folder: Path) -> Path:
    log = []
    for k in range(COUNT):
        write_depth(folder / "depth" / f"{k}.png", depth_codes(k))
        write_photo(folder / "color" / f"{k}.png", photo(k))
        log.append(f"{k} {k} {k + 1}\n{text(pose(k))}")
    (folder / "trajectory.log").write_text("".join(log))
    K = [60.0, 0, 0, 0, 61.0, 0, 31.0, 24.0, 1]
    (folder / "camera_intrinsic.json").write_text(json.dumps({"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": K}))
    return folder


def tum(folder: Path) -> Path:
    """Photographs 5 ms late, one of them 40 ms; poses 8 ms early."""
    depth, rgb, truth = ["# depth"], ["# rgb"], ["# t tx ty tz qx qy qz qw"]
    for k in range(COUNT):
        time = 100.0 + k / 30.0
        write_depth(folder / "depth" / f"{time:.6f}.png", (depth_codes(k) * 5).astype(np.uint16))
        write_photo(folder / "rgb" / f"{k}.png", photo(k))
        depth.append(f"{time:.6f} depth/{time:.6f}.png")
        rgb.append(f"{time + (0.005 if k != 1 else 0.022):.6f} rgb/{k}.png")
        truth.append(f"{time - 0.008:.6f} {0.1 * k} 1 2 0 1 0 0")  # half a turn about y
    for name, lines in (("depth", depth), ("rgb", rgb), ("groundtruth", truth)):
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return folder


def seven_scenes(folder: Path) -> Path:
    """The second pose is lost, as their tracker writes it."""
    for k in range(COUNT):
        codes = depth_codes(k)
        codes[0, :5] = 65535
        write_depth(folder / f"frame-{k:06d}.depth.png", codes)
        write_photo(folder / f"frame-{k:06d}.color.png", photo(k))
        lost = np.full((4, 4), -np.inf)
        (folder / f"frame-{k:06d}.pose.txt").write_text(text(lost if k == 1 else pose(k)))
    return folder


def scannet(folder: Path) -> Path:
    K = np.eye(4)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = 60.0, 61.0, 31.0, 24.0
    for k in range(COUNT):
        write_depth(folder / "depth" / f"{k}.png", depth_codes(k))
        write_photo(folder / "color" / f"{k}.png", photo(k))
        (folder / "pose").mkdir(exist_ok=True)
        (folder / "pose" / f"{k}.txt").write_text(text(pose(k)))
    (folder / "intrinsic").mkdir()
    for name in ("depth", "color"):
        (folder / "intrinsic" / f"intrinsic_{name}.txt").write_text(text(K))
    return folder


def sens(file: Path, *, cut: int = 0) -> Path:
    """A .sens file of three frames; ``cut`` bytes are missing at its end."""
    K = np.eye(4)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = 60.0, 61.0, 31.0, 24.0
    shift = np.eye(4)
    shift[0, 3] = 0.03
    matrices = [K, np.eye(4), K, shift]
    data = struct.pack("<IQ", 4, 4) + b"test"
    data += b"".join(m.astype("<f4").tobytes() for m in matrices)
    data += struct.pack("<ii4IfQ", 1, 1, WIDTH, HEIGHT, WIDTH, HEIGHT, 1000.0, COUNT)
    for k in range(COUNT):
        picture = file.with_name("photo.png")
        write_photo(picture, photo(k))
        color, depth = picture.read_bytes(), zlib.compress(depth_codes(k).tobytes())
        picture.unlink()
        data += pose(k).astype("<f4").tobytes() + struct.pack("<4Q", k, 33333 * k, len(color), len(depth))
        data += color + depth
    file.write_bytes(data[: len(data) - cut])
    return file

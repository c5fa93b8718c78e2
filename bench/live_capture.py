"""Live captures: what a relit frame takes (filter, scene, upload, plate, picture), and errors of filtered normals."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from warp_dvct.capture.importers import import_capture
from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.capture.live import LiveSource
from warp_dvct.capture.place import PlacedObject, place_object, read_model
from warp_dvct.capture.simulate import DepthEye
from warp_dvct.capture.spots import spot_at_pixel
from warp_dvct.capture.stage import Capture, open_capture
from warp_dvct.image import read_plate
from warp_dvct.launch import Launcher
from warp_dvct.passes.depth_filter import DepthFilter
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Scene
from warp_dvct.usd_scenes import bunny_model

MOST_FRAMES = 8
PICKED = 0.47, 0.86  # of the photograph's width and height: where the bunny stands
HEIGHT = 0.25  # metres


def time_live(
    stage: str | Path, capture: Capture, *, quality: str, device: str, threads: int | None
) -> tuple[float, float]:
    """Median seconds of a frame, by the clock and of processor, once kernels are compiled and a frame lies before.

    Args:
        stage: With synthetic objects in the capture's world.
    """
    source = LiveSource(stage, capture, launcher=Launcher(device, threads))
    times = [t for k, t in enumerate(capture.times) if capture.pose(k) is not None][:MOST_FRAMES]
    width, height = source.size
    relighter = Relighter(
        source.scene(times[0]), width=width, height=height, quality=quality, device=device, threads=threads
    )
    relighter.render(_plate(relighter))
    spent = []
    for number in times[1:] or times:
        wall, processor = time.perf_counter(), time.process_time()
        relighter.set_scene(source.scene(number))
        relighter.render(_plate(relighter))
        spent.append((time.perf_counter() - wall, time.process_time() - processor))
    middle = np.median(spent, axis=0)
    return float(middle[0]), float(middle[1])


def _plate(relighter: Relighter) -> np.ndarray | None:
    file = relighter.scene.plate
    return None if file is None else read_plate(file, relighter.width, relighter.height)


def time_dataset(folder: str | Path, *, quality: str, device: str, threads: int | None) -> tuple[float, float]:
    """As :func:`time_live`, of a dataset that can be imported, with a bunny low in the middle of its picture."""
    with tempfile.TemporaryDirectory() as made:
        file, placed = Path(made) / "capture.usda", Path(made) / "placed.usda"
        import_capture(folder, file)
        capture = open_capture(file)
        first = next((k for k in capture if capture.pose(k) is not None), 0)
        lens = capture.rig.color or capture.rig.depth
        pixel = PICKED[0] * lens.width, PICKED[1] * lens.height
        bunny = PlacedObject(bunny_model(), height=HEIGHT)
        place_object(file, placed, spot_at_pixel(capture, first, pixel), bunny, read_model(bunny.file))
        return time_live(placed, capture, quality=quality, device=device, threads=threads)


def normal_errors(capture: Capture, truth: Scene, launcher: Launcher) -> tuple[float, float]:
    """Mean angular error [degrees] over all frames of normals from raw depth, as the paper takes them (its figure 10),
    and of filtered ones, at pixels that have both.

    Args:
        truth: What was captured; its real part is looked at.
    """
    lens = capture.rig.depth
    eye = DepthEye(launcher, truth, lens)
    made = DepthFilter(launcher, (lens.fx, lens.fy, lens.cx, lens.cy), lens.size)
    sums, count = np.zeros(2), 0
    for index in capture:
        pose, measured = capture.pose(index), capture.depth(index)
        if pose is None:
            continue
        _, true = eye.look(pose)
        raw, filtered = paper_normals(measured, lens), made.update(measured, pose).normals()
        both = (np.linalg.norm(raw, axis=-1) > 0.5) & (np.linalg.norm(filtered, axis=-1) > 0.5)
        sums += [angle(normals[both], true[both]).sum() for normals in (raw, filtered)]
        count += int(both.sum())
    return float(sums[0] / max(count, 1)), float(sums[1] / max(count, 1))


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Between unit vectors ``[..., 3]`` [degrees]."""
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1.0, 1.0)))


def paper_normals(depth: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """N = (V(u+1,v) - V(u,v)) x (V(u,v+1) - V(u,v)) (Knecht et al. 2012, section 4), towards the camera; 0 where a
    vertex is missing. float ``[h, w, 3]``."""
    points = lens.rays() * depth[..., None]
    normal = np.zeros_like(points)
    here, right, below = points[:-1, :-1], points[:-1, 1:], points[1:, :-1]
    cross = np.cross(right - here, below - here)
    cross *= -np.sign((cross * here).sum(-1, keepdims=True))
    whole = (depth[:-1, :-1] > 0) & (depth[:-1, 1:] > 0) & (depth[1:, :-1] > 0)
    length = np.linalg.norm(cross, axis=-1, keepdims=True)
    normal[:-1, :-1] = np.where(whole[..., None] & (length > 0), cross / np.maximum(length, 1e-30), 0.0)
    return normal

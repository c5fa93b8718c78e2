"""Organised point clouds, whose points go row by row over a camera's pixels, back to depth images."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_dvct.capture.formats import Dataset
from warp_dvct.capture.intrinsics import FLIP, Intrinsics
from warp_dvct.capture.stage import FrameFiles, rigid_problem
from warp_dvct.errors import FileError, StageError
from warp_dvct.image import write_depth_exr, write_png
from warp_dvct.usd.context import matrix
from warp_dvct.usd.stage import name_of, open_stage, world_frame

if TYPE_CHECKING:
    from pxr import Usd

PIXELS_OFF = 0.5  # RMS distance of points from the pixels of the best pinhole, at most
LEAST_POINTS = 16  # that a camera is found from


def read_organised(
    file: Path, size: tuple[int, int], target: Path, progress: Callable[[int, int], None] = lambda done, total: None
) -> Dataset:
    """Turn a ``UsdGeom.Points`` prim, one cloud or one per time sample, into depth images and photographs.

    The prim's space is a camera's, looking along its +z with y down or, as USD's cameras, along -z with y up; its
    transform is the pose. Points that are NaN or at the origin were not measured. The pinhole is found from the points:
    u = fx x / z + cx, v = fy y / z + cy in the least squares. ``displayColor`` becomes photographs.

    Args:
        file: The stage, with one Points prim.
        size: Width and height of the organised cloud.
        target: Folder for ``depth/`` and ``color/``; made where it is absent.
        progress: Called with frames done and in all.
    Raises:
        StageError: There is no Points prim, or several, or its points are not ``width * height`` or not a pinhole's.
    """
    stage = open_stage(file)
    prim = _points_prim(stage)
    times = prim.GetAttribute("points").GetTimeSamples() or [None]
    metres, frame = world_frame(stage)
    frames: list[FrameFiles] = []
    lens = None
    for name in ("depth", "color"):
        (target / name).mkdir(parents=True, exist_ok=True)
    for number, time in enumerate(times):
        where = f"{prim.GetPath()} of '{name_of(stage)}', frame {number}"
        points, colors = _grid(prim, time, size, where)
        points = points * metres
        known = np.isfinite(points).all(-1) & (points[..., 2] != 0.0)
        if known.sum() < LEAST_POINTS:
            raise StageError(f"{where}: {int(known.sum())} points are known; a camera cannot be found from them")
        backward = bool(np.median(points[..., 2][known]) < 0.0)
        if backward:
            points = points * [1.0, -1.0, -1.0]
        known &= points[..., 2] > 0.0
        lens = lens or _fit(points, known, size, where)
        depth_file = target / "depth" / f"{number:05d}.exr"
        write_depth_exr(depth_file, np.where(known, points[..., 2], 0.0))
        color_file = None
        if colors is not None:
            color_file = target / "color" / f"{number:05d}.png"
            write_png(color_file, _codes(colors))
        frames.append(
            FrameFiles(str(depth_file), color_file and str(color_file), _pose(prim, time, frame, backward, where))
        )
        progress(number + 1, len(times))
    assert lens is not None
    color = lens if frames[0].color else None
    return Dataset("points", frames, lens, color, np.eye(4), 1.0, (0,), [])


def _points_prim(stage: Usd.Stage) -> Usd.Prim:
    from pxr import UsdGeom

    prims = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Points)]
    if len(prims) != 1:
        listed = ", ".join(str(prim.GetPath()) for prim in prims) or "none"
        raise StageError(f"'{name_of(stage)}' must have one Points prim to be a capture; it has {listed}")
    return prims[0]


def _grid(
    prim: Usd.Prim, time: float | None, size: tuple[int, int], where: str
) -> tuple[np.ndarray, np.ndarray | None]:
    """Points ``[h, w, 3]`` in the prim's units, and linear colours where each point has one."""
    from pxr import Usd, UsdGeom

    width, height = size
    code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    points = np.array(prim.GetAttribute("points").Get(code) or (), np.float64).reshape(-1, 3)
    if len(points) != width * height:
        raise StageError(
            f"{where}: {len(points)} points are no {width} x {height}; give --size of the organised cloud. An"
            " unorganised one needs no import: tag it real and relight its stage"
        )
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("displayColor")
    values = np.array(primvar.ComputeFlattened(code) if primvar else (), np.float64).reshape(-1, 3)
    colors = values.reshape(height, width, 3) if len(values) == len(points) else None
    return points.reshape(height, width, 3), colors


def _fit(points: np.ndarray, known: np.ndarray, size: tuple[int, int], where: str) -> Intrinsics:
    """The pinhole that shows each point at its pixel.

    Raises:
        StageError: None does to half a pixel.
    """
    place = np.indices(known.shape).astype(np.float64)
    found: list[tuple[float, float]] = []
    off: list[np.ndarray] = []
    for pixel, axis in ((place[1], 0), (place[0], 1)):
        slope = points[..., axis][known] / points[..., 2][known]
        table = np.stack([slope, np.ones_like(slope)], -1)
        solution = np.asarray(np.linalg.lstsq(table, pixel[known], rcond=None)[0])
        found.append((float(solution[0]), float(solution[1])))
        off.append(table @ solution - pixel[known])
    error = float(np.sqrt(np.mean(np.square(off))) * np.sqrt(2.0))
    if error > PIXELS_OFF or found[0][0] <= 0.0 or found[1][0] <= 0.0:
        raise StageError(
            f"{where}: the points are not those of a pinhole's pixels, row by row ({error:.1f} pixels off); is --size"
            " right, and are they in the camera's space?"
        )
    (fx, cx), (fy, cy) = found
    return Intrinsics(*size, fx, fy, cx, cy)


def _pose(prim: Usd.Prim, time: float | None, frame: np.ndarray, backward: bool, where: str) -> np.ndarray:
    """OpenCV camera to the stage's world (metres, y up)."""
    from pxr import Usd, UsdGeom

    code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    pose = (matrix(UsdGeom.XformCache(code).GetLocalToWorldTransform(prim)) @ frame).T
    pose[:3, :3] /= np.cbrt(max(np.linalg.det(pose[:3, :3]), 1e-30))
    problem = rigid_problem(pose)
    if problem:
        raise FileError(f"{where}: its transform {problem}; scale the points, not the prim")
    return pose @ FLIP if backward else pose


def _codes(linear: np.ndarray) -> np.ndarray:
    """sRGB bytes of linear colours."""
    c = np.clip(linear, 0.0, 1.0)
    return np.rint(255.0 * np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)).astype(np.uint8)

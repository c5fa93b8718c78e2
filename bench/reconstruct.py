"""Captures: milliseconds a frame of filter, fusion and tracking, and how near a reconstruction comes to the truth.

A stage is recorded by the simulated Kinect, fused, given its albedo under the stage's own lights, and relit with the
stage's own synthetic objects on the same photograph: once on the reconstruction and once on the true geometry.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from warp_dvct.bench.error import stage_file
from warp_dvct.bench.live_capture import normal_errors, time_dataset, time_live
from warp_dvct.capture.frames import FrameList, Skipped
from warp_dvct.capture.fusion import (
    FusedMesh,
    FusionOptions,
    count_blocks,
    fuse,
    integrate,
    open3d_for_reconstruction,
)
from warp_dvct.capture.reconstruct import ReconstructOptions, reconstruct
from warp_dvct.capture.simulate import Simulation, simulate
from warp_dvct.capture.source import CaptureFrames
from warp_dvct.capture.stage import Capture, open_capture
from warp_dvct.capture.tracking import TRACKERS, track_capture
from warp_dvct.image import read_plate
from warp_dvct.launch import Launcher
from warp_dvct.metrics import flip_ldr
from warp_dvct.passes.depth_filter import DepthFilter
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Role, Scene
from warp_dvct.usd.read import read_stage

FLOATING = 0.05  # metres off the truth, from which a triangle would cast a shadow of its own
MEDIAN, TAIL, DIFFERENCE = 0.004, 0.012, 0.06  # what is aimed at: metres, metres (95 %), FLIP


@dataclass(frozen=True)
class CaptureOptions:
    """What to measure.

    Attributes:
        frames: Of the capture. width: Pixels across.
        voxel: Metres. tracked: Frames that are tracked; 0 for none.
        quality: Of the relit pictures. pictures: How many are compared.
        live: A dataset whose frames are relit from live depth as well.
        device, threads: Where.
    """

    frames: int = 60
    width: int = 640
    voxel: float = 0.01
    tracked: int = 20
    quality: str = "balanced"
    pictures: int = 2
    live: Path | None = None
    device: str = "cpu"
    threads: int | None = None


@dataclass
class Report:
    """Figures: milliseconds a frame (wall and processor), degrees (raw and filtered), metres, FLIP of each picture."""

    stage: str
    milliseconds: dict[str, tuple[float, float]] = field(default_factory=dict)
    normals: tuple[float, float] = (0.0, 0.0)
    distance: tuple[float, float] = (0.0, 0.0)
    floating: float = 0.0
    triangles: int = 0
    drift: dict[str, float] = field(default_factory=dict)
    flip: list[float] = field(default_factory=list)


def measure(stage: str, options: CaptureOptions) -> Report:
    """Simulate, time, reconstruct and compare.

    Raises:
        StageError: The stage cannot be read. OptionError: Open3D or flip-evaluator is missing.
    """
    file = stage_file(stage)
    report = Report(stage)
    with tempfile.TemporaryDirectory() as folder:
        asked = Simulation(frames=options.frames, width=options.width, height=options.width * 3 // 4, path="orbit")
        done = simulate(file, folder, asked, device=options.device, threads=options.threads)
        capture = open_capture(done.capture)
        _time_filter(capture, options, report)
        _time_live(file, capture, options, report)
        _time_tracking(capture, options, report)
        fusion = FusionOptions(voxel=options.voxel)
        with _timed(report, "fusion, meshing and cleaning", len(capture)):
            fuse(CaptureFrames(capture), fusion, threads=options.threads)
        _time_integration(capture, fusion, options, report)
        truth = read_stage(file)
        report.normals = normal_errors(capture, truth, Launcher(options.device, options.threads))
        probe = lights_layer(file, Path(folder) / "lights.usda")
        target = Path(folder) / "scene.usda"
        with _timed(report, "everything, with light and albedo", len(capture)):
            made = reconstruct(
                capture,
                CaptureFrames(capture),
                target,
                ReconstructOptions(fusion, probe=str(probe)),
                device=options.device,
                threads=options.threads,
            )
        _compare_surfaces(made.mesh, truth, report)
        how = {"quality": options.quality, "device": options.device, "threads": options.threads}
        report.flip = compare_pictures(capture, target, truth, pictures=options.pictures, **how)
    return report


@contextmanager
def _timed(report: Report, name: str, frames: int) -> Iterator[None]:
    wall, processor = time.perf_counter(), time.process_time()
    yield
    spent = time.perf_counter() - wall, time.process_time() - processor
    report.milliseconds[name] = (1e3 * spent[0] / frames, 1e3 * spent[1] / frames)


def _time_filter(capture: Capture, options: CaptureOptions, report: Report) -> None:
    lens = capture.rig.depth
    made = DepthFilter(Launcher(options.device, options.threads), (lens.fx, lens.fy, lens.cx, lens.cy), lens.size)
    images = [(capture.depth(i), capture.pose(i)) for i in range(min(10, len(capture)))]
    for number, (depth, pose) in enumerate(images):
        assert pose is not None
        if number == 2:  # kernels are compiled and the past is there
            break
        made.update(depth, pose)
    with _timed(report, "live filter", max(1, len(images) - 2)):
        for depth, pose in images[2:]:
            assert pose is not None
            made.update(depth, pose)


def _time_live(stage: Path, capture: Capture, options: CaptureOptions, report: Report) -> None:
    how = {"quality": options.quality, "device": options.device, "threads": options.threads}
    found = {"relit from live depth": time_live(stage, capture, **how)}
    if options.live is not None:
        found[f"the same, {options.live.name}"] = time_dataset(options.live, **how)
    report.milliseconds.update({name: (1e3 * wall, 1e3 * processor) for name, (wall, processor) in found.items()})


def _time_tracking(capture: Capture, options: CaptureOptions, report: Report) -> None:
    count = min(options.tracked, len(capture))
    if count < 2:
        return
    part = Capture.__new__(Capture)
    part.__dict__.update(capture.__dict__, times=capture.times[:count])
    for tracker in TRACKERS:
        with _timed(report, f"tracking by {tracker}", count):
            found = track_capture(part, tracker, FusionOptions(voxel=options.voxel), threads=options.threads)
        last, true = found.poses[count - 1], capture.pose(count - 1)
        assert true is not None
        off = np.nan if last is None else float(np.linalg.norm(last[:3, 3] - true[:3, 3]))
        report.drift[tracker] = off


def _time_integration(capture: Capture, fusion: FusionOptions, options: CaptureOptions, report: Report) -> None:
    """Fusion of frames alone, images in memory: what a frame more costs."""
    source = CaptureFrames(capture)
    frames = FrameList([source.frame(i) for i in range(min(10, len(capture)))])
    o3d = open3d_for_reconstruction(options.threads)
    blocks = count_blocks(frames, fusion, Skipped(), lambda share: None)
    # Making the voxels costs as much as twenty frames: what a frame more costs is the difference.
    twice = FrameList([*frames.frames, *frames.frames])
    for name, many in (("once", frames), ("twice", twice)):
        with _timed(report, name, len(frames)):
            integrate(o3d, many, fusion, blocks, Skipped(), lambda share: None)
    once, two = (report.milliseconds.pop(name) for name in ("once", "twice"))
    report.milliseconds["fusion of a frame"] = (two[0] - once[0], two[1] - once[1])


def lights_layer(stage: Path, target: Path) -> Path:
    """The stage's lights in a layer of their own, with the transforms above them."""
    from pxr import Sdf, Usd, UsdGeom, UsdLux

    source = Usd.Stage.Open(str(stage)).Flatten()
    opened = Usd.Stage.Open(source)
    made = Usd.Stage.CreateNew(str(target))
    root = UsdGeom.Xform.Define(made, "/Lights").GetPrim()
    made.SetDefaultPrim(root)
    UsdGeom.SetStageUpAxis(made, UsdGeom.GetStageUpAxis(opened))
    UsdGeom.SetStageMetersPerUnit(made, UsdGeom.GetStageMetersPerUnit(opened))
    cache = UsdGeom.XformCache()
    for number, prim in enumerate(p for p in opened.Traverse() if p.HasAPI(UsdLux.LightAPI)):
        path = f"/Lights/Light{number}"
        Sdf.CopySpec(source, prim.GetPath(), made.GetRootLayer(), Sdf.Path(path))
        light = UsdGeom.Xformable(made.GetPrimAtPath(path))
        light.ClearXformOpOrder()
        light.AddTransformOp(opSuffix="world").Set(cache.GetLocalToWorldTransform(prim))
    made.GetRootLayer().Save()
    return target


def _compare_surfaces(mesh: FusedMesh, truth: Scene, report: Report) -> None:
    o3d = open3d_for_reconstruction(None)
    real = [m for m in truth.meshes if m.role == Role.REAL]
    first = np.cumsum([0, *(len(m.points) for m in real)])
    triangles = np.concatenate([m.triangles + k for m, k in zip(real, first, strict=False)]).astype(np.uint32)
    cast = o3d.t.geometry.RaycastingScene()
    tensor = o3d.core.Tensor
    cast.add_triangles(tensor(np.concatenate([m.points for m in real]).astype(np.float32)), tensor(triangles))
    distance = cast.compute_distance(tensor(mesh.points)).numpy()
    report.distance = float(np.median(distance)), float(np.percentile(distance, 95.0))
    report.triangles = len(mesh.triangles)
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    report.floating = float(area[distance[mesh.triangles].min(-1) > FLOATING].sum())


def compare_pictures(
    capture: Capture,
    scene: Path,
    truth: Scene,
    *,
    pictures: int,
    quality: str = "balanced",
    device: str = "cpu",
    threads: int | None = None,
) -> list[float]:
    """FLIP between composites on the reconstruction and on the truth, with the same objects and photograph.

    Args:
        scene: The reconstruction. truth: The stage that was captured, with synthetic objects.
        pictures: How many frames, evenly over the capture.
    """
    objects = tuple(m for m in truth.meshes if m.role == Role.SYNTHETIC)
    found = []
    for index in np.linspace(0, len(capture) - 1, pictures + 2)[1:-1].astype(int).tolist():
        scanned = read_stage(scene, time=capture.times[index], allow_empty_roles=True)
        plate = read_plate(capture.color_file(index) or "")
        shift = len(scanned.materials)
        moved = tuple(replace(m, materials=m.materials + shift) for m in objects)
        mixed = replace(scanned, meshes=scanned.meshes + moved, materials=scanned.materials + truth.materials)
        height, width = plate.shape[:2]
        how = {"width": width, "height": height, "quality": quality, "device": device, "threads": threads}
        true, ours = (Relighter(s, **how).render(plate).comp for s in (replace(truth, camera=scanned.camera), mixed))
        found.append(flip_ldr(true, ours)[0])
    return found


def format_report(report: Report, options: CaptureOptions) -> str:
    """A table for people; what is aimed at stands beside what was measured."""
    lines = [
        f"{report.stage}: {options.frames} frames, {options.width} pixels across, voxel {1e3 * options.voxel:g} mm"
    ]
    lines += [
        f"  {name:<36} {wall:8.1f} ms a frame, {cpu:8.1f} of processor"
        for name, (wall, cpu) in report.milliseconds.items()
    ]
    lines += [
        f"  drift by {name:<27} {1e3 * off:8.1f} mm over {options.tracked} frames" for name, off in report.drift.items()
    ]
    flips = " ".join(f"{f:8.4f}" for f in report.flip)
    raw, filtered = report.normals
    lines += [
        f"  normals, raw and filtered            {raw:8.1f} {filtered:8.1f} degrees   (aim: half)",
        f"  surface to truth, median             {1e3 * report.distance[0]:8.2f} mm   (aim {1e3 * MEDIAN:g})",
        f"  surface to truth, 95 %               {1e3 * report.distance[1]:8.2f} mm   (aim {1e3 * TAIL:g})",
        f"  more than {1e2 * FLOATING:g} cm off the truth         {1e4 * report.floating:8.2f} cm2 of the surface",
        f"  triangles                            {report.triangles:8d}",
        f"  FLIP of composites, {options.quality:<16} {flips}   (aim {DIFFERENCE:g})",
    ]
    return "\n".join(lines)

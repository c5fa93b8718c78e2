"""Captures as USD stages: written and opened.

The layout is::

    /Capture                 Xform from the capture's own world to USD's, y up
      /Capture/depth         Camera: translate + orient samples, dvct:depth:file, :unit, :invalid
        /Capture/depth/color Camera at the fixed depth-to-color pose, dvct:plate:file

Poses in Python are 4x4 float64 for column vectors, from a camera with OpenCV's axes (x right, y down, z forward) to the
world in metres; :class:`Capture` gives them in the stage's world (y up), frame writers in the capture's own.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.capture.images import image_size, read_color, read_depth
from warp_dvct.capture.intrinsics import FLIP, Intrinsics
from warp_dvct.errors import FileError, StageError
from warp_dvct.image import replacing
from warp_dvct.lens import COEFFICIENTS
from warp_dvct.scene import Camera
from warp_dvct.usd.camera import LENS, read_camera
from warp_dvct.usd.context import Context
from warp_dvct.usd.stage import name_of, open_stage, quiet_diagnostics, world_frame
from warp_dvct.usd.textures import asset_file

if TYPE_CHECKING:
    from pxr import Usd

ROOT = "/Capture"
APERTURE = 20.955  # horizontal, of the schema's fallback; only its ratio to the focal length counts
RIGID = 1e-3  # error of R^T R and of the determinant up to which a pose counts as rigid


@dataclass(frozen=True)
class FrameFiles:
    """One frame to be written.

    Attributes:
        depth: File of the depth image.
        color: File of the photograph, or None.
        pose: Depth camera (OpenCV axes) to the capture's world, 4x4; None where it is not known: the frame is in the
            stage, but :meth:`Capture.pose` is None for it.
        time: Time code; None counts from 0.
        timestamp: Seconds on the sensor's clock, or None.
    """

    depth: str
    color: str | None = None
    pose: np.ndarray | None = None
    time: float | None = None
    timestamp: float | None = None


@dataclass(frozen=True)
class CaptureRig:
    """What all frames of a capture share.

    Attributes:
        depth: The depth camera.
        color: The colour camera; None where there are no photographs.
        depth_to_color: 4x4, from the depth camera's space to the colour camera's (both OpenCV axes).
        unit: Metres per step of the depth images.
        invalid: Stored depths that mean that nothing was measured.
    """

    depth: Intrinsics
    color: Intrinsics | None = None
    depth_to_color: np.ndarray = field(default_factory=lambda: np.eye(4))
    unit: float = 0.001
    invalid: tuple[int, ...] = (0,)

    def __post_init__(self) -> None:
        extrinsic = np.asarray(self.depth_to_color, np.float64)
        problem = rigid_problem(extrinsic)
        if problem:
            raise FileError(f"the extrinsic from depth to color {problem}; give a rotation and a translation")
        object.__setattr__(self, "depth_to_color", extrinsic)
        if not (np.isfinite(self.unit) and self.unit > 0.0):
            raise FileError(f"the depth unit is {self.unit}; give metres per step, as 0.001 for millimetres")


def rigid_problem(pose: np.ndarray) -> str | None:
    """Why a 4x4 is no rotation with a translation, or None."""
    if pose.shape != (4, 4):
        return f"has shape {pose.shape}, not 4 x 4"
    if not np.isfinite(pose).all():
        return "is not finite"
    if np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0]).max() > RIGID:
        return f"has the last row {pose[3].tolist()}"
    turn = pose[:3, :3]
    if np.abs(turn.T @ turn - np.eye(3)).max() > RIGID or np.linalg.det(turn) < 0.0:
        return f"is not rigid (determinant {np.linalg.det(turn):.4g})"
    return None


def write_capture(
    path: str | Path,
    rig: CaptureRig,
    frames: Sequence[FrameFiles],
    *,
    world: np.ndarray | None = None,
    fps: float = 30.0,
) -> None:
    """Write a capture stage; the images stay where they are and are named relative to it.

    Args:
        path: ``.usda`` or ``.usdc``.
        rig: Cameras and units.
        frames: At least one; time codes ascend.
        world: 4x4 from the capture's world to the stage's (metres, y up); by default from one with y down, in which
            a camera with the identity as pose looks level along z.
        fps: Time codes per second.
    Raises:
        FileError: There are no frames, a pose is not rigid, or the file cannot be written; an earlier file stays.
    """
    from pxr import Gf, Sdf, Tf, Usd, UsdGeom

    if not frames:
        raise FileError(f"{path}: the capture has no frames; nothing is written")
    target = Path(path).absolute()
    times = [float(k) if frame.time is None else frame.time for k, frame in enumerate(frames)]
    with replacing(target) as temporary, quiet_diagnostics():
        stage = Usd.Stage.CreateNew(str(temporary))
        root = UsdGeom.Xform.Define(stage, ROOT)
        stage.SetDefaultPrim(root.GetPrim())
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetFramesPerSecond(fps)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetStartTimeCode(times[0])
        stage.SetEndTimeCode(times[-1])
        root.AddTransformOp().Set(Gf.Matrix4d((FLIP if world is None else np.asarray(world)).T.tolist()))
        _write_depth(stage, target.parent, rig, frames, times)
        if rig.color is not None:
            _write_color(stage, target.parent, rig, frames, times)
        try:
            stage.GetRootLayer().Save()
        except Tf.ErrorException as error:
            raise FileError(f"{path} cannot be written: {error}") from error
        del stage
    known = Sdf.Layer.Find(str(target))  # USD would go on with what it has read of an earlier file
    if known is not None:
        known.Reload(force=True)


def _write_depth(
    stage: Usd.Stage, folder: Path, rig: CaptureRig, frames: Sequence[FrameFiles], times: Sequence[float]
) -> None:
    from pxr import Sdf, Vt

    camera = _define_camera(stage, f"{ROOT}/depth", rig.depth)
    prim = camera.GetPrim()
    file = prim.CreateAttribute("dvct:depth:file", Sdf.ValueTypeNames.Asset)
    stamp = None
    prim.CreateAttribute("dvct:depth:unit", Sdf.ValueTypeNames.Float).Set(rig.unit)
    prim.CreateAttribute("dvct:depth:invalid", Sdf.ValueTypeNames.IntArray).Set(Vt.IntArray(list(rig.invalid)))
    lost = any(frame.pose is None for frame in frames)
    known = prim.CreateAttribute("dvct:pose:known", Sdf.ValueTypeNames.Bool) if lost else None
    place = Placement(camera)
    for frame, time in zip(frames, times, strict=True):
        file.Set(_asset(frame.depth, folder), time)
        if frame.pose is not None:
            problem = rigid_problem(np.asarray(frame.pose))
            if problem:
                raise FileError(f"frame '{frame.depth}': its pose {problem}; leave it out or repair it")
            place.set(np.asarray(frame.pose, np.float64) @ FLIP, time)
        if known is not None:
            known.Set(frame.pose is not None, time)
        if frame.timestamp is not None:
            stamp = stamp or prim.CreateAttribute("dvct:timestamp", Sdf.ValueTypeNames.Double)
            stamp.Set(float(frame.timestamp), time)


def _write_color(
    stage: Usd.Stage, folder: Path, rig: CaptureRig, frames: Sequence[FrameFiles], times: Sequence[float]
) -> None:
    from pxr import Sdf

    assert rig.color is not None
    camera = _define_camera(stage, f"{ROOT}/depth/color", rig.color)
    Placement(camera).set(FLIP @ np.linalg.inv(rig.depth_to_color) @ FLIP, None)
    file = camera.GetPrim().CreateAttribute("dvct:plate:file", Sdf.ValueTypeNames.Asset)
    for frame, time in zip(frames, times, strict=True):
        file.Set(_asset(frame.color, folder) if frame.color else Sdf.AssetPath(), time)


class Placement:
    """Translate + orient of a camera: matrices would be interpolated number by number."""

    def __init__(self, camera: Any) -> None:
        from pxr import UsdGeom

        self._translate = camera.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
        self._orient = camera.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
        self._last: np.ndarray | None = None

    def set(self, pose: np.ndarray, time: float | None) -> None:
        """A rigid 4x4 for column vectors; the quaternion's sign follows the last one, so that slerp goes the short
        way."""
        from pxr import Gf, Usd

        code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
        matrix = Gf.Matrix4d(pose.T.tolist())
        matrix.Orthonormalize(issueWarning=False)
        quat = matrix.ExtractRotationQuat().GetNormalized()
        four = np.array([quat.GetReal(), *quat.GetImaginary()])
        if self._last is not None and four @ self._last < 0.0:
            quat, four = -quat, -four
        self._last = four
        self._translate.Set(Gf.Vec3d(*pose[:3, 3].tolist()), code)
        self._orient.Set(Gf.Quatd(quat), code)


def _define_camera(stage: Usd.Stage, path: str, lens: Intrinsics) -> Any:
    """A camera whose apertures give the intrinsics: focal = f_px * aperture / width."""
    from pxr import Gf, Sdf, UsdGeom

    camera = UsdGeom.Camera.Define(stage, path)
    focal = lens.fx * APERTURE / lens.width
    camera.CreateHorizontalApertureAttr(APERTURE)
    camera.CreateVerticalApertureAttr(focal * lens.height / lens.fy)
    camera.CreateFocalLengthAttr(focal)
    camera.CreateHorizontalApertureOffsetAttr(focal * (0.5 * (lens.width - 1) - lens.cx) / lens.fx)
    camera.CreateVerticalApertureOffsetAttr(focal * (lens.cy - 0.5 * (lens.height - 1)) / lens.fy)
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1000.0))
    prim = camera.GetPrim()

    def author(name: str, kind: Any, value: Any) -> None:
        prim.CreateAttribute(f"{LENS}:{name}", kind, custom=False).Set(value)

    prim.AddAppliedSchema("OmniLensDistortionOpenCvPinholeAPI")
    prim.CreateAttribute("omni:lensdistortion:model", Sdf.ValueTypeNames.Token, custom=False).Set("opencvPinhole")
    author("imageSize", Sdf.ValueTypeNames.Int2, Gf.Vec2i(lens.width, lens.height))
    for name in ("fx", "fy", "cx", "cy"):
        author(name, Sdf.ValueTypeNames.Float, getattr(lens, name))
    for name, value in zip(COEFFICIENTS, lens.distortion, strict=False):
        author(name, Sdf.ValueTypeNames.Float, value)
    return camera


def _asset(file: str, folder: Path) -> Any:
    from pxr import Sdf

    relative = os.path.relpath(os.path.abspath(file), folder)
    return Sdf.AssetPath(relative if relative.startswith("..") else f"./{relative}")


class Capture:
    """An opened capture stage.

    Frames count from 0 to ``len(capture) - 1``. Images are read when asked for, and not kept.

    Attributes:
        path: The stage's file.
        times: Time code of each frame.
        rig: Cameras, extrinsic and depth unit.
        depth_path, color_path: Prim paths of the cameras; ``color_path`` is None where there are no photographs.
    """

    def __init__(self, path: str, times: tuple[float, ...], rig: CaptureRig, stage: Usd.Stage, depth: Usd.Prim) -> None:
        self.path, self.times, self.rig = path, times, rig
        self._stage, self._depth = stage, depth
        self._color = _color_prim(depth)
        self.depth_path = str(depth.GetPath())
        self.color_path = None if self._color is None else str(self._color.GetPath())
        self._metres, self._frame = world_frame(stage)

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[int]:
        return iter(range(len(self)))

    def name(self, index: int) -> str:
        """What messages call a frame."""
        return f"frame {self.times[index]:g} of '{self.path}'"

    def depth_file(self, index: int) -> str:
        """File of a frame's depth image.

        Raises:
            FileError: It is not authored, or does not exist.
        """
        return self._file(self._depth, "dvct:depth:file", index)

    def color_file(self, index: int) -> str | None:
        """File of a frame's photograph, None where there is none.

        Raises:
            FileError: It does not exist.
        """
        if self._color is None:
            return None
        value = self._color.GetAttribute("dvct:plate:file").Get(self.times[index])
        return self._file(self._color, "dvct:plate:file", index) if value is not None and value.path else None

    def depth(self, index: int) -> np.ndarray:
        """Depth along the view axis in metres, float32 ``[h, w]``; **0 where nothing was measured**.

        Raises:
            FileError: The image is missing, damaged, of another size or of 8 bits.
        """
        rig = self.rig
        file = self.depth_file(index)
        return read_depth(file, rig.unit, rig.invalid, rig.depth.size, f"{self.name(index)}: depth")

    def color(self, index: int) -> np.ndarray | None:
        """The photograph as stored, sRGB uint8 ``[h, w, 3]``, in the colour camera; None where there is none.

        It is not aligned with the depth image: :mod:`warp_dvct.capture.registration` does that.

        Raises:
            FileError: The image is missing, damaged, or of another size.
        """
        file = self.color_file(index)
        if file is None or self.rig.color is None:
            return None
        return read_color(file, self.rig.color.size, f"{self.name(index)}: color")

    def pose(self, index: int) -> np.ndarray | None:
        """Depth camera (OpenCV axes) to the stage's world (metres, y up), 4x4; None where it is not known.

        Raises:
            StageError: The transform cannot be inverted.
        """
        known = self._depth.GetAttribute("dvct:pose:known")
        if known and not known.Get(self.times[index]):
            return None
        return self._scene_camera(self._depth, index).to_world @ FLIP

    def color_pose(self, index: int) -> np.ndarray | None:
        """As :meth:`pose`, of the colour camera; the depth camera's where there is no other."""
        pose = self.pose(index)
        return None if pose is None else pose @ np.linalg.inv(self.rig.depth_to_color)

    @property
    def world(self) -> np.ndarray:
        """4x4 from the capture's own world, in which poses were given, to the stage's."""
        from pxr import UsdGeom

        local = UsdGeom.XformCache(self.times[0]).GetParentToWorldTransform(self._depth)
        return (np.array(local) @ self._frame).T

    def timestamp(self, index: int) -> float | None:
        """Seconds on the sensor's clock, or None."""
        attribute = self._depth.GetAttribute("dvct:timestamp")
        return float(attribute.Get(self.times[index])) if attribute else None

    def _file(self, prim: Usd.Prim, name: str, index: int) -> str:
        attribute = prim.GetAttribute(name)
        value = attribute.Get(self.times[index])
        if value is None or not value.path:
            raise FileError(f"{self.name(index)} has no {name} at {prim.GetPath()}; author it")
        try:
            return asset_file(attribute, value, "image")
        except StageError as error:
            raise FileError(f"{self.name(index)}: {error}") from error

    def _scene_camera(self, prim: Usd.Prim, index: int) -> Camera:
        return _camera_at(prim, self._stage, self._metres, self._frame, self.times[index])


def open_capture(path: str | Path | Usd.Stage, *, camera: str | None = None) -> Capture:
    """Open a capture, or any stage that holds one.

    Args:
        path: File, or a composed stage.
        camera: Prim path of the depth camera; needed where the stage has several.
    Raises:
        StageError: The stage cannot be read, or has no depth camera, or several.
        FileError: It has no frames.
    """
    stage = open_stage(path)
    name = name_of(stage)
    with quiet_diagnostics():
        prim = _depth_prim(stage, camera, name)
        samples = tuple(prim.GetAttribute("dvct:depth:file").GetTimeSamples())
        if not samples:
            raise FileError(f"'{name}': {prim.GetPath()} has no frames: dvct:depth:file needs time samples")
        return Capture(name, samples, _read_rig(prim, stage, samples[0], name), stage, prim)


def _depth_prim(stage: Usd.Stage, camera: str | None, name: str) -> Usd.Prim:
    from pxr import UsdGeom

    prims = [p for p in stage.Traverse() if p.IsA(UsdGeom.Camera) and p.GetAttribute("dvct:depth:file")]
    listed = ", ".join(str(p.GetPath()) for p in prims)
    if camera is not None:
        prims = [p for p in prims if str(p.GetPath()) == camera]
        if not prims:
            raise StageError(f"{camera} is not a depth camera of '{name}'; its depth cameras: {listed or 'none'}")
    if not prims:
        raise StageError(
            f"'{name}' is not a capture: it has no Camera with dvct:depth:file; make one with"
            " `warp-dvct capture import FOLDER -o capture.usda`"
        )
    if len(prims) > 1:
        raise StageError(f"'{name}' has several depth cameras; choose one: {listed}")
    return prims[0]


def _color_prim(depth: Usd.Prim) -> Usd.Prim | None:
    from pxr import UsdGeom

    colors = [p for p in depth.GetChildren() if p.IsA(UsdGeom.Camera) and p.GetAttribute("dvct:plate:file")]
    return colors[0] if colors else None


def _read_rig(prim: Usd.Prim, stage: Usd.Stage, time: float, name: str) -> CaptureRig:
    metres, frame = world_frame(stage)
    unit, invalid = prim.GetAttribute("dvct:depth:unit"), prim.GetAttribute("dvct:depth:invalid")
    if not unit or unit.Get() is None:
        raise StageError(f"{prim.GetPath()} of '{name}' has no dvct:depth:unit; author the metres per step")
    color = _color_prim(prim)
    extrinsic = np.eye(4)
    if color is not None:
        eye, other = (_camera_at(p, stage, metres, frame, time).to_world @ FLIP for p in (prim, color))
        extrinsic = np.linalg.inv(other) @ eye
    return CaptureRig(
        depth=_read_intrinsics(prim, stage, time, "dvct:depth:file"),
        color=None if color is None else _read_intrinsics(color, stage, time, "dvct:plate:file"),
        depth_to_color=extrinsic,
        unit=float(np.float64(str(np.float32(unit.Get())))),  # 0.001, not the float32 next to it
        invalid=tuple(int(v) for v in (invalid.Get() if invalid else None) or (0,)),
    )


def _read_intrinsics(prim: Usd.Prim, stage: Usd.Stage, time: float, images: str) -> Intrinsics:
    """From the apertures, and the size that is authored or that the first image has."""
    metres, frame = world_frame(stage)
    authored = prim.GetAttribute(f"{LENS}:imageSize")
    if authored and authored.HasAuthoredValue():
        width, height = (int(n) for n in authored.Get())
    else:
        attribute = prim.GetAttribute(images)
        width, height = image_size(asset_file(attribute, attribute.Get(time), "image"), f"{prim.GetPath()}: image")
    return Intrinsics.of_scene_camera(_camera_at(prim, stage, metres, frame, time), width, height)


def _camera_at(prim: Usd.Prim, stage: Usd.Stage, metres: float, frame: np.ndarray, time: float) -> Camera:
    from pxr import Usd

    return read_camera(prim, Context(stage, Usd.TimeCode(time), metres, frame))

"""UsdGeomCamera to a pinhole camera, and its plate."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_dvct.errors import FileError, StageError
from warp_dvct.lens import COEFFICIENTS
from warp_dvct.scene import Camera
from warp_dvct.usd.context import Context, matrix
from warp_dvct.usd.stage import name_of
from warp_dvct.usd.textures import asset_file

if TYPE_CHECKING:
    from pxr import Usd

LENS = "omni:lensdistortion:opencvPinhole"  # NVIDIA's names


def choose_camera(ctx: Context, name: str | None) -> Usd.Prim:
    """The camera of that path or unique name; else the only one of the stage, or the only one with a plate.

    Raises:
        StageError: There is none, the name fits none or several, or there are several and none was chosen.
    """
    from pxr import Usd, UsdGeom

    cameras = [
        prim
        for prim in Usd.PrimRange.Stage(ctx.stage, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate))
        if prim.IsA(UsdGeom.Camera)
    ]
    stage = name_of(ctx.stage)
    if not cameras:
        raise StageError(f"{stage} has no camera; add a UsdGeomCamera")
    listed = ", ".join(str(prim.GetPath()) for prim in cameras)
    if name is None:
        with_plate = [prim for prim in cameras if prim.GetAttribute("dvct:plate:file")]
        chosen = with_plate if len(with_plate) == 1 else cameras
        if len(chosen) > 1:
            raise StageError(f"{stage} has several cameras; choose one by --camera: {listed}")
        return chosen[0]
    fitting = [prim for prim in cameras if name in (str(prim.GetPath()), prim.GetName())]
    exact = [prim for prim in fitting if str(prim.GetPath()) == name]
    if len(exact or fitting) != 1:
        problem = "is the name of several cameras" if fitting else "is not a camera"
        raise StageError(f"--camera {name} {problem} of {stage}; its cameras: {listed}")
    return (exact or fitting)[0]


def read_camera(prim: Usd.Prim, ctx: Context) -> Camera:
    """Apertures, offsets and pose; scale and shear of its transform have no effect, as in Gf.Frustum.

    Raises:
        StageError: Not a perspective camera, or its focal length, an aperture or its clipping range is not positive.
    """
    from pxr import UsdGeom

    camera, path = UsdGeom.Camera(prim), str(prim.GetPath())
    if camera.GetProjectionAttr().Get(ctx.time) != UsdGeom.Tokens.perspective:
        raise StageError(f"{path}: an orthographic camera is not supported; set projection to perspective")

    def positive(name: str) -> float:
        value = float(prim.GetAttribute(name).Get(ctx.time))
        if not (np.isfinite(value) and value > 0.0):
            raise StageError(f"{path}: {name} is {value}; it must be positive")
        return value

    focal, width, height = positive("focalLength"), positive("horizontalAperture"), positive("verticalAperture")
    across = float(camera.GetHorizontalApertureOffsetAttr().Get(ctx.time))
    up = float(camera.GetVerticalApertureOffsetAttr().Get(ctx.time))
    for name, value in (("horizontalApertureOffset", across), ("verticalApertureOffset", up)):
        if not np.isfinite(value):
            raise StageError(f"{path}: {name} is {value}; give a finite number")
    near, far = _clipping(camera, ctx)
    _note_camera(camera, ctx)
    return Camera(
        to_world=_pose(prim, ctx),
        tan_left=(across - 0.5 * width) / focal,
        tan_right=(across + 0.5 * width) / focal,
        tan_bottom=(up - 0.5 * height) / focal,
        tan_top=(up + 0.5 * height) / focal,
        near=near,
        far=far,
        path=path,
        distortion=_distortion(prim, ctx),
    )


def _pose(prim: Usd.Prim, ctx: Context) -> np.ndarray:
    """A rigid 4x4 for column vectors."""
    from pxr import Gf, UsdGeom

    local = UsdGeom.XformCache(ctx.time).GetLocalToWorldTransform(prim)
    m = matrix(local) @ ctx.to_world
    if not np.isfinite(m).all() or abs(np.linalg.det(m[:3, :3])) == 0.0:
        raise StageError(f"{prim.GetPath()}: the camera's transform cannot be inverted; repair its xformOps")
    frame = Gf.Matrix4d(*m.reshape(-1).tolist())
    # A mirrored camera sees what its unmirrored twin sees: Gf.Frustum takes the flip out the same way.
    if frame.IsLeftHanded():
        frame = Gf.Matrix4d().SetScale(Gf.Vec3d(-1, 1, 1)) * frame
    frame.Orthonormalize(issueWarning=False)
    pose = matrix(frame).T.copy()
    pose[:3, 3] = m[3, :3]
    pose[3] = [0.0, 0.0, 0.0, 1.0]
    return pose


def _clipping(camera, ctx: Context) -> tuple[float, float]:
    """The authored range in metres: the schema's fallback (1, 1e6) would cut a scene of metres open."""
    attribute = camera.GetClippingRangeAttr()
    if not attribute.HasAuthoredValue():
        return 0.0, float("inf")
    near, far = attribute.Get(ctx.time)
    if not (0.0 <= near < far):
        raise StageError(f"{camera.GetPath()}: clippingRange is ({near}, {far}); give 0 <= near < far")
    return float(near) * ctx.metres, float(far) * ctx.metres


def _note_camera(camera, ctx: Context) -> None:
    prim, path = camera.GetPrim(), camera.GetPath()
    if camera.GetFStopAttr().Get(ctx.time) > 0.0 and camera.GetFocusDistanceAttr().Get(ctx.time) > 0.0:
        ctx.notices.add(path, "depth of field (fStop, focusDistance) is not modelled")
    if camera.GetShutterOpenAttr().Get(ctx.time) != camera.GetShutterCloseAttr().Get(ctx.time):
        ctx.notices.add(path, "motion blur (shutter:open, shutter:close) is not modelled")
    if len(camera.GetClippingPlanesAttr().Get(ctx.time) or ()):
        ctx.notices.add(path, "clippingPlanes are not used")
    if hasattr(camera, "ComputeLinearExposureScale") and camera.ComputeLinearExposureScale(ctx.time) != 1.0:
        ctx.notices.add(path, "the camera's exposure is not applied")
    other = [a.GetName() for a in prim.GetAuthoredAttributes() if a.GetName().startswith("omni:lensdistortion")]
    if any(name.split(":")[2] not in ("model", "opencvPinhole") for name in other if name.count(":") > 1):
        ctx.notices.add(path, "lens distortion is modelled for opencvPinhole only")


def _distortion(prim: Usd.Prim, ctx: Context) -> tuple[float, ...]:
    """OpenCV's coefficients by NVIDIA's names; () where none is authored or all are 0."""
    values = []
    for name in COEFFICIENTS:
        attribute = prim.GetAttribute(f"{LENS}:{name}")
        value = attribute.Get(ctx.time) if attribute else None
        values.append(0.0 if value is None else float(value))
    if not np.isfinite(values).all():
        raise StageError(f"{prim.GetPath()}: {LENS} has the coefficients {values}; they must be finite")
    while values and values[-1] == 0.0:
        values.pop()
    return tuple(values)


def read_plate(prim: Usd.Prim, ctx: Context, override: str | os.PathLike | None) -> str | None:
    """The photograph's file: ``override``, else ``asset dvct:plate:file`` of the camera, which may be time-sampled.

    Raises:
        FileError: ``override`` does not exist.
        StageError: The asset does not resolve to a file.
    """
    if override is not None:
        if not Path(override).is_file():
            raise FileError(f"plate '{override}' does not exist; check the path")
        return os.fspath(override)
    attribute = prim.GetAttribute("dvct:plate:file")
    value = attribute.Get(ctx.time) if attribute else None
    return asset_file(attribute, value, "plate") if value is not None and value.path else None

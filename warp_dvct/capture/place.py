"""Puts an object onto a spot of a real surface and writes that as a stage over the capture or scene."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.capture.overlay import overlay, relative
from warp_dvct.capture.spots import Spot
from warp_dvct.errors import OptionError, StageError
from warp_dvct.usd.stage import open_stage, world_frame

if TYPE_CHECKING:
    from pxr import Usd

GROUP = "/Synthetic"


@dataclass(frozen=True)
class PlacedObject:
    """An object's model and how large and in which turn it stands.

    Attributes:
        file: USD file; its default prim is placed.
        scale: Factor on the model's own size in metres.
        height: Height in metres instead; None keeps ``scale``.
        turn: Degrees about the surface's normal, counter-clockwise seen from above; at 0 the model's front (+Z, or
            -Y in a z-up model) looks where the spot says.
        color: Linear RGB of a model that brings no colour; None for UsdPreviewSurface's grey.
    """

    file: str
    scale: float = 1.0
    height: float | None = None
    turn: float = 0.0
    color: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        for name, value in (("--scale", self.scale), ("--height", self.height)):
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise OptionError(f"{name} is {value:g}; give a positive number")


@dataclass(frozen=True)
class Model:
    """What is known of a model's file.

    Attributes:
        to_metres: 3x3 from the model's units and axes to metres, y up.
        low, high: Its bounds in metres, y up.
        name: Of the file, without its ending.
    """

    to_metres: np.ndarray
    low: np.ndarray
    high: np.ndarray
    name: str


def read_model(file: str) -> Model:
    """Bounds and units of a model.

    Raises:
        StageError: It cannot be read, has no default prim, or nothing in it has a size.
    """
    from pxr import Usd, UsdGeom

    stage = open_stage(file)
    prim = stage.GetDefaultPrim()
    if not prim:
        raise StageError(f"'{file}' has no default prim, so it cannot be referenced; author defaultPrim")
    _, frame = world_frame(stage)
    cache = UsdGeom.BBoxCache(Usd.TimeCode.EarliestTime(), [UsdGeom.Tokens.default_, UsdGeom.Tokens.render])
    box = cache.ComputeWorldBound(prim).ComputeAlignedRange()
    if box.IsEmpty():
        raise StageError(f"'{file}': {prim.GetPath()} has no geometry")
    to_metres = frame[:3, :3].T
    corners = np.array([np.array(box.GetCorner(i)) for i in range(8)]) @ to_metres.T
    if not np.isfinite(corners).all() or np.ptp(corners, axis=0).max() <= 0.0:
        raise StageError(f"'{file}': {prim.GetPath()} has no size")
    return Model(to_metres, corners.min(0), corners.max(0), Path(file).stem)


def footprint(model: Model, thing: PlacedObject) -> float:
    """Radius in metres that the object covers on the surface."""
    return 0.5 * float(np.hypot(*np.ptp([model.low, model.high], axis=0)[[0, 2]])) * factor(model, thing)


def factor(model: Model, thing: PlacedObject) -> float:
    """What the model's size in metres is multiplied by."""
    if thing.height is None:
        return thing.scale
    tall = float(model.high[1] - model.low[1])
    if tall <= 0.0:
        raise OptionError(f"'{thing.file}' is flat: --height does not say how large it is; give --scale")
    return thing.height / tall


def place_object(source: str | Path, output: str | Path, spot: Spot, thing: PlacedObject, model: Model) -> str:
    """Write a stage with the object over ``source``, which stays as it is.

    Args:
        source: Capture or scene.
        output: Another file; replaced as a whole, at the end.
    Returns:
        Prim path of the object.
    Raises:
        OptionError: ``output`` is ``source``. StageError: ``source`` has no default prim.
        FileError: The stage cannot be written.
    """
    target = Path(os.path.abspath(output))
    with overlay(source, target) as stage:
        path = _free_path(stage, model.name)
        _author_object(stage, path, target.parent, spot, thing, model)
    return path


def _free_path(stage: Usd.Stage, name: str) -> str:
    """A prim path for the object; a second one of the same name gets a number."""
    name = re.sub(r"\W", "_", name)
    path, number = f"{GROUP}/{name}", 2
    while stage.GetPrimAtPath(path):
        path, number = f"{GROUP}/{name}_{number}", number + 1
    return path


def _author_object(stage: Usd.Stage, path: str, folder: Path, spot: Spot, thing: PlacedObject, model: Model) -> None:
    """``path`` holds pose and size, ``path``/Model references the file and keeps its own transforms."""
    from pxr import Gf, Sdf, UsdGeom

    metres, frame = world_frame(stage)
    up = frame[:3, :3].T / metres  # from the stage's axes to y up
    scale = factor(model, thing)
    units = float(np.linalg.norm(model.to_metres[:, 0]))
    turn = axes(spot, thing.turn) @ (model.to_metres / units)  # from the model's axes to the world's
    base = np.array([0.5 * (model.low[0] + model.high[0]), model.low[1], 0.5 * (model.low[2] + model.high[2])])
    pivot = np.linalg.inv(model.to_metres) @ base
    UsdGeom.Xform.Define(stage, GROUP)
    group = UsdGeom.Xform.Define(stage, path)
    group.AddTranslateOp().Set(Gf.Vec3d(*(up.T @ spot.position / metres).tolist()))
    group.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(_quaternion(up.T @ turn))
    group.AddScaleOp().Set(Gf.Vec3f(scale * units / metres))
    group.AddTranslateOp(opSuffix="base").Set(Gf.Vec3d(*(-pivot).tolist()))
    primvars = UsdGeom.PrimvarsAPI(group)
    primvars.CreatePrimvar("dvct:reality", Sdf.ValueTypeNames.Token).Set("synthetic")
    if thing.color is not None:
        primvars.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.constant).Set(
            [Gf.Vec3f(*thing.color)]
        )
    stage.DefinePrim(f"{path}/Model").GetReferences().AddReference(relative(thing.file, folder))


def axes(spot: Spot, degrees: float) -> np.ndarray:
    """Rotation from an upright model (y up, front +z) to the world, float64 ``[3, 3]``."""
    angle = np.radians(degrees)
    side = np.cross(spot.normal, spot.forward)
    front = np.cos(angle) * spot.forward + np.sin(angle) * side
    return np.column_stack([np.cross(spot.normal, front), spot.normal, front])


def _quaternion(turn: np.ndarray) -> Any:
    from pxr import Gf

    matrix = Gf.Matrix4d(1.0)
    matrix.SetRotateOnly(Gf.Matrix3d(turn.T.tolist()))
    matrix.Orthonormalize(issueWarning=False)
    return matrix.ExtractRotationQuat().GetNormalized()

"""The reconstructed scene as a USD stage: the capture below it, the fused mesh as a crate payload, its lights."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.capture.enclosure import Enclosure
from warp_dvct.capture.fusion import FusedMesh
from warp_dvct.capture.intrinsics import FLIP
from warp_dvct.capture.overlay import overlay, relative, save
from warp_dvct.capture.stage import Capture, Placement
from warp_dvct.errors import OptionError, StageError
from warp_dvct.image import replacing, write_radiance, write_text
from warp_dvct.probe import ProbeLights, lights_usda
from warp_dvct.usd.stage import open_stage, quiet_diagnostics, world_frame

if TYPE_CHECKING:
    from pxr import Usd, UsdShade

GREY = (0.18, 0.18, 0.18)  # of a mesh that no frame has colour for; UsdPreviewSurface's own fallback


@dataclass(frozen=True)
class SceneLights:
    """Lights of the real scene to be authored beside its mesh.

    Attributes:
        file: A layer or stage with a default prim, which is referenced; None for none.
        estimated: Lights that were fitted, written as a layer of their own; None for none.
        fill: Radiance of what the scan has not seen, RGB ``[3]``; None for none.
        facts: Numbers and lists of numbers kept as ``customData``: how well-conditioned the estimate is.
    """

    file: str | None = None
    estimated: ProbeLights | None = None
    fill: np.ndarray | None = None
    facts: dict[str, Any] = field(default_factory=dict)


def mesh_file(target: Path) -> Path:
    """The payload beside a scene."""
    return target.with_name(f"{target.stem}_mesh.usdc")


def unseen_file(target: Path) -> Path:
    """The payload of what stands for the parts that no frame has seen."""
    return target.with_name(f"{target.stem}_unseen.usdc")


def lights_file(target: Path) -> Path:
    """The layer of estimated lights beside a scene."""
    return target.with_name(f"{target.stem}_lights.usda")


def refuse_overwriting(capture: Capture, path: str | Path) -> None:
    """A scene lies over its capture, which stays as it is.

    Raises:
        OptionError: ``path`` is the capture.
    """
    if os.path.realpath(path) == os.path.realpath(capture.path):
        raise OptionError(f"the scene '{path}' would overwrite the capture that it is made of; give another name")


def write_scene(
    path: str | Path,
    capture: Capture,
    mesh: FusedMesh,
    *,
    lights: SceneLights | None = None,
    enclosure: Enclosure | None = None,
    poses: Sequence[np.ndarray | None] | None = None,
    facts: dict[str, Any] | None = None,
) -> None:
    """Write the scene and its payload; the capture's stage stays as it is and is a sublayer.

    Each file is written under a temporary name and renamed, the scene last: an interruption leaves what was there.

    Args:
        path: ``.usda`` or ``.usdc``, another file than the capture.
        mesh: In the capture stage's world.
        lights: The real scene's lights, beside those that the capture has.
        enclosure: Stands for what no frame has seen; its albedo follows the mesh's.
        poses: Depth camera (OpenCV axes) to the stage's world of every frame, where tracking found others than the
            capture's; None for a lost frame.
        facts: Kept as ``customData`` of the mesh, as what it was made with.
    Raises:
        OptionError: The scene would overwrite its capture. FileError: A file cannot be written.
    """
    target = Path(os.path.abspath(path))
    refuse_overwriting(capture, path)
    root = Path(str(capture.depth_path)).parent.as_posix()
    if root == "/":
        raise StageError(f"{capture.depth_path} of '{capture.path}' has no prim above it; put it below an Xform")
    with quiet_diagnostics():
        to_local = np.linalg.inv(capture.world)
        _write_mesh(mesh_file(target), "mesh", mesh.points, mesh.normals, mesh.triangles, mesh.colors, to_local)
        if enclosure is not None and mesh.colors is not None:
            box = enclosure.points, enclosure.normals, enclosure.triangles, enclosure.albedo(mesh.colors)
            _write_mesh(unseen_file(target), "unseen", *box, to_local)
    if lights is not None and lights.estimated is not None:
        texture = lights_file(target).with_suffix(".exr")
        write_radiance(texture, lights.estimated.dome)
        write_text(lights_file(target), lights_usda(lights.estimated, texture.name, os.path.basename(capture.path)))
    with overlay(capture.path, target) as stage:
        prim = _author_mesh(stage, root, "mesh", mesh_file(target).name)
        prim.SetCustomDataByKey(
            "dvct:reconstruction", {"frames": mesh.frames, "skipped": len(mesh.skipped), **(facts or {})}
        )
        if enclosure is not None and mesh.colors is not None:
            unseen = _author_mesh(stage, root, "unseen", unseen_file(target).name)
            unseen.SetDocumentation("Stands for the parts of the room that no frame has seen.")
        if poses is not None:
            _author_poses(stage, capture, poses)
        if lights is not None:
            _author_lights(stage, root, target, lights, np.linalg.inv(capture.world))


def _write_mesh(
    file: Path,
    name: str,
    points: np.ndarray,
    normals: np.ndarray,
    triangles: np.ndarray,
    colors: np.ndarray | None,
    to_local: np.ndarray,
) -> None:
    """A payload: one Mesh in the space of the prim above it."""
    from pxr import Usd, UsdGeom, Vt

    turn = to_local[:3, :3]
    points = np.ascontiguousarray(points @ turn.T + to_local[:3, 3], np.float32)
    normals = normals @ turn.T
    normals = np.ascontiguousarray(normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12))
    with replacing(file) as temporary:
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        prim = UsdGeom.Mesh.Define(stage, f"/{name}")
        stage.SetDefaultPrim(prim.GetPrim())
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, np.int32)))
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(triangles.ravel(), np.int32)))
        prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals.astype(np.float32)))
        prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
        if colors is None:
            prim.CreateDisplayColorAttr([GREY])
        else:
            stored = np.ascontiguousarray(np.clip(colors, 0.0, 1.0), np.float32)
            prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(stored))
        save(stage.GetRootLayer(), file)
        del stage


def _author_mesh(stage: Usd.Stage, root: str, name: str, payload: str) -> Usd.Prim:
    """A mesh prim below ``root``, tagged real, with a Lambert material of its displayColor."""
    from pxr import Sdf, UsdGeom, UsdShade

    _ignore_points(stage, root)
    prim = UsdGeom.Mesh.Define(stage, f"{root}/{name}").GetPrim()
    prim.GetPayloads().AddPayload(f"./{payload}")
    tag = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("dvct:reality", Sdf.ValueTypeNames.Token)
    tag.Set("real")
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(_lambert(stage, f"{root}/Materials"))
    return prim


def _lambert(stage: Usd.Stage, scope: str) -> UsdShade.Material:
    """The material of what was scanned: the specular workflow with F0 = 0, as a capture does not say what is glossy."""
    from pxr import Sdf, UsdGeom, UsdShade

    UsdGeom.Scope.Define(stage, scope)
    material = UsdShade.Material.Define(stage, f"{scope}/Fused")
    reader = UsdShade.Shader.Define(stage, f"{scope}/Fused/Color")
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    surface = UsdShade.Shader.Define(stage, f"{scope}/Fused/Surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    color = reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(color)
    surface.CreateInput("useSpecularWorkflow", Sdf.ValueTypeNames.Int).Set(1)
    surface.CreateInput("specularColor", Sdf.ValueTypeNames.Color3f).Set((0.0, 0.0, 0.0))
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material


def _ignore_points(stage: Usd.Stage, root: str) -> None:
    """The mesh takes the place of clouds that the capture has: both would be there twice."""
    from pxr import Sdf, UsdGeom

    for prim in stage.GetPrimAtPath(root).GetAllChildren():
        if prim.IsA(UsdGeom.Points):
            tag = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("dvct:reality", Sdf.ValueTypeNames.Token)
            tag.Set("ignore")


def _author_poses(stage: Usd.Stage, capture: Capture, poses: Sequence[np.ndarray | None]) -> None:
    """Replace the depth camera's poses in this stage alone; a lost frame keeps its images and is marked."""
    from pxr import Sdf, UsdGeom

    camera = UsdGeom.Camera(stage.OverridePrim(capture.depth_path))
    camera.ClearXformOpOrder()
    place = Placement(camera)
    known = camera.GetPrim().CreateAttribute("dvct:pose:known", Sdf.ValueTypeNames.Bool)
    to_local = np.linalg.inv(capture.world)
    for pose, time in zip(poses, capture.times, strict=True):
        known.Set(pose is not None, time)
        if pose is not None:
            place.set(to_local @ pose @ FLIP, time)


def _author_lights(stage: Usd.Stage, root: str, target: Path, lights: SceneLights, to_local: np.ndarray) -> None:
    """Reference the lights, turned from their own axes and units into those of the prim above them."""
    from pxr import Gf, UsdGeom, UsdLux, Vt

    group = UsdGeom.Xform.Define(stage, f"{root}/Lights")
    file = lights_file(target) if lights.estimated is not None else lights.file
    frame = np.eye(4)
    if file is not None:
        source = open_stage(file)
        if not source.GetDefaultPrim():
            raise StageError(f"'{file}' has no default prim, so it cannot be referenced as lights; author defaultPrim")
        frame = world_frame(source)[1]
        inner = stage.DefinePrim(f"{root}/Lights/Known")
        inner.GetReferences().AddReference(relative(file, target.parent))
    group.AddTransformOp().Set(Gf.Matrix4d((frame @ to_local.T).tolist()))
    for key, value in lights.facts.items():
        plain = Vt.DoubleArray(value) if isinstance(value, list) else value
        group.GetPrim().SetCustomDataByKey(f"dvct:{key}", plain)
    if lights.fill is not None and lights.fill.any():
        fill = UsdLux.DomeLight.Define(stage, f"{root}/Lights/Unseen")
        level = float(lights.fill.max())
        fill.CreateIntensityAttr(level)
        fill.CreateColorAttr(Gf.Vec3f(*(lights.fill / level).tolist()))
        fill.GetPrim().SetDocumentation("Stands for the parts of the room that no frame has seen.")

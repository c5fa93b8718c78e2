"""A USD stage at one time code as a :class:`warp_dvct.scene.Scene`."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_dvct.errors import StageError
from warp_dvct.scene import Camera, Light, Mesh, Notice, PointCloud, Role, Scene
from warp_dvct.usd.camera import choose_camera, read_camera, read_plate
from warp_dvct.usd.collect import Collection, Collector, Placed
from warp_dvct.usd.context import Context, shared_path
from warp_dvct.usd.geometry import LocalMesh, WorldTriangles, place, read_local
from warp_dvct.usd.lights import read_lights
from warp_dvct.usd.materials import Look, Materials
from warp_dvct.usd.points import LocalPoints, placed_radii, read_points
from warp_dvct.usd.primvars import corner_values
from warp_dvct.usd.refine import refinement_levels
from warp_dvct.usd.render import conform
from warp_dvct.usd.roles import Roles, require_roles
from warp_dvct.usd.stage import name_of, note_composition_errors, open_stage, quiet_diagnostics, world_frame
from warp_dvct.usd.textures import ImageCache

if TYPE_CHECKING:
    from pxr import Usd

VAST = 8e6  # times the objects' size: pictures of a ground of 6e6 are still right


def read_stage(
    path: str | Path | Usd.Stage,
    *,
    time: float | None = None,
    camera: str | None = None,
    real: Sequence[str] = (),
    synthetic: Sequence[str] = (),
    plate: str | os.PathLike | None = None,
    strict: bool = False,
    purposes: Sequence[str] = ("default", "render"),
    complexity: str = "high",
    render_pass: str | None = None,
    allow_empty_roles: bool = False,
    images: ImageCache | None = None,
    view: Camera | None = None,
    allow_no_light: bool = False,
) -> Scene:
    """Read a stage.

    Args:
        path: File, or a composed stage (its session layer and variant choices then hold).
        time: Time code; None for the earliest one, as usdrecord.
        camera: Path or unique name; may be None where the stage has one camera.
        real, synthetic: Prim paths whose role, and that of what is below them, is overridden.
        plate: Photograph; overrides the camera's ``dvct:plate:file``.
        strict: Refuse a stage in which something is met that is not modelled.
        purposes: UsdGeom purposes that are drawn.
        complexity: How often subdivision surfaces are refined, in usdrecord's words: ``low`` (not at all, their control
            meshes are drawn), ``medium`` (once), ``high`` (twice) or ``veryhigh``.
        render_pass: UsdRenderPass whose matte collection marks real prims; None for the only one.
        allow_empty_roles: Accept a stage that defines nothing real or nothing synthetic. Prims that are defined but
            invisible at this time are accepted always.
        images: Keeps image files over several calls.
        view: Take this camera, and the plate that is given; then the stage needs no camera.
        allow_no_light: Accept a stage without any light.
    Returns:
        The scene in metres, y up; its ``notices`` list what was met and is not modelled.
    Raises:
        StageError: The stage or something in it cannot be used; the message names the prim or file.
        FileError: ``plate`` does not exist. OptionError: ``complexity`` is another word.
    """
    from pxr import Usd

    stage = open_stage(path)
    with quiet_diagnostics():
        code = Usd.TimeCode.EarliestTime() if time is None else Usd.TimeCode(time)
        ctx = Context(stage, code, *world_frame(stage), levels=refinement_levels(complexity))
        note_composition_errors(stage, ctx.notices)
        with _naming(ctx.notices.all()):
            eye = None if view is not None else choose_camera(ctx, camera)
            found = Collector(ctx, Roles(ctx, real, synthetic, render_pass), tuple(purposes)).collect()
            _require(stage, found, allow_empty_roles, allow_no_light)
            if eye is not None:
                view, plate = conform(read_camera(eye, ctx), ctx), read_plate(eye, ctx, plate)
            assert view is not None
            scene = _assemble(ctx, view, plate, found, images or ImageCache())
    if strict and scene.notices:
        raise StageError(f"{name_of(stage)}: --strict, and this is not modelled: {_list(scene.notices)}")
    return scene


@contextmanager
def _naming(broken: Sequence[Notice]) -> Iterator[None]:
    """Add what did not load to an error's message: what is missing is often in that file."""
    try:
        yield
    except StageError as error:
        if not broken:
            raise
        raise StageError(f"{error} ({_list(broken)})") from error


def _require(stage: Usd.Stage, found: Collection, allow_empty_roles: bool, allow_no_light: bool) -> None:
    if not allow_empty_roles:
        require_roles(stage, found.defined)
    if not (found.lights_defined or allow_no_light):
        raise StageError(f"{name_of(stage)} has no light; add a UsdLux light")


def _assemble(
    ctx: Context, camera: Camera, plate: str | os.PathLike | None, found: Collection, images: ImageCache
) -> Scene:
    """Read everything that the walk found."""
    materials = Materials(ctx, images)
    meshes, clouds = _GeometryBuilder(ctx, materials).build(found.geometry)
    _note_vast(meshes, ctx)
    lights: list[Light] = []
    for placed in found.lights:
        lights += read_lights(placed, ctx, images)
    if found.lights and not lights:
        raise StageError(f"{name_of(ctx.stage)} has no light of a supported type; {_list(ctx.notices.all())}")
    return Scene(
        meshes=tuple(meshes),
        materials=tuple(materials.materials),
        textures=tuple(materials.textures),
        lights=tuple(lights),
        camera=camera,
        plate=None if plate is None else os.fspath(plate),
        notices=ctx.notices.all(),
        point_clouds=tuple(clouds),
    )


def _note_vast(meshes: Sequence[Mesh], ctx: Context) -> None:
    """List meshes so much larger than the synthetic objects that float32 rays miss parts of them."""
    bounds = [(m.points.min(0), m.points.max(0)) for m in meshes]
    small = [size for m, size in zip(meshes, bounds, strict=True) if m.role == Role.SYNTHETIC]
    if not small:
        return
    low, high = np.min([b[0] for b in small], axis=0), np.max([b[1] for b in small], axis=0)
    edge = float((high - low).max())
    for mesh, (least, most) in zip(meshes, bounds, strict=True):
        times = float((most - least).max()) / max(edge, 1e-300)
        if times > VAST:
            ctx.notices.add(
                mesh.path,
                f"is {times:.1g} times as large as all synthetic objects: rays miss parts of it; cut it smaller",
            )


def _list(notices: Sequence[Notice]) -> str:
    return "; ".join(str(notice) for notice in notices)


@dataclass(frozen=True)
class _Parts:
    """Looks of a prim, and which of them each of its faces has."""

    looks: list[Look]
    faces: np.ndarray | None  # [f] into looks; None where all have the first


class _GeometryBuilder:
    """Puts geometry, materials and primvars together; what instances share is read once."""

    def __init__(self, ctx: Context, materials: Materials) -> None:
        self._ctx = ctx
        self._materials = materials
        self._local: dict[str, LocalMesh | None] = {}

    def build(self, geometry: Sequence[Placed]) -> tuple[list[Mesh], list[PointCloud]]:
        """One mesh or cloud per prim or native instance; the copies of a point instancer's prototype share one."""
        locals_ = [self._read(placed) for placed in geometry]
        drawn = [(placed, local) for placed, local in zip(geometry, locals_, strict=True) if local is not None]
        parts = self._parts([placed for placed, _ in drawn], [local for _, local in drawn])
        meshes, clouds = [], []
        for (placed, local), part in zip(drawn, parts, strict=True):
            if isinstance(local, LocalPoints):
                clouds.append(self._cloud(placed, local, part.looks[0]))
            else:
                meshes.append(self._mesh(placed, local, part))
        return meshes, clouds

    def _read(self, placed: Placed) -> LocalMesh | None:
        from pxr import UsdGeom

        key = shared_path(placed.prim)
        if key not in self._local:
            points = placed.prim.IsA(UsdGeom.Points)
            self._local[key] = (
                read_points(UsdGeom.Points(placed.prim), self._ctx) if points else read_local(placed.prim, self._ctx)
            )
        local = self._local[key]
        return local if local is not None and len(local.topology.triangles) else None

    def _parts(self, geometry: Sequence[Placed], locals_: Sequence[LocalMesh]) -> list[_Parts]:
        """Bindings of all prims and GeomSubsets, looked up together."""
        from pxr import UsdShade

        subsets = [UsdShade.MaterialBindingAPI(placed.prim).GetMaterialBindSubsets() for placed in geometry]
        prims = [
            p for placed, own in zip(geometry, subsets, strict=True) for p in (placed.prim, *(s.GetPrim() for s in own))
        ]
        looks = iter(self._materials.bound(prims))
        parts = []
        for own, local in zip(subsets, locals_, strict=True):
            mine = [next(looks) for _ in range(1 + len(own))]
            faces = self._subset_faces(own, local.topology.face_count) if own else None
            parts.append(_Parts(mine, faces))
        return parts

    def _subset_faces(self, subsets: Sequence, face_count: int) -> np.ndarray:
        faces = np.zeros(face_count, np.int64)
        for number, subset in enumerate(subsets, 1):
            if subset.GetElementTypeAttr().Get(self._ctx.time) != "face":
                self._ctx.notices.add(subset.GetPath(), "only subsets of faces are supported; not used")
                continue
            chosen = np.array(subset.GetIndicesAttr().Get(self._ctx.time) or (), dtype=np.int64)
            if len(chosen) and (chosen.min() < 0 or chosen.max() >= face_count):
                bad = chosen[(chosen < 0) | (chosen >= face_count)][0]
                raise StageError(f"{subset.GetPath()}: indices has the face {bad}, but there are {face_count} faces")
            faces[chosen] = number
        return faces

    def _mesh(self, placed: Placed, local: LocalMesh, parts: _Parts) -> Mesh:
        topology, world = local.topology, place(local, placed.matrices)
        of_triangle = None if parts.faces is None else parts.faces[topology.faces]
        used = [0] if of_triangle is None else np.unique(of_triangle).tolist()
        looks = {k: self._resolve_color(placed, local, parts.looks[k]) for k in used}
        materials = np.zeros(len(topology.triangles), np.int32)
        uvs = colors = None
        for k, (look, color) in looks.items():
            mine = np.ones(len(materials), bool) if of_triangle is None else of_triangle == k
            materials[mine] = self._materials.index(look.material)
            if look.uv is not None:
                uvs = np.zeros((len(materials), 3, 2)) if uvs is None else uvs
                uvs[mine] = self._coordinates(placed, local, look)[mine]
            if color is not None:
                colors = np.ones((len(materials), 3, 3)) if colors is None else colors
                colors[mine] = color[mine]
        return Mesh(
            points=world.points,
            triangles=world.triangles,
            materials=world.per_triangle(materials),
            role=placed.role,
            double_sided=local.double_sided,
            corner_normals=world.normals,
            corner_uvs=_copied(world, uvs),
            corner_colors=_copied(world, colors),
            path=placed.path,
        )

    def _cloud(self, placed: Placed, local: LocalPoints, look: Look) -> PointCloud:
        world = place(local, placed.matrices)
        look, colors = self._resolve_color(placed, local, look)
        material = look.material
        if material.base_color_texture is not None or material.roughness_texture is not None:
            self._ctx.notices.add(placed.path, "points have no texture coordinates; the mean of the texture is used")
            material = replace(material, base_color_texture=None, roughness_texture=None)
        self._ctx.notices.add(
            placed.path, "its points cast the shadows of instant-radiosity's virtual lights; they are not drawn"
        )
        assert world.normals is not None
        return PointCloud(
            points=world.points[world.triangles[:, 0]],
            normals=world.normals[:, 0],
            radii=placed_radii(local, placed.matrices).astype(np.float32),
            role=placed.role,
            material=self._materials.index(material),
            colors=None if colors is None else world.per_corner(colors)[:, 0],
            double_sided=local.double_sided,
            path=placed.path,
        )

    def _resolve_color(self, placed: Placed, local: LocalMesh, look: Look) -> tuple[Look, np.ndarray | None]:
        """A look whose colour comes from a primvar: as a constant where it is one, else with corner colours."""
        if look.color is None:
            return look, None
        self._note_opacity(placed)
        corners = self._primvar(placed, local, look.color, 3)
        if corners is None:
            constant = look.color_fallback
        else:
            if corners.min() < 0.0 or corners.max() > 1.0:
                self._ctx.notices.add(placed.path, f"{look.color} leaves [0, 1] and is clamped")
                corners = np.clip(corners, 0.0, 1.0)
            if not (corners == corners[0, 0]).all():
                return look, corners
            constant = (float(corners[0, 0, 0]), float(corners[0, 0, 1]), float(corners[0, 0, 2]))
        return replace(look, material=replace(look.material, base_color=constant)), None

    def _note_opacity(self, placed: Placed) -> None:
        from pxr import UsdGeom

        opacity = UsdGeom.PrimvarsAPI(placed.prim).FindPrimvarWithInheritance("displayOpacity")
        values = opacity.Get(self._ctx.time) if opacity else None
        if values is not None and np.min(values, initial=1.0) < 1.0:
            self._ctx.notices.add(placed.path, "displayOpacity is not modelled: drawn opaque")

    def _coordinates(self, placed: Placed, local: LocalMesh, look: Look) -> np.ndarray:
        """Texture coordinates ``[t, 3, 2]`` of a look; its fallback where the prim has none."""
        assert look.uv is not None
        corners = self._primvar(placed, local, look.uv.primvar, 2) if look.uv.primvar else None
        if corners is None and look.uv.primvar and local.default_uvs is not None:
            corners = local.default_uvs
        if corners is None:
            if look.uv.primvar:
                self._ctx.notices.add(
                    placed.path, f"has no primvars:{look.uv.primvar} for its texture; one texel colours it all"
                )
            corners = np.broadcast_to(np.array(look.uv.fallback), (*local.topology.triangles.shape, 2))
        return look.uv.apply(corners)

    def _primvar(self, placed: Placed, local: LocalMesh, name: str, width: int) -> np.ndarray | None:
        """Corner values of a primvar of the prim, which instances share, or of one above it."""
        from pxr import UsdGeom

        primvar = UsdGeom.PrimvarsAPI(placed.prim).FindPrimvarWithInheritance(name)
        if not (primvar and primvar.HasAuthoredValue()):
            return None
        if primvar.GetAttr().GetPrim() != placed.prim:
            return corner_values(primvar, self._ctx, local.topology, width, placed.path)
        key = (name, width)
        if key not in local.values:
            local.values[key] = corner_values(primvar, self._ctx, local.topology, width, placed.path)
        return local.values[key]


def _copied(world: WorldTriangles, values: np.ndarray | None) -> np.ndarray | None:
    return None if values is None else world.per_corner(values)

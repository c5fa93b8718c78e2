"""The scene as the kernels see it: volume space, float32, real and synthetic triangles apart.

Volume space is ``p_vs = (p_ws - origin) * scale``, computed in float64 on the host. Distances scale alike, radiance and
irradiance are invariant, and the radiant intensity of POINT lights is multiplied by ``scale**2``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.blockers import RealHull
from warp_dvct.boxes import around_runs, middle_and_half
from warp_dvct.errors import StageError
from warp_dvct.kept import Kept
from warp_dvct.kernels.geometry import FAR, CameraFrame, Geometry
from warp_dvct.kernels.lights import Lights
from warp_dvct.kernels.materials import Materials
from warp_dvct.launch import Launcher
from warp_dvct.passes.hull import Hulls, new_hulls, real_hull
from warp_dvct.passes.sidedness import lit_from_behind
from warp_dvct.scene import Camera, Light, LightKind, Material, Mesh, Role, Scene, Texture
from warp_dvct.structs import with_fields
from warp_dvct.targets import targets_of

# A closed mesh may be met from behind by the odd ray that slips through an edge; this many are no accident.
BACKS_MET = 4
TRIANGLES = "all triangles"
# Sine of the angle between a flat light's plane and its direction, below which float32 axes do not tell the side.
LEAST_SIDE = 1e-6


@dataclass(frozen=True)
class DeviceScene:
    """Everything that the ray and shading kernels read, on one device.

    Attributes:
        geometry, materials, lights, camera: Kernel structs, in volume space.
        hulls: What of ``geometry`` depends on the camera: see :meth:`seen_by`.
        real, synthetic: The acceleration structures (``wp.Mesh``); None where there are no such triangles.
        blockers: That of the real triangles which can lie between a surface and a light (:mod:`warp_dvct.blockers`).
        targets: Where the synthetic triangles are (``kernels.aim.Targets``), see :func:`warp_dvct.targets.targets_of`.
        triangles_vs: Host float32 ``[t, 3, 3]``, corners in volume space; real triangles first, then synthetic ones.
        role, material: Host int32 ``[t]``.
        double_sided: Host int32 ``[t]``: 1 where the stage says so, or where light meets the mesh from behind and goes
            on to other surfaces.
        scanned: Host int32 ``[t]``: 1 where a triangle stands for a point of a cloud.
        origin: World position of volume space's origin, float64 ``[3]``, metres.
        scale: Volume-space units per metre.
    """

    geometry: Any
    materials: Any
    lights: Any
    camera: Any
    hulls: Hulls
    real: Any
    synthetic: Any
    blockers: Any
    targets: Any
    triangles_vs: np.ndarray
    role: np.ndarray
    double_sided: np.ndarray
    material: np.ndarray
    scanned: np.ndarray
    origin: np.ndarray
    scale: float

    @staticmethod
    def upload(
        launcher: Launcher, scene: Scene, origin: np.ndarray, scale: float, kept: Kept | None = None
    ) -> DeviceScene:
        """Move a scene into volume space and onto the launcher's device.

        Args:
            origin: World position that becomes (0, 0, 0), shape ``[3]``, metres.
            scale: Volume-space units per metre, positive.
            kept: Holds the real scene's part from frame to frame, and that of all triangles while none moves.
        Raises:
            ValueError: ``scale`` is not positive and finite.
            StageError: A triangle refers to a point or material that does not exist.
        """
        origin = np.asarray(origin, np.float64).reshape(3)
        if not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale is {scale}; it must be positive and finite")
        kept = kept or Kept()
        camera = camera_frame(scene.camera, origin, scale)
        triangles = kept.last(TRIANGLES, kept.objects)
        build = None if triangles else _begin_triangles(launcher, scene, origin, scale, camera.origin, kept)
        # Beside the building of the objects' tree: nothing here asks it.
        materials = kept.get("materials", None, lambda: _upload_materials(launcher, scene.materials, scene.textures))
        light_keys = tuple(kept.light_key(scene, i) for i in range(len(scene.lights)))
        lights = kept.get("lights", light_keys, lambda: upload_lights(launcher, scene.lights, origin, scale))
        if build is not None:
            triangles = build()
            kept.put(TRIANGLES, kept.objects, triangles)
        host, real = triangles.host, triangles.real
        triangles.hulls.look_from(launcher, camera.origin)
        geometry = with_fields(Geometry, triangles.surfaces)
        blocking = triangles.hull.blocking(triangles.boxes, scene.lights, origin, scale)
        blockers, box = kept.get("blockers", blocking.tobytes(), lambda: _blockers(launcher, host, real, blocking))
        _set_blockers(geometry, blockers, box)
        double_sided = _both_sides(launcher, host, geometry, materials, lights)
        geometry.double_sided = launcher.array(double_sided, wp.int32)
        return DeviceScene(
            geometry=geometry,
            materials=materials,
            lights=lights,
            camera=camera,
            hulls=triangles.hulls,
            real=real,
            synthetic=triangles.synthetic,
            blockers=blockers,
            targets=targets_of(triangles.boxes),
            triangles_vs=host.triangles,
            role=host.role,
            double_sided=double_sided,
            material=host.material,
            scanned=host.scanned,
            origin=origin,
            scale=float(scale),
        )

    def seen_by(self, launcher: Launcher, camera: Camera) -> DeviceScene:
        """The same scene with another camera."""
        frame = camera_frame(camera, self.origin, self.scale)
        self.hulls.look_from(launcher, frame.origin)
        return replace(self, camera=frame)

    @property
    def synthetic_first(self) -> int:
        """Index of the first synthetic triangle in the per-triangle arrays."""
        return int(self.geometry.synthetic_first)


@dataclass(frozen=True)
class _HostTriangles:
    triangles: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    colors: np.ndarray
    material: np.ndarray
    double_sided: np.ndarray
    role: np.ndarray
    mesh: np.ndarray
    scanned: np.ndarray
    synthetic_first: int
    first: int  # synthetic mesh
    vertices: list[np.ndarray]  # of each mesh
    counts: list[int]  # of its triangles

    def boxes(self, first: int = 0) -> np.ndarray:
        """Low and high corners of each mesh from triangle ``first`` on, ``[m, 2, 3]``."""
        # Over rows: NumPy's reductions of [t, 3, 3] take 20 times as long.
        corners = self.triangles[first:].reshape(-1, 3)
        return around_runs(corners, 3 * np.flatnonzero(np.diff(self.mesh[first:], prepend=-1)))

    @staticmethod
    def gather(scene: Scene, origin: np.ndarray, scale: float) -> _HostTriangles:
        """All triangles, real meshes first; absent normals become 0 (faceted), uvs 0 and colours 1."""
        meshes = sorted((m for m in scene.meshes if len(m.triangles)), key=lambda m: int(m.role))
        counts = [len(m.triangles) for m in meshes]
        vertices = [((m.points - origin) * scale).astype(np.float32) for m in meshes]

        def corners(values, width: int, absent: float) -> np.ndarray:
            parts = [
                np.full((n, 3, width), absent, np.float32) if v is None else np.asarray(v, np.float32)
                for v, n in zip(values, counts, strict=True)
            ]
            return np.concatenate([np.zeros((0, 3, width), np.float32), *parts])

        def each(values) -> np.ndarray:
            return np.concatenate([np.zeros(0, np.int32), *(np.asarray(v, np.int32) for v in values)])

        return _HostTriangles(
            triangles=corners([v[m.triangles] for v, m in zip(vertices, meshes, strict=True)], 3, 0.0),
            normals=corners([m.corner_normals for m in meshes], 3, 0.0),
            uvs=corners([m.corner_uvs for m in meshes], 2, 0.0),
            colors=corners([m.corner_colors for m in meshes], 3, 1.0),
            material=each([m.materials for m in meshes]),
            double_sided=each([np.full(n, m.double_sided) for m, n in zip(meshes, counts, strict=True)]),
            role=each([np.full(n, m.role) for m, n in zip(meshes, counts, strict=True)]),
            mesh=each([np.full(n, i) for i, n in enumerate(counts)]),
            scanned=each([np.full(n, m.scanned) for m, n in zip(meshes, counts, strict=True)]),
            synthetic_first=sum(n for m, n in zip(meshes, counts, strict=True) if m.role == Role.REAL),
            first=sum(m.role == Role.REAL for m in meshes),
            vertices=vertices,
            counts=counts,
        )


@dataclass(frozen=True)
class _Triangles:
    """What the surfaces decide, whatever the lights are.

    Attributes:
        boxes: Of the synthetic meshes, ``[m, 2, 3]``.
        surfaces: ``Geometry`` without what lights decide of it, blockers and sides: a copy of it is completed.
    """

    host: _HostTriangles
    boxes: np.ndarray
    real: Any
    hull: RealHull
    synthetic: Any
    hulls: Hulls
    surfaces: Any


def _begin_triangles(
    launcher: Launcher, scene: Scene, origin: np.ndarray, scale: float, eye: Any, kept: Kept
) -> Callable[[], _Triangles]:
    """Begin to build the tree of the synthetic triangles on a thread of its own; the call does the rest meanwhile, and
    waits for it."""
    _check_indices(scene)
    host = _HostTriangles.gather(scene, origin, scale)
    boxes = host.boxes(host.synthetic_first)
    arrays = _mesh_arrays(launcher, host.triangles[host.synthetic_first :])
    building = launcher.apart(lambda: _mesh(*arrays))

    def finish() -> _Triangles:
        hulls = new_hulls(launcher, arrays[0], boxes, host.vertices[host.first :], host.counts[host.first :])
        hulls.look_from(launcher, eye)
        real, hull = kept.get("real triangles", None, lambda: _real(launcher, host))
        synthetic = building()
        surfaces = _upload_geometry(launcher, host, real, synthetic, boxes)
        hulls.set(surfaces)
        return _Triangles(host, boxes, real, hull, synthetic, hulls, surfaces)

    return finish


def _check_indices(scene: Scene) -> None:
    for mesh in scene.meshes:
        if not len(mesh.triangles):
            continue
        _check_range(mesh, "point", mesh.triangles, len(mesh.points))
        _check_range(mesh, "material", mesh.materials, len(scene.materials))


def _check_range(mesh: Mesh, what: str, indices: np.ndarray, count: int) -> None:
    low, high = int(indices.min()), int(indices.max())
    if low < 0 or high >= count:
        wrong = low if low < 0 else high
        raise StageError(
            f"{mesh.path}: {what} index {wrong} is out of range; there are {count}. Mend the mesh's indices"
        )


def _real(launcher: Launcher, host: _HostTriangles) -> tuple[Any, RealHull]:
    """The real triangles with their tree, and which of them are on their hull."""
    triangles = host.triangles[: host.synthetic_first]
    arrays = _mesh_arrays(launcher, triangles)
    index = real_hull(launcher, arrays[0], host.vertices[: host.first], host.synthetic_first)
    return _mesh(*arrays), RealHull.of(triangles, index)


def _mesh_arrays(launcher: Launcher, triangles: np.ndarray) -> tuple[Any, Any]:
    indices = np.arange(3 * len(triangles), dtype=np.int32)
    return launcher.array(triangles.reshape(-1, 3), wp.vec3), launcher.array(indices, wp.int32)


def _mesh(points: Any, indices: Any) -> Any:
    return wp.Mesh(points=points, indices=indices) if len(indices) else None


def _both_sides(launcher: Launcher, host: _HostTriangles, geometry: Any, materials: Any, lights: Any) -> np.ndarray:
    """Per triangle, whether the back shows as well: a mesh whose back passes light on shows it everywhere."""
    if not len(host.triangles) or np.all(host.double_sided != 0):
        return host.double_sided
    boxes = host.boxes()
    low, high = boxes[:, 0].min(0), boxes[:, 1].max(0)
    center, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    backs = lit_from_behind(launcher, geometry, materials, lights, center, radius)
    met = np.bincount(host.mesh[backs], minlength=int(host.mesh[-1]) + 1)
    return np.where(met[host.mesh] >= BACKS_MET, 1, host.double_sided).astype(np.int32)


def _upload_geometry(launcher: Launcher, host: _HostTriangles, real: Any, synthetic: Any, boxes: np.ndarray) -> Any:
    geometry = Geometry()
    geometry.has_real = int(real is not None)
    geometry.has_synthetic = int(synthetic is not None)
    geometry.real = wp.uint64(real.id if real is not None else 0)
    geometry.synthetic = wp.uint64(synthetic.id if synthetic is not None else 0)
    geometry.synthetic_first = host.synthetic_first
    if synthetic is not None:
        whole = np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])[None]
        center, extent = middle_and_half(whole)
        geometry.center, geometry.extent = wp.vec3(*center[0]), wp.vec3(*extent[0])
    geometry.corner_normals = launcher.array(host.normals.reshape(-1, 3), wp.vec3)
    geometry.corner_uvs = launcher.array(host.uvs.reshape(-1, 2), wp.vec2)
    geometry.corner_colors = launcher.array(host.colors.reshape(-1, 3), wp.vec3)
    geometry.material = launcher.array(host.material, wp.int32)
    geometry.double_sided = launcher.array(host.double_sided, wp.int32)
    return geometry


def _blockers(launcher: Launcher, host: _HostTriangles, real: Any, blocking: np.ndarray) -> tuple[Any, np.ndarray]:
    """The real triangles that shadow rays ask, with their tree, and the box around them."""
    triangles = host.triangles[: host.synthetic_first]
    if not blocking.all():
        triangles = triangles[blocking]
        real = _mesh(*_mesh_arrays(launcher, triangles))
    return real, around_runs(triangles.reshape(-1, 3), np.zeros(min(1, len(triangles)), np.int64))


def _set_blockers(geometry: Any, blockers: Any, box: np.ndarray) -> None:
    geometry.has_blockers = int(blockers is not None)
    geometry.blockers = wp.uint64(blockers.id if blockers is not None else 0)
    for center, extent in zip(*middle_and_half(box), strict=True):
        geometry.blockers_center, geometry.blockers_extent = wp.vec3(*center), wp.vec3(*extent)


def _material_f0(material: Material) -> tuple[float, float, float]:
    if material.specular_color is not None:
        return material.specular_color
    reflectance = ((material.ior - 1.0) / (material.ior + 1.0)) ** 2
    return (reflectance, reflectance, reflectance)


def _upload_materials(launcher: Launcher, materials: tuple[Material, ...], textures: tuple[Texture, ...]) -> Any:
    def floats(values) -> Any:
        return launcher.array(np.array(list(values), np.float32), wp.float32)

    def ints(values) -> Any:
        return launcher.array(np.array(list(values), np.int32), wp.int32)

    def vectors(values) -> Any:
        return launcher.array(np.array(list(values), np.float32).reshape(-1, 3), wp.vec3)

    sizes = [t.pixels.shape[0] * t.pixels.shape[1] for t in textures]
    texels = np.concatenate([np.zeros((0, 3), np.float32), *(t.pixels.reshape(-1, 3) for t in textures)])
    out = Materials()
    out.base_color = vectors(m.base_color for m in materials)
    out.metallic = floats(m.metallic for m in materials)
    out.roughness = floats(m.roughness for m in materials)
    out.f0 = vectors(_material_f0(m) for m in materials)
    out.base_texture = ints(-1 if m.base_color_texture is None else m.base_color_texture for m in materials)
    out.roughness_texture = ints(-1 if m.roughness_texture is None else m.roughness_texture for m in materials)
    out.texture_first = ints(np.cumsum([0, *sizes])[:-1])
    out.texture_width = ints(t.pixels.shape[1] for t in textures)
    out.texture_height = ints(t.pixels.shape[0] for t in textures)
    out.texture_wrap_s = ints(t.wrap_s for t in textures)
    out.texture_wrap_t = ints(t.wrap_t for t in textures)
    out.texels = launcher.array(texels.astype(np.float32), wp.vec3)
    return out


def upload_lights(launcher: Launcher, lights: tuple[Light, ...], origin: np.ndarray, scale: float) -> Any:
    """The lights in volume space, with the tables that importance-sample textured domes."""

    def floats(values) -> Any:
        return launcher.array(np.array(list(values), np.float64).astype(np.float32), wp.float32)

    def ints(values) -> Any:
        return launcher.array(np.array(list(values), np.int32), wp.int32)

    def vectors(values) -> Any:
        return launcher.array(np.array(list(values), np.float64).reshape(-1, 3).astype(np.float32), wp.vec3)

    axes = [(np.asarray(x.axis_x) * scale, np.asarray(x.axis_y) * scale) for x in lights]
    domes = [_DomeTable.build(light) for light in lights]
    out = Lights()
    out.count = len(lights)
    out.kind = ints(x.kind for x in lights)
    out.role = ints(x.role for x in lights)
    out.radiance = vectors(
        np.asarray(x.radiance, np.float64) * (scale**2 if x.kind == LightKind.POINT else 1.0) for x in lights
    )
    out.position = vectors((np.asarray(x.position, np.float64) - origin) * scale for x in lights)
    out.axis_x = vectors(a for a, _ in axes)
    out.axis_y = vectors(b for _, b in axes)
    out.direction = vectors(_emission_axis(x) for x in lights)
    out.radius = floats(x.radius * scale for x in lights)
    out.bound = floats(x.radius * scale + _half_diagonal(*ab) for x, ab in zip(lights, axes, strict=True))
    out.area = floats(_area(x, *ab) for x, ab in zip(lights, axes, strict=True))
    out.cap = floats(2.0 * np.sin(0.25 * x.angle) ** 2 for x in lights)
    # pi stands for "no spot"; it is compared as float32, to which the kernels' own pi rounds as well.
    out.cone_angle = floats(min(x.cone_angle, np.pi) for x in lights)
    out.cone_inner = floats(min(x.cone_angle, np.pi) * (1.0 - np.clip(x.cone_softness, 0.0, 1.0)) for x in lights)
    rotations = np.array([x.rotation for x in lights], np.float32).reshape(-1, 3, 3)
    out.to_world = launcher.array(rotations, wp.mat33)
    out.dome_width = ints(d.width for d in domes)
    out.dome_height = ints(d.height for d in domes)
    out.dome_first = ints(_starts([len(d.texels) for d in domes]))
    out.rows_first = ints(_starts([len(d.rows) for d in domes]))
    out.columns_first = ints(_starts([d.columns.size for d in domes]))
    out.dome_texels = vectors(np.concatenate([np.zeros((0, 3)), *(d.texels for d in domes)]))
    out.row_cdf = floats(np.concatenate([np.zeros(0), *(d.rows for d in domes)]))
    out.column_cdf = floats(np.concatenate([np.zeros(0), *(d.columns.ravel() for d in domes)]))
    return out


def _starts(sizes: list[int]) -> np.ndarray:
    return np.cumsum([0, *sizes])[:-1]


def _half_diagonal(axis_x: np.ndarray, axis_y: np.ndarray) -> float:
    return float(max(np.linalg.norm(axis_x + axis_y), np.linalg.norm(axis_x - axis_y)))


def _area(light: Light, axis_x: np.ndarray, axis_y: np.ndarray) -> float:
    parallelogram = float(np.linalg.norm(np.cross(axis_x, axis_y)))
    return parallelogram * (np.pi if light.kind == LightKind.DISK else 4.0)


def _emission_axis(light: Light) -> np.ndarray:
    """The unit direction of emission; for RECT and DISK exactly perpendicular to their plane, on the given side."""
    direction = np.asarray(light.direction, np.float64)
    if light.kind in (LightKind.RECT, LightKind.DISK):
        normal = np.cross(light.axis_x, light.axis_y)
        if np.linalg.norm(normal) == 0.0:
            raise StageError(f"{light.path}: the light has no area; give it a positive size")
        side = np.dot(normal, direction) / (np.linalg.norm(normal) * (np.linalg.norm(direction) or 1.0))
        if abs(side) < LEAST_SIDE:
            raise StageError(
                f"{light.path}: the light's direction {tuple(direction)} does not say which side of its plane shines;"
                " point it to one side"
            )
        direction = normal if side > 0.0 else -normal
    length = np.linalg.norm(direction)
    if length == 0.0:
        raise StageError(f"{light.path}: the light's direction is {tuple(direction)}; give it a non-zero one")
    return direction / length


@dataclass(frozen=True)
class _DomeTable:
    """Texels (radiance included) and the cumulative tables of a dome; all empty for a light without a texture."""

    width: int
    height: int
    texels: np.ndarray
    rows: np.ndarray
    columns: np.ndarray

    @staticmethod
    def build(light: Light) -> _DomeTable:
        if light.kind != LightKind.DOME or light.texture is None:
            return _DomeTable(0, 0, np.zeros((0, 3)), np.zeros(0), np.zeros((0, 0)))
        texels = np.asarray(light.texture, np.float64) * np.asarray(light.radiance, np.float64)
        height, width = texels.shape[:2]
        # The mean of the bilinear look-up over a texel's cell: no direction with light has zero density.
        weight = texels @ np.array([0.2126, 0.7152, 0.0722])
        weight = 0.75 * weight + 0.125 * (np.roll(weight, 1, 1) + np.roll(weight, -1, 1))
        padded = np.concatenate([weight[:1], weight, weight[-1:]])
        weight = 0.75 * weight + 0.125 * (padded[:-2] + padded[2:])
        # Band height in cos(theta) is proportional to the solid angle of a row's cells.
        weight = weight * np.sin((np.arange(height) + 0.5) * np.pi / height)[:, None]
        return _DomeTable(width, height, texels.reshape(-1, 3), _cumulative(weight.sum(1)), _cumulative(weight))


def _cumulative(weight: np.ndarray) -> np.ndarray:
    """Cumulative distribution along the last axis, 0 first and 1 last; uniform where all weights are 0."""
    total = weight.sum(-1, keepdims=True)
    share = np.where(total > 0, weight / np.where(total > 0, total, 1.0), 1.0 / weight.shape[-1])
    cdf = np.concatenate([np.zeros_like(total), np.cumsum(share, -1)], -1)
    cdf[..., -1] = 1.0
    return cdf


def camera_frame(camera: Camera, origin: np.ndarray, scale: float) -> Any:
    """The camera in volume space."""
    to_world = np.asarray(camera.to_world, np.float64)
    frame = CameraFrame()
    frame.origin = wp.vec3(*((to_world[:3, 3] - origin) * scale))
    frame.right = wp.vec3(*to_world[:3, 0])
    frame.up = wp.vec3(*to_world[:3, 1])
    frame.forward = wp.vec3(*-to_world[:3, 2])
    frame.tan_left, frame.tan_right = camera.tan_left, camera.tan_right
    frame.tan_bottom, frame.tan_top = camera.tan_bottom, camera.tan_top
    frame.near = camera.near * scale
    frame.far = min(camera.far * scale, float(FAR))
    return frame

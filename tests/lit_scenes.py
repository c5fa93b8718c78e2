"""Small scenes and lit volumes for tests: closed rooms with inward faces, balls, boxes, loose triangles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import cones, shading
from warp_dvct.kernels.gbuffer import WHOLE
from warp_dvct.kernels.volume import Volume, find_record
from warp_dvct.launch import Launcher
from warp_dvct.methods import light_field
from warp_dvct.passes.gbuffer import new_points
from warp_dvct.passes.pyramid import build_pyramid, light_faces
from warp_dvct.passes.voxels import Box, Voxels, unlit, voxelize
from warp_dvct.scene import Camera, Light, LightKind, Material, Mesh, Role, Scene

GREY = Material(base_color=(0.5, 0.4, 0.3), ior=1.0)
CENTER = np.array([0.5, 0.5, 0.5])
LAMP = Light(  # under the ceiling of ``room(0.45)``
    LightKind.RECT,
    (8.0, 7.0, 6.0),
    position=(0.5, 0.94, 0.5),
    axis_x=(0.15, 0, 0),
    axis_y=(0, 0, 0.15),
    direction=(0, -1, 0),
    path="/World/Lamp",
)
EYES = np.eye(3)


def turned(degrees: float) -> np.ndarray:
    """A rotation that is aligned with no axis unless ``degrees`` is 0."""
    a = np.radians(degrees)
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    return about_y @ about_z


def rectangle(center, half_x, half_y) -> np.ndarray:
    """Two triangles whose front is half_x cross half_y: float64 ``[2, 3, 3]``."""
    c, x, y = (np.asarray(v, float) for v in (center, half_x, half_y))
    p = [c - x - y, c + x - y, c + x + y, c - x + y]
    return np.array([[p[0], p[1], p[2]], [p[0], p[2], p[3]]])


def cuboid(center, half, degrees: float = 0.0) -> np.ndarray:
    """A closed box, faces outwards: float64 ``[12, 3, 3]``."""
    half = np.broadcast_to(np.asarray(half, float), 3)
    sides = []
    for axis in range(3):
        x, y = EYES[(axis + 1) % 3], EYES[(axis + 2) % 3]
        for sign in (1.0, -1.0):
            sides.append(rectangle(sign * EYES[axis] * half, sign * x * half, y * half))
    return np.concatenate(sides) @ turned(degrees).T + np.asarray(center, float)


def room(half=0.4, degrees: float = 0.0, center=CENTER) -> np.ndarray:
    """A closed box, faces inwards."""
    return cuboid(center, half, degrees)[:, ::-1]


def ball(center, radius: float, rings: int = 24) -> np.ndarray:
    """A closed ball, faces outwards, without degenerate triangles."""
    theta = np.linspace(0, np.pi, rings + 1)[:, None]
    phi = np.linspace(0, 2 * np.pi, 2 * rings + 1)[None, :]
    p = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], -1)
    p[:, -1] = p[:, 0]
    p[0], p[-1] = [0, 0, 1], [0, 0, -1]
    a, b, c, d = p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]
    upper = np.stack([a, b, c], 2)[:-1].reshape(-1, 3, 3)
    lower = np.stack([a, c, d], 2)[1:].reshape(-1, 3, 3)
    return np.concatenate([upper, lower]) * radius + np.asarray(center, float)


def cross_of(triangles: np.ndarray) -> np.ndarray:
    """Twice the area vectors."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def face_areas(triangles: np.ndarray) -> np.ndarray:
    """Projected front-facing area of a mesh per face direction (+x, -x, +y, …): ``[6]``."""
    n = 0.5 * cross_of(triangles)
    return np.array([np.maximum(s * n[:, k], 0).sum() for k in range(3) for s in (1, -1)])


def area_of(triangles: np.ndarray) -> float:
    """Surface area."""
    return float(0.5 * np.linalg.norm(cross_of(triangles), axis=-1).sum())


def mesh(triangles: np.ndarray, role: Role = Role.REAL, material: int = 0, **more: Any) -> Mesh:
    """Loose triangles as a mesh."""
    count = len(triangles)
    index = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    return Mesh(np.asarray(triangles, float).reshape(-1, 3), index, np.full(count, material, np.int32), role, **more)


def look_at(eye, target, *, half: float = 0.5, up=(0, 1, 0), aspect: float = 1.0) -> Camera:
    """A camera whose image is ``2 * half`` high on the plane at distance 1."""
    back = np.asarray(eye, float) - np.asarray(target, float)
    back /= np.linalg.norm(back)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    to_world = np.eye(4)
    to_world[:3] = np.stack([right, np.cross(back, right), back, np.asarray(eye, float)], 1)
    return Camera(to_world, -half * aspect, half * aspect, -half, half)


def scene_of(*meshes: Mesh, lights: tuple[Light, ...] = (), materials=(GREY,), camera: Camera | None = None) -> Scene:
    """A scene; its camera looks at the unit cube's middle."""
    return Scene(meshes, tuple(materials), (), tuple(lights), camera or look_at((0.5, 0.5, 0.15), CENTER))


def upload(launcher: Launcher, scene: Scene) -> DeviceScene:
    """The scene on the device, with volume space equal to world space."""
    return DeviceScene.upload(launcher, scene, np.zeros(3), 1.0)


def unit_normals(launcher: Launcher, device_scene: DeviceScene) -> Any:
    """Unit geometric normals of all triangles."""
    return launcher.array(light_field.unit_normals(device_scene.triangles_vs), wp.vec3)


def voxels_of(launcher: Launcher, device_scene: DeviceScene, n: int, low=(0.0, 0.0, 0.0), edge: float = 1.0) -> Voxels:
    """The scene's voxels in a cube, by default the unit cube."""
    corners = launcher.array(device_scene.triangles_vs.reshape(-1, 3), wp.vec3)
    normals = unit_normals(launcher, device_scene)
    sides = device_scene.geometry.double_sided
    box = Box(tuple(low), edge, n)
    return unlit(launcher, voxelize(launcher, corners, normals, sides, device_scene.synthetic_first, box))


def areas(voxels: Voxels) -> np.ndarray:
    """Projected areas in voxel faces: float64 ``[records, 6, 2]``."""
    return voxels.area.numpy()[: voxels.level_records[0] * 6].reshape(-1, 6, 2).astype(float)


wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def _look_up(first: int, volume: Volume, level: int, extent: int, record_out: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    record_out[i] = find_record(volume, level, i / (extent * extent), (i / extent) % extent, i % extent)


def look_up(voxels: Voxels, level: int = 0) -> np.ndarray:
    """Record of every voxel of a level through the brick map, or -1: int ``[x, y, z]``."""
    extent = ((voxels.box.n - 1) >> level) + 1
    launcher = Launcher(str(voxels.volume.field.device), threads=1)
    records = launcher.empty(extent**3, wp.int32)
    launcher.launch(_look_up, extent**3, [voxels.volume, level, extent], [records])
    return records.numpy().reshape(extent, extent, extent)


def dense(voxels: Voxels, values: np.ndarray, level: int = 0) -> np.ndarray:
    """Values per record as a dense grid ``[x, y, z, …]``, 0 in empty voxels."""
    records = look_up(voxels, level)
    out = np.zeros((*records.shape, *values.shape[1:]))
    out[records >= 0] = values[records[records >= 0]]
    return out


def field_of(voxels: Voxels, level: int) -> np.ndarray:
    """A level's field as a dense grid: ``[x, y, z, face, solution, 4]``."""
    return dense(voxels, voxels.field().astype(float), level)


def launcher_vectors(launcher: Launcher, values: np.ndarray) -> Any:
    """Host values ``[n, 3]`` as a vec3 array."""
    return launcher.array(np.asarray(values, np.float32).reshape(-1, 3), wp.vec3)


def uniform_flux(launcher: Launcher, voxels: Voxels, radiosity: np.ndarray) -> Any:
    """Flux of surfaces that all have radiosity ``[3]``, or one per solution ``[2, 3]``."""
    value = np.broadcast_to(np.asarray(radiosity, float), (2, 3))
    return launcher.array((areas(voxels)[..., None] * value).reshape(-1, 3).astype(np.float32), wp.vec3)


@dataclass(frozen=True)
class Lit:
    """A scene with lit volumes, ready to be gathered from."""

    scene: Scene
    device_scene: DeviceScene
    volumes: tuple[Voxels, ...]
    world: Any


def lit_world(
    launcher: Launcher, scene: Scene, n: int, flux_of: Any, *, filter: str = "directional", boxes=None
) -> Lit:
    """Voxelise a scene in the unit cube (or in ``boxes``: low, edge, n), light it, and filter it.

    Args:
        flux_of: Called with (device scene, voxels), gives the flux array as ``passes.injection`` has it.
    """
    device_scene = upload(launcher, scene)
    volumes = []
    for low, edge, size in boxes or [((0.0, 0.0, 0.0), 1.0, n)]:
        voxels = voxels_of(launcher, device_scene, size, low, edge)
        light_faces(launcher, voxels, flux_of(device_scene, voxels), filter=filter)
        build_pyramid(launcher, voxels, filter=filter)
        volumes.append(voxels)
    world = light_field.world_of(launcher, scene, unit_normals(launcher, device_scene), volumes)
    return Lit(scene, device_scene, tuple(volumes), world)


def points_at(launcher: Launcher, positions, normals, *, role=0, color=(0.5, 0.5, 0.5), reach: float = 1.0) -> Any:
    """Lambertian shading points with given places and normals, seen along their normals."""
    positions = np.asarray(positions, np.float32).reshape(-1, 3)
    count = len(positions)
    normals = np.broadcast_to(np.asarray(normals, np.float32), (count, 3))
    points = new_points(launcher, count)
    points.position = launcher.array(positions, wp.vec3)
    points.normal = points.normal_g = points.view = launcher.array(np.ascontiguousarray(normals), wp.vec3)
    points.base_color = points.diffuse = launcher.full(count, wp.vec3(*color), wp.vec3)
    points.f0, points.lobe = launcher.zeros(count, wp.vec3), launcher.zeros(count, wp.vec2)
    points.footprint, points.triangle = launcher.zeros(count, wp.float32), launcher.zeros(count, wp.int32)
    points.reach = launcher.full(count, reach, wp.float32)
    points.pixel = launcher.array(np.stack([np.arange(count)] * 2, -1).astype(np.int32), wp.vec2i)
    points.slot = launcher.full(count, WHOLE, wp.int32)
    points.role = launcher.array(np.broadcast_to(np.asarray(role, np.int32), count).copy(), wp.int32)
    return points


def points_on(
    launcher: Launcher, device_scene: DeviceScene, count: int, seed: int = 1, triangles=None, inset=0.0
) -> Any:
    """Random points on chosen triangles (all by default), each equally likely; and the triangle of each.

    ``inset`` shrinks each triangle towards its middle.
    """
    rng = np.random.default_rng(seed)
    corners = device_scene.triangles_vs.astype(float)
    pick = rng.choice(np.arange(len(corners)) if triangles is None else np.asarray(triangles), count)
    uv = rng.random((count, 2))
    uv = np.where(uv.sum(1, keepdims=True) > 1, 1 - uv, uv)
    weights = np.concatenate([1 - uv.sum(1, keepdims=True), uv], 1) * (1 - inset) + inset / 3
    positions = np.einsum("pk,pkx->px", weights, corners[pick])
    normals = light_field.unit_normals(device_scene.triangles_vs)[pick]
    return points_at(launcher, positions, normals, role=device_scene.role[pick]), pick


def cone_settings(escape: str = "ray", **more: Any) -> Any:
    """Cones as the method has them by default."""
    settings = cones.ConeSettings()
    settings.aperture, settings.step, settings.detail, settings.start = 0.0, 1.0, 0.5, 1.5
    settings.reach, settings.additive, settings.split = 4.0, 1, cones.DUAL
    settings.escape = int(escape == "ray")
    for name, value in more.items():
        setattr(settings, name, value)
    return settings


def direct_settings(*, samples: int = 1, probes: int | None = None, with_before: bool = True) -> Any:
    """Settings of the direct pass without a specular pass."""
    direct = shading.Direct()
    direct.samples, direct.probes = samples, samples if probes is None else probes
    direct.edge_samples = 1
    direct.glossy, direct.alpha_max, direct.seed = 0, -1.0, 0
    direct.with_before = int(with_before)
    return direct

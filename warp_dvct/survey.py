"""What a picture requires of a scene, found before its settings are chosen: surfaces, pixels by kind, lights, lobes.

A small picture is rendered with coarse settings (0.05 s of processor time for a room). Counts in it are shares of the
picture, so they hold for any size; nothing in it is timed, so the same scene gives the same survey on every machine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import survey as kernels
from warp_dvct.launch import Launcher
from warp_dvct.methods import delta_cone_tracing
from warp_dvct.metrics import affected_mask, smooth_delta
from warp_dvct.passes.composite import composite
from warp_dvct.passes.gbuffer import GBuffer, render_gbuffer
from warp_dvct.plan import Plan, make_plan, surface_area
from warp_dvct.scene import Light, LightKind, Role, Scene
from warp_dvct.settings import Settings, make_settings

WIDTH = 80
MET_RAYS = 4
COARSE = {
    "bounces": 2,
    "antialias": 0,
    "volume.resolution": 32,
    "volume.coarse": 32,
    "rsm.texels": 96,
    "shadows.samples": 4,
    "shadows.probes": 4,
    "gather.rays": 16,
    "gather.object_rays": 16,
    "gather.stride": 4,
    "gather.object_stride": 2,
    "glossy.rays": 2,
    "patches.count": 256,
    "patches.rays": 16,
}
REFERENCE = {"volume.resolution": 256, "volume.coarse": 128, "rsm.texels": 8192}  # at which map sizes are taken


@dataclass(frozen=True)
class MapNeed:
    """Texels an edge of a light's maps at which none is larger than a voxel, per voxel along the volume's edge."""

    fine: float
    coarse: float
    pair: bool


@dataclass(frozen=True)
class Survey:
    """What a scene asks of a frame.

    Attributes:
        triangles: In all. lights: Those that the direct pass samples, all but domes. dome: Whether there is one.
        maps: Per light.
        area_fine, area_coarse: Surface in each volume, over the square of its edge; 0 for no coarse volume.
        real, object: Shares of the pixels whose centre shows real surface, and synthetic.
        met: Of rays that gather light at what is seen, the share that meets a surface and does not leave the scene.
        outline: Edge pixels of a picture, over its width.
        glossy: Share of the pixels with a lobe that is traced by itself.
        near: Over all lights, shares of pixels whose line to the light passes the synthetic objects.
        affected: Share of the pixels that the objects cover or change by more than 0.01.
        change: Mean over affected pixels of the change's size, over the mean picture.
        changes: Whether anything is synthetic or a light is added. plate: Whether a plate will be given.
        feature: Smallest extent of a synthetic mesh, in edges of the fine volume; 0 where there is none.
        voxel: Edge of the fine volume in metres.
        roughness: Of the smoothest glossy material, None where the specular pass has nothing to do.
    """

    triangles: int
    lights: int
    dome: bool
    maps: tuple[MapNeed, ...]
    area_fine: float
    area_coarse: float
    real: float
    object: float
    met: float
    outline: float
    glossy: float
    near: float
    affected: float
    change: float
    changes: bool
    plate: bool
    feature: float
    voxel: float
    roughness: float | None


def survey(scene: Scene, settings: Settings, launcher: Launcher, aspect: float, *, has_plate: bool) -> Survey:
    """Look at a scene before its settings are chosen.

    Args:
        settings: Those that the user fixed matter (``volume.scale``, ``glossy.roughness``), the others do not.
        aspect: Width over height of the picture.
        has_plate: Whether a plate will be given.
    Raises:
        DeviceError: Out of memory.
    """
    fixed = {"volume.scale": settings.volume_scale, "volume.reach": settings.volume_reach}
    fixed["glossy.roughness"] = settings.glossy_roughness
    height = max(16, round(WIDTH / aspect))
    needs = make_plan(scene, make_settings("balanced", {**REFERENCE, **fixed}), "delta-cones", WIDTH, height)
    plan = make_plan(scene, make_settings("balanced", {**COARSE, **fixed}), "delta-cones", WIDTH, height)
    device_scene = DeviceScene.upload(launcher, scene, np.asarray(plan.origin), plan.scale)
    buffer = render_gbuffer(launcher, device_scene, WIDTH, height, edge_samples=1, behind=False)
    affected, change = _pilot(scene, device_scene, launcher, plan)
    role, lobe = (a.numpy()[: WIDTH * height] for a in (buffer.points.role, buffer.points.lobe))
    real = role == int(Role.REAL)
    glossy = (role >= 0) & (lobe[:, 0] > 0.0) & (lobe[:, 1] <= plan.alpha_max)
    return Survey(
        triangles=len(device_scene.triangles_vs),
        lights=sum(x.kind != LightKind.DOME for x in scene.lights),
        dome=any(x.kind == LightKind.DOME for x in scene.lights),
        maps=tuple(
            MapNeed(m.size / needs.fine.n, m.coarse_size / needs.coarse.n if needs.coarse else 0.0, m.pair)
            for m in needs.maps
        ),
        area_fine=_area(scene, plan, plan.fine),
        area_coarse=_area(scene, plan, plan.coarse) if plan.coarse else 0.0,
        real=float(real.mean()),
        object=float((role == int(Role.SYNTHETIC)).mean()),
        met=_met(launcher, device_scene, buffer),
        outline=(buffer.count - WIDTH * height) / WIDTH,
        glossy=float(glossy.mean()),
        near=_near(scene, plan, buffer, real),
        affected=affected,
        change=change,
        changes=plan.changes,
        plate=has_plate,
        feature=_feature(scene) * plan.scale,
        voxel=1.0 / plan.scale,
        roughness=_smoothest(scene) if plan.glossy else None,
    )


def _met(launcher: Launcher, device_scene: DeviceScene, buffer: GBuffer) -> float:
    count = WIDTH * buffer.height
    found = launcher.empty(count, wp.int32)
    launcher.launch(kernels._count_met, count, [buffer.points, device_scene.geometry, MET_RAYS, 0], [found])
    met = found.numpy()
    return float(met[met >= 0].mean()) / MET_RAYS if (met >= 0).any() else 0.0


def _area(scene: Scene, plan: Plan, box: Any) -> float:
    return surface_area(scene, box, plan.scale, np.asarray(plan.origin)) / box.edge**2


def _pilot(scene: Scene, device_scene: DeviceScene, launcher: Launcher, plan: Plan) -> tuple[float, float]:
    """Share of affected pixels, and the mean size of their change over the mean picture, from the coarse picture."""
    if not plan.changes:
        return 0.0, 0.0
    lit = delta_cone_tracing.light_volumes(launcher, scene, device_scene, plan)
    radiance = delta_cone_tracing.render(launcher, scene, device_scene, lit, plan, with_before=True)
    layers = composite(launcher, radiance, None)
    delta = smooth_delta(layers.delta, layers.mask_synthetic)
    mask = affected_mask(delta, layers.mask_synthetic)
    level = float(np.abs(layers.comp).mean())
    if not mask.any() or level <= 0.0:
        return 0.0, 0.0
    return float(mask.mean()), float(np.abs(layers.comp - layers.plate)[mask].mean()) / level


def _near(scene: Scene, plan: Plan, buffer: GBuffer, real: np.ndarray) -> float:
    """Over lights, shares of pixels whose line to the light's middle passes the objects' bounding sphere."""
    bounds = scene.bounds(Role.SYNTHETIC)
    if bounds is None:
        return 0.0
    low, high = ((b - np.asarray(plan.origin)) * plan.scale for b in bounds)
    center, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    points = buffer.points.position.numpy()[: len(real)].astype(np.float64)[real]
    return sum(_passing(points, light, plan, center, radius) for light in scene.lights) / len(real)


def _passing(points: np.ndarray, light: Light, plan: Plan, center: np.ndarray, radius: float) -> float:
    """How many points' lines to a light pass a sphere that is larger by half of the light."""
    if light.kind == LightKind.DOME:
        return 0.0
    if light.kind == LightKind.DISTANT:
        direction = np.broadcast_to(-np.asarray(light.direction, np.float64), points.shape)
        reach, wider = np.full(len(points), np.inf), 0.0
    else:
        toward = (np.asarray(light.position) - np.asarray(plan.origin)) * plan.scale - points
        reach = np.linalg.norm(toward, axis=1)
        direction = toward / np.maximum(reach, 1e-12)[:, None]
        wider = 0.5 * plan.scale * (light.radius + np.linalg.norm(light.axis_x) + np.linalg.norm(light.axis_y))
    along = np.clip(((center - points) * direction).sum(1), 0.0, reach)
    apart = np.linalg.norm(center - points - direction * along[:, None], axis=1)
    return float((apart <= radius + wider).sum())


def _feature(scene: Scene) -> float:
    """Smallest extent of a synthetic mesh [m]; extents of flat ones in their plane."""
    found = []
    for mesh in scene.meshes:
        if mesh.role == Role.SYNTHETIC and len(mesh.triangles):
            used = mesh.points[mesh.triangles.ravel()]
            extent = used.max(0) - used.min(0)
            found.append(float(np.min(extent[extent > 1e-6 * extent.max()], initial=math.inf)))
    return min((f for f in found if math.isfinite(f)), default=0.0)


def _smoothest(scene: Scene) -> float:
    used = {int(i) for mesh in scene.meshes for i in np.unique(mesh.materials)}
    shiny = [m for m in (scene.materials[i] for i in used) if m.ior != 1.0 or m.metallic > 0.0 or m.specular_color]
    return min((m.roughness for m in shiny if m.specular_color is None or max(m.specular_color) > 0.0), default=0.0)

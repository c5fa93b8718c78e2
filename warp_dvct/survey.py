"""What a picture requires of a scene, found before its settings are chosen: surfaces, pixels by kind, lights, lobes.

A small picture is rendered with coarse settings (0.1 s of processor time for a room). Counts in it are shares of the
picture, so they hold for any size; nothing in it is timed, so the same scene gives the same survey on every machine.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct import gather_need
from warp_dvct.device_scene import DeviceScene
from warp_dvct.gather_need import GatherNeed, Seen, View
from warp_dvct.kernels import survey as kernels
from warp_dvct.kernels.specular import BLURRED
from warp_dvct.launch import Launcher
from warp_dvct.passes.gbuffer import GBuffer, render_gbuffer
from warp_dvct.pilot import WIDTH, VolumeNeed, make_pilot, plan_pilot
from warp_dvct.plan import Plan, make_plan
from warp_dvct.scene import Light, LightKind, Role, Scene
from warp_dvct.settings import Settings, make_settings

RAYS = 8  # of a point, to see what is around it
# At which map sizes are taken.
REFERENCE = {"volume.resolution": 256, "volume.coarse": 128, "rsm.texels": 8192, "rsm.density": 1}


@dataclass(frozen=True)
class MapNeed:
    """Texels an edge of a light's maps at which none is larger than a voxel, per voxel along the volume's edge.

    ``aperture``: Full angle [rad] that the light subtends at the fine volume's middle; None for a dome.
    """

    fine: float
    coarse: float
    pair: bool
    aperture: float | None


@dataclass(frozen=True)
class PointNeed:
    """What gathers of one role take.

    Attributes:
        need: How many points.
        met: Share of their rays that meet a surface and do not leave the scene.
        entered, entered_again: Shares of their rays that pass the synthetic objects' box: of all points, and of those
            that are gathered again at half the stride.
        aimed, aimed_again: Shares of the points, and of those again, of which the objects take up so little of the view
            that rays are aimed at them.
        toward, toward_again: Rays that these points aim for each even one.
    """

    need: GatherNeed
    met: float
    entered: float
    entered_again: float
    aimed: float
    aimed_again: float
    toward: float
    toward_again: float


@dataclass(frozen=True)
class EdgeNeed:
    """Shares of the shading points at edges."""

    object: float = 0.0
    sharp: float = 0.0
    blurred: float = 0.0


@dataclass(frozen=True)
class Survey:
    """What a scene asks of a frame.

    Attributes:
        real_triangles, synthetic_triangles: Of each role.
        lights: Those that the direct pass samples, all but domes. dome: Whether there is one.
        maps: Per light.
        fine, coarse: The volumes; None for no coarse one.
        patches: Per record of the level that they are taken from.
        on_real, on_object: What gathering at real and at synthetic surfaces takes.
        edge: What the shading points at edges show: shares as ``object``, ``sharp`` and ``blurred``.
        met: Of rays that gather light at what is seen, the share that meets a surface and does not leave the scene.
        outline: Edge pixels of a picture, over its width.
        sharp, blurred: Shares of the pixels with a lobe that is traced by itself, whose rays' ends are lit by lights
            or read from the voxels.
        near: Over all lights, shares of pixels whose line to the light passes the synthetic objects.
        affected: Share of the pixels that the objects cover or change by more than 0.01.
        change: Mean over affected pixels of the change's size, over the mean picture.
        shown: Mean over the picture of the ``FLIP_POWER`` of the change in display luma that the objects make.
        noise: The same of the difference between two such pictures by other random numbers.
        outlined: The same of the steps that change makes from pixel to pixel where an object begins or ends, summed
            over them for each row of the picture.
        later: As ``shown``, of the light of further bounces than the first. decay: Light of a bounce over that of the
            one before.
        changes: Whether anything is synthetic or a light is added. plate: Whether a plate will be given.
        feature: Smallest extent of a synthetic mesh, in edges of the fine volume; 0 where there is none.
        voxel: Edge of the fine volume in metres. reach: Edge of the coarse one, in edges of the fine one; 1 for none.
        roughness: Of the smoothest glossy material, None where the specular pass has nothing to do.
        focuses: Whether what gathered rays meet may send light to places rather than all around.
    """

    real_triangles: int
    synthetic_triangles: int
    lights: int
    dome: bool
    maps: tuple[MapNeed, ...]
    fine: VolumeNeed
    coarse: VolumeNeed | None
    patches: float
    on_real: PointNeed
    on_object: PointNeed
    edge: EdgeNeed
    met: float
    outline: float
    sharp: float
    blurred: float
    near: float
    affected: float
    change: float
    shown: float
    noise: float
    outlined: float
    later: float
    decay: float
    changes: bool
    plate: bool
    feature: float
    voxel: float
    reach: float
    roughness: float | None
    focuses: bool

    @property
    def triangles(self) -> int:
        """In all."""
        return self.real_triangles + self.synthetic_triangles

    @property
    def real(self) -> float:
        """Share of the pixels whose centre shows real surface."""
        return self.on_real.need.share

    @property
    def object(self) -> float:
        """Share of the pixels whose centre shows an object."""
        return self.on_object.need.share


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
    plan = plan_pilot(scene, height, fixed)
    device_scene = DeviceScene.upload(launcher, scene, np.asarray(plan.origin), plan.scale)
    once, again = (plan_pilot(scene, height, {**fixed, **other}) for other in ({"bounces": 1}, {"seed": 1}))
    pilot = make_pilot(scene, device_scene, launcher, plan, once, again)
    least = settings.gather_change if has_plate else 0.0
    seen = _look(scene, device_scene, launcher, plan, 2 * height, pilot.changed(least))
    return Survey(
        real_triangles=device_scene.synthetic_first,
        synthetic_triangles=len(device_scene.triangles_vs) - device_scene.synthetic_first,
        lights=sum(x.kind != LightKind.DOME for x in scene.lights),
        dome=any(x.kind == LightKind.DOME for x in scene.lights),
        maps=tuple(
            MapNeed(
                m.size / needs.fine.n,
                m.coarse_size / needs.coarse.n if needs.coarse else 0.0,
                m.pair,
                _aperture(scene.lights[m.light], plan),
            )
            for m in needs.maps
        ),
        fine=pilot.fine,
        coarse=pilot.coarse,
        patches=pilot.patches,
        **seen,
        **asdict(pilot.picture),
        changes=plan.changes,
        plate=has_plate,
        feature=_feature(scene) * plan.scale,
        voxel=1.0 / plan.scale,
        reach=plan.coarse.edge if plan.coarse else 1.0,
        roughness=_smoothest(scene) if plan.glossy else None,
        focuses=pilot.focuses,
    )


def _look(
    scene: Scene, device_scene: DeviceScene, launcher: Launcher, plan: Plan, height: int, changed: np.ndarray
) -> dict[str, Any]:
    """What the camera sees, in a picture of twice the pilot's size, and what is seen from there."""
    width = gather_need.WIDTH
    buffer = render_gbuffer(launcher, device_scene, width, height, edge_samples=1, behind=False)
    points, pixels = buffer.points, width * height
    role, lobe = points.role.numpy(), points.lobe.numpy()
    lobed = (role >= 0) & (lobe[:, 0] > 0.0) & (lobe[:, 1] <= plan.alpha_max)
    sharp = lobed & (lobe[:, 1] < float(BLURRED))
    kinds = {"object": role == int(Role.SYNTHETIC), "sharp": sharp, "blurred": lobed & ~sharp}
    met, entered, nearness, toward = _around(scene, device_scene, launcher, plan, buffer)
    arrays = (points.pixel, points.position, points.normal, points.normal_g, points.footprint)
    shown = Seen(role, *(a.numpy() for a in arrays))
    changed = changed.repeat(2, 0).repeat(2, 1)
    needs = {}
    for name, which in (("on_real", Role.REAL), ("on_object", Role.SYNTHETIC)):
        mask = (role[:pixels] == int(which)).reshape(height, width)
        # Only real surfaces are left alone where nothing changes.
        live = changed if which == Role.REAL else np.ones_like(mask)
        need, again = gather_need.gather_need(View(shown, int(which), nearness, live))
        needs[name] = PointNeed(
            need,
            *(_mean(met, mask), _mean(entered, mask), _mean(entered, again)),
            *(_mean(toward > 0.0, where) for where in (mask, again)),
            *(_mean(toward, where & (toward > 0.0)) for where in (mask, again)),
        )
    edges = EdgeNeed()
    if buffer.count > pixels:
        edges = EdgeNeed(**{name: float(kind[pixels : buffer.count].mean()) for name, kind in kinds.items()})
    return {
        **needs,
        "edge": edges,
        "met": _mean(met, role[:pixels].reshape(height, width) >= 0),
        "outline": (buffer.count - pixels) / width,
        "sharp": float(sharp[:pixels].mean()),
        "blurred": float(kinds["blurred"][:pixels].mean()),
        "near": _near(scene, plan, buffer, role[:pixels] == int(Role.REAL)),
    }


def _mean(values: np.ndarray, mask: np.ndarray) -> float:
    counted = mask & ~np.isnan(values)
    return float(values[counted].mean()) if counted.any() else 0.0


def _around(
    scene: Scene, device_scene: DeviceScene, launcher: Launcher, plan: Plan, buffer: GBuffer
) -> tuple[np.ndarray, ...]:
    """By pixel, from every other one each way: shares of its rays that meet a surface and that pass the synthetic box
    (NaN where there is no surface), the mean inverse distance of what they meet, and rays aimed for each even one."""
    shape = -(-buffer.height // 2), -(-buffer.width // 2)
    rows, columns = np.meshgrid(*(2 * np.arange(n) for n in shape), indexing="ij")
    index = launcher.array((rows * buffer.width + columns).ravel().astype(np.int32), wp.int32)
    count = index.shape[0]
    bounds = scene.bounds(Role.SYNTHETIC)
    low, high = ((b - np.asarray(plan.origin)) * plan.scale for b in bounds) if bounds else (np.ones(3), np.zeros(3))
    met, entered = (launcher.empty(count, wp.int32) for _ in range(2))
    nearness, toward = (launcher.empty(count, wp.float32) for _ in range(2))
    inputs = [buffer.points, index, device_scene.geometry, device_scene.targets, wp.vec3(*low), wp.vec3(*high), RAYS, 0]
    launcher.launch(kernels._look_around, count, inputs, [met, entered, nearness, toward])
    found = met.numpy().astype(np.float64)
    missing = found < 0
    shares = (found / RAYS, entered.numpy() / RAYS, *(a.numpy().astype(np.float64) for a in (nearness, toward)))
    full = [np.where(missing, np.nan if k < 2 else 0.0, a).reshape(shape) for k, a in enumerate(shares)]
    return tuple(a.repeat(2, 0).repeat(2, 1)[: buffer.height, : buffer.width] for a in full)


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


def _aperture(light: Light, plan: Plan) -> float | None:
    """Full angle [rad] of a light as the fine volume's middle sees it; None for a dome."""
    if light.kind == LightKind.DOME:
        return None
    if light.kind == LightKind.DISTANT:
        return light.angle
    shape = math.pi if light.kind == LightKind.DISK else 4.0
    area = shape * float(np.linalg.norm(np.cross(light.axis_x, light.axis_y)))
    radius = plan.scale * max(light.radius, math.sqrt(area / math.pi))
    middle = np.asarray(plan.fine.low) + 0.5 * plan.fine.edge
    distance = float(np.linalg.norm((np.asarray(light.position) - np.asarray(plan.origin)) * plan.scale - middle))
    return 2.0 * math.atan2(radius, distance)


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

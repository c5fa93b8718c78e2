"""Delta voxel cone tracing (Franke 2014): relight a real scene by the light that synthetic objects change.

What it costs: one ray per pixel, RSM rays about as many as occupied voxels, and a sparse gather; independent of the
triangle count once voxelised. Where it is wrong: light that a glossy surface focuses onto others is blurred, and from
the second bounce on spread as if the surface were diffuse; detail of the indirect light below a voxel or below the
gather's spacing is blurred; glossy reflections show the voxels' radiosity; what lies beyond the coarse volume reflects
nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kept import Kept, content_key
from warp_dvct.kernels import cones, radiosity, specular
from warp_dvct.kernels.volume import Volume
from warp_dvct.launch import Launcher
from warp_dvct.layers import Radiance
from warp_dvct.passes.bounces import mean_albedo, reinject, solve_bounces
from warp_dvct.passes.environment import build_environment
from warp_dvct.passes.gather import (
    HIDDEN,
    REAL_PARTS,
    Gatherer,
    SparseGather,
    Turns,
    focusing_materials,
    gather_all,
    glossy_hits,
    keep_rays,
    rays_of,
    shade_indirect,
    strides,
)
from warp_dvct.passes.gbuffer import GBuffer, new_view, render_gbuffer
from warp_dvct.passes.injection import empty_flux, inject
from warp_dvct.passes.lobe_smoothing import Smoothing, lobe_grid
from warp_dvct.passes.patches import bounce_field, choose_patches
from warp_dvct.passes.pyramid import build_pyramid, light_faces
from warp_dvct.passes.resolve import resolve
from warp_dvct.passes.rsm import render_real, render_rsm
from warp_dvct.passes.shading import direct_settings, shade_direct, shade_direct_beside
from warp_dvct.passes.specular import find_glossy, shade_specular
from warp_dvct.passes.voxels import Voxels, cut_triangles, part, voxelize
from warp_dvct.plan import Plan
from warp_dvct.scene import LightKind, Role, Scene

MOST_KEPT_RAYS = 2**24  # 8 bytes each
MAX_RECORDS = 2**31 - 1  # no volume has more: level 0 alone


@dataclass(frozen=True)
class LightField:
    """The lit volumes, which depend on geometry and lights but not on the camera.

    Attributes:
        world: ``kernels.radiosity.World``, as gathering kernels take it.
        volumes: The voxels behind it, fine first; empty where the plan needs none.
        bounces: ``BounceField``, the irradiance of second and further bounces.
    """

    world: Any
    volumes: tuple[Voxels, ...]
    bounces: Any


def light_volumes(
    launcher: Launcher, scene: Scene, device_scene: DeviceScene, plan: Plan, kept: Kept | None = None
) -> LightField:
    """Voxelise, inject every light's RSM pair, re-inject further bounces, filter (Franke 2014, section 3.2).

    Args:
        kept: Holds what the real scene alone decides from frame to frame.
    """
    kept = kept or Kept()
    settings = plan.settings
    needed = {p.name: p.needed for p in plan.passes}
    normals = launcher.array(_normals(device_scene.triangles_vs), wp.vec3)
    volumes: list[Voxels] = []
    if needed["voxelize"]:
        with launcher.scope("voxelize"):
            volumes = _voxelize(launcher, device_scene, normals, plan, needed["pyramid"], kept)
    world = _world(launcher, scene, normals, volumes)
    if not volumes:
        return LightField(world, tuple(volumes), bounce_field(launcher, None))
    fluxes = [empty_flux(launcher, v) for v in volumes]
    for voxels, flux in zip(volumes, fluxes, strict=True):
        if settings.bounces > 0:
            _inject_lights(launcher, scene, device_scene, plan, voxels, flux, kept)
        with launcher.scope("light faces"):
            light_faces(launcher, voxels, flux, filter=settings.cones_filter)
    bounces = bounce_field(launcher, None)
    if settings.bounces > 1:
        with launcher.scope("bounces"):
            bounces = _bounce(launcher, device_scene, normals, world, volumes, fluxes, plan, kept)
    if needed["pyramid"]:
        with launcher.scope("pyramid"):
            for voxels in volumes:
                build_pyramid(launcher, voxels, filter=settings.cones_filter)
    return LightField(world, tuple(volumes), bounces)


def render(
    launcher: Launcher,
    scene: Scene,
    device_scene: DeviceScene,
    lit: Callable[[], LightField],
    plan: Plan,
    *,
    with_before: bool,
    kept: Kept | None = None,
    turns: Turns | None = None,
) -> Radiance:
    """Shade what the camera sees (Franke 2014, section 3.3): direct, indirect diffuse, indirect specular, resolve.

    Args:
        lit: Gives the lit volumes. Shadow rays need none of them, so cores that this leaves idle trace those.
        with_before: Also render the real scene alone, to serve as the plate.
        kept: Holds what the real scene and the camera alone decide from frame to frame.
        turns: Decide how many rays are gathered instead of the plan's settings.
    """
    settings = plan.settings
    with launcher.scope("gbuffer"):
        view = None
        if kept is not None:
            key = content_key(scene.camera, plan.width, plan.height)
            view = kept.get(
                "camera's real hits",
                key,
                lambda: new_view(launcher, device_scene, plan.width, plan.height, settings.antialias),
            )
        buffer = render_gbuffer(
            launcher,
            device_scene,
            plan.width,
            plan.height,
            edge_samples=settings.antialias,
            behind=with_before,
            paint=with_before or not scene.captured,
            seed=settings.seed,
            view=view,
        )
    shaded = plan.changes or with_before
    # The direct pass writes every point.
    light = (launcher.empty if shaded else launcher.zeros)(buffer.count, wp.vec3)
    before = launcher.zeros(buffer.count if with_before else 1, wp.vec3)
    hidden_before = launcher.zeros(max(1, buffer.behind_count), wp.vec3)
    parts = []
    if shaded:
        parts.append(_Part(buffer.points, buffer.count, light, before, with_before))
        if with_before:
            spare = launcher.zeros(max(1, buffer.behind_count), wp.vec3)
            parts.append(_Part(buffer.behind, buffer.behind_count, spare, hidden_before, True))
    light_field = _shade_direct(launcher, device_scene, plan, lit, parts)
    world = light_field.world
    if shaded:
        rays = _kept_rays(launcher, scene, plan, kept) if _has_indirect(scene, plan) else ()
        hits = glossy_hits(launcher, scene, device_scene, light_field.bounces, settings.seed)
        for part in parts:
            if _has_indirect(scene, plan):
                with launcher.scope("gather"):
                    irradiance = _irradiance(launcher, device_scene, plan, world, hits, buffer, part, rays, turns)
                    shade_indirect(
                        launcher,
                        part.points,
                        part.count,
                        irradiance,
                        alpha_max=plan.alpha_max,
                        light=part.light,
                        before=part.before,
                        with_before=part.with_before,
                    )
            if plan.glossy:
                with launcher.scope("specular"):
                    _shade_specular(launcher, scene, device_scene, plan, light_field, buffer, part)
    with launcher.scope("resolve"):
        return resolve(
            launcher,
            device_scene,
            buffer,
            world.env,
            light=light,
            before=before,
            behind_before=hidden_before,
            with_before=with_before,
        )


@dataclass(frozen=True)
class _Part:
    """Points to shade and where their light goes: what is seen, or the real surfaces behind synthetic ones."""

    points: Any
    count: int
    light: Any
    before: Any
    with_before: bool


def _normals(triangles: np.ndarray) -> np.ndarray:
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]).astype(np.float64)
    length = np.linalg.norm(cross, axis=-1, keepdims=True)
    return np.where(length > 0, cross / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0]).astype(np.float32)


def _voxelize(
    launcher: Launcher, scene: DeviceScene, normals: Any, plan: Plan, all_levels: bool, kept: Kept
) -> list[Voxels]:
    """The fine volume, and the coarse one where there is one; levels as far up as something reads them."""
    corners = launcher.array(scene.triangles_vs.reshape(-1, 3), wp.vec3)
    boxes = [box for box in (plan.fine, plan.coarse) if box is not None]
    volumes = []
    for box in boxes:
        real = kept.get(
            f"real fragments, {'fine' if box is plan.fine else 'coarse'} volume",
            box,
            lambda box=box: cut_triangles(launcher, part(launcher, corners, 0, 3 * scene.synthetic_first), box),
        )
        # Rays read level 0 alone, and patches (of the last volume) the first level that is coarse enough for them.
        most = max(1, plan.settings.patches_count // 2) if box is boxes[-1] else MAX_RECORDS
        volumes.append(
            voxelize(
                launcher,
                corners,
                normals,
                scene.geometry.double_sided,
                scene.synthetic_first,
                box,
                most=0 if all_levels else most,
                real=real,
            )
        )
    return volumes


def _world(launcher: Launcher, scene: Scene, normals: Any, volumes: list[Voxels]) -> Any:
    world = radiosity.World()
    world.fine = volumes[0].volume if volumes else _no_volume(launcher)
    world.has_coarse = int(len(volumes) > 1)
    world.coarse = volumes[1].volume if len(volumes) > 1 else world.fine
    world.env = build_environment(launcher, scene.lights)
    world.normals = normals
    return world


def _no_volume(launcher: Launcher) -> Any:
    """A volume of one empty voxel, for kernels that take one and will find nothing in it."""
    volume = Volume()
    volume.low, volume.voxel, volume.n, volume.levels, volume.records = wp.vec3(0.0, 0.0, 0.0), 1.0, 1, 1, 1
    volume.table_start = launcher.zeros(1, wp.int32)
    volume.tables = launcher.full(1, -1, wp.int32)
    volume.cells = launcher.full(1, -1, wp.int32)
    volume.field = launcher.zeros(1, wp.vec4)
    return volume


def _inject_lights(
    launcher: Launcher, scene: Scene, device_scene: DeviceScene, plan: Plan, voxels: Voxels, flux: Any, kept: Kept
) -> None:
    box = voxels.box
    middle = (box.low[0] + 0.5 * box.edge, box.low[1] + 0.5 * box.edge, box.low[2] + 0.5 * box.edge)
    fine = box is plan.fine
    for entry in plan.maps:
        size = entry.size if fine else entry.coarse_size
        target = {"center": middle, "radius": box.edge * math.sqrt(3.0) / 2.0, "start": plan.start + box.edge}
        target["seed"] = plan.settings.seed
        with launcher.scope("rsm"):
            real = kept.get(
                f"real map of light {entry.light}, {'fine' if fine else 'coarse'} volume",
                (kept.light_key(scene, entry.light), size, *target.values()),
                lambda entry=entry, size=size, target=target: render_real(
                    launcher, device_scene, entry.light, size, **target
                ),
            )
            maps = render_rsm(launcher, device_scene, entry.light, size, **target, real=real)
        with launcher.scope("inject"):
            inject(launcher, voxels, maps, flux)


def _bounce(
    launcher: Launcher,
    scene: DeviceScene,
    normals: Any,
    world: Any,
    volumes: list[Voxels],
    fluxes: list[Any],
    plan: Plan,
    kept: Kept,
) -> Any:
    settings = plan.settings
    patches = choose_patches(launcher, scene, volumes[-1], normals, settings.patches_count)
    total = solve_bounces(
        launcher,
        scene,
        world,
        patches,
        bounces=settings.bounces - 1,
        rays=settings.patches_rays,
        seed=settings.seed,
        kept=kept,
    )
    for voxels, flux in zip(volumes, fluxes, strict=True):
        albedo = mean_albedo(launcher, scene, voxels, normals)
        reinject(launcher, scene, normals, voxels, albedo, flux, patches, total)
        light_faces(launcher, voxels, flux, filter=settings.cones_filter)
    return bounce_field(launcher, patches, total)


def _has_indirect(scene: Scene, plan: Plan) -> bool:
    return plan.settings.bounces > 0 or any(light.kind == LightKind.DOME for light in scene.lights)


def _cone(plan: Plan, aperture: float = 0.0) -> Any:
    settings = plan.settings
    cone = cones.ConeSettings()
    cone.aperture = aperture
    cone.step = settings.cones_step
    cone.start = settings.cones_start
    cone.reach = 4.0 * (plan.coarse.edge if plan.coarse else plan.fine.edge)
    cone.additive = int(settings.cones_coverage == "additive")
    cone.detail = settings.cones_detail
    cone.escape = int(settings.cones_escape == "ray")
    cone.split = cones.DUAL if settings.cones_delta == "dual" else cones.SPLIT
    return cone


def _shade_direct(
    launcher: Launcher, device_scene: DeviceScene, plan: Plan, lit: Callable[[], LightField], parts: list[_Part]
) -> LightField:
    """Write the direct light of the parts, and light the volumes."""
    settings = plan.settings
    rays = settings.glossy_rays if plan.glossy and settings.glossy == "rays" else 0

    def how(part: _Part) -> dict[str, Any]:
        direct = direct_settings(plan, glossy_rays=rays, with_before=part.with_before)
        return {"direct": direct, "light": part.light, "before": part.before}

    if settings.shadows == "cone":
        light_field = lit()
        cone = _cone(plan)
        cone.split = cones.DUAL  # a shadow needs both occupancies
        with launcher.scope("direct"):
            for part in parts:
                world = light_field.world
                shade_direct(launcher, device_scene, part.points, part.count, **how(part), world=world, cone=cone)
        return light_field
    with launcher.scope("direct"), ExitStack() as beside:
        for part in parts:
            beside.enter_context(shade_direct_beside(launcher, device_scene, part.points, part.count, **how(part)))
        return lit()


def _kept_rays(launcher: Launcher, scene: Scene, plan: Plan, kept: Kept | None) -> tuple[Any, ...]:
    """What the rays gathered at real surfaces met in the real scene, at each stride; nothing where that is not kept."""
    settings = plan.settings
    if kept is None or settings.gather == "cones":
        return ()
    grids = []
    for level, stride in enumerate(strides(settings.gather_stride, settings.gather_detail)):
        rays = rays_of(REAL_PARTS[min(level, 1)], settings.gather_rays)
        grids.append((-(-plan.width // stride), -(-plan.height // stride), rays))
    while grids and sum(columns * rows * rays for columns, rows, rays in grids) > MOST_KEPT_RAYS:
        grids.pop()
    key = content_key(scene.camera, tuple(grids), settings.gather_stride, settings.seed)
    return kept.get("gathered real hits", key, lambda: tuple(keep_rays(launcher, *grid) for grid in grids))


def _irradiance(
    launcher: Launcher,
    scene: DeviceScene,
    plan: Plan,
    world: Any,
    hits: Any,
    buffer: GBuffer,
    part: _Part,
    rays: tuple[Any, ...],
    turns: Turns | None,
) -> tuple[Any, Any]:
    """Irradiance before and after at the part's points: sparse for what is seen, everywhere for what is hidden."""
    settings = plan.settings
    cone = None
    if settings.gather == "cones":
        cone = _cone(plan, math.radians(settings.cones_aperture))
    shared = settings.seed, settings.cones_count, cone, part.with_before, hits, max(1, settings.antialias)
    aimed = 0.0 if part.with_before else settings.gather_aimed
    real = Gatherer(scene, world, settings.gather_rays, *shared, aimed, turns)
    if part.points is not buffer.points:
        even = Gatherer(scene, world, settings.gather_rays, *shared, turns=turns)
        return gather_all(launcher, part.points, part.count, even, part=HIDDEN)
    synthetic = Gatherer(scene, world, settings.gather_object_rays, *shared, turns=turns)
    irradiance = launcher.empty(part.count, wp.vec3), launcher.empty(part.count, wp.vec3)
    how = {
        "radius": settings.gather_radius,
        "smoothing": settings.gather_smoothing,
        "detail": settings.gather_detail,
    }
    change = 0.0 if part.with_before else settings.gather_change
    room = SparseGather(launcher, buffer, Role.REAL, real, settings.gather_stride, change=change, kept=rays, **how)
    if scene.synthetic is None:
        room.write(room.blocks(), irradiance)
        return irradiance
    objects = SparseGather(launcher, buffer, Role.SYNTHETIC, synthetic, settings.gather_object_stride, **how)
    if turns is not None or cone is not None:
        # Turns settle their rays by what is left of a time: the larger part can make up for more, so it comes last.
        objects.write(objects.blocks(), irradiance)
        room.write(room.blocks(), irradiance)
        return irradiance
    blocks = room.blocks()
    with ExitStack() as beside:  # the rest of the room is many short launches
        other_blocks = objects.blocks(beside)
        room.write(blocks, irradiance)
    objects.write(other_blocks, irradiance)
    return irradiance


def _shade_specular(
    launcher: Launcher,
    scene: Scene,
    device_scene: DeviceScene,
    plan: Plan,
    light_field: LightField,
    buffer: GBuffer,
    part: _Part,
) -> None:
    settings = plan.settings
    rank, index, count = find_glossy(launcher, part.points, part.count, plan.alpha_max)
    size = (buffer.width, buffer.height) if part.points is buffer.points else (0, 0)
    glossy = specular.Glossy()
    glossy.rays = settings.glossy_rays
    glossy.edge_samples = max(1, settings.antialias)
    glossy.light_samples = settings.shadows_samples
    glossy.seed = settings.seed
    glossy.alpha_max = plan.alpha_max
    glossy.again = int(settings.bounces > 1)
    cone = _cone(plan) if settings.glossy == "cones" else None
    shade_specular(
        launcher,
        device_scene,
        part.points,
        index,
        count,
        light_field.world,
        light_field.bounces,
        launcher.array(focusing_materials(scene), wp.int32),
        glossy=glossy,
        cone=cone,
        light=part.light,
        before=part.before,
        with_before=part.with_before,
        smoothing=Smoothing(lobe_grid(rank, *size), settings.glossy_smoothing),
    )

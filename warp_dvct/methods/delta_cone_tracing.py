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
from functools import partial
from typing import Any

import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kept import Kept, content_key
from warp_dvct.kernels import cones, specular
from warp_dvct.launch import Launcher
from warp_dvct.layers import Radiance
from warp_dvct.methods.light_field import LightField
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
    real_alone,
    shade_indirect,
    strides,
)
from warp_dvct.passes.gbuffer import GBuffer, new_view, render_gbuffer
from warp_dvct.passes.lobe_smoothing import Smoothing, lobe_grid
from warp_dvct.passes.resolve import resolve
from warp_dvct.passes.shading import direct_settings, shade_direct, shade_direct_beside
from warp_dvct.passes.specular import find_glossy, shade_specular
from warp_dvct.plan import Plan
from warp_dvct.scene import LightKind, Role, Scene

MOST_KEPT_RAYS = 2**24  # 8 bytes each, 16 while nothing but lights moves
REAL_HITS, ALL_HITS = "gathered real hits", "all gathered hits"


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
        kept: Holds what the real scene and the camera alone decide from frame to frame, and what no light does.
        turns: Decide how many rays are gathered instead of the plan's settings.
    """
    settings = plan.settings
    with launcher.scope("gbuffer"):
        buffer = _look(launcher, scene, device_scene, plan, with_before, kept)
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


def _look(
    launcher: Launcher, scene: Scene, device_scene: DeviceScene, plan: Plan, with_before: bool, kept: Kept | None
) -> GBuffer:
    """What the camera sees: the last frame's if no surface moved, else the last frame's of the real scene."""
    width, height, edge_samples = plan.width, plan.height, plan.settings.antialias
    how = {
        "edge_samples": edge_samples,
        "behind": with_before,
        "paint": with_before or not scene.captured,
        "seed": plan.settings.seed,
    }
    make = partial(render_gbuffer, launcher, device_scene, width, height, **how)
    if kept is None:
        return make()
    key = content_key(scene.camera, width, height)
    view = kept.get("camera's real hits", key, lambda: new_view(launcher, device_scene, width, height, edge_samples))
    return kept.get("all that the camera sees", (key, kept.objects, *how.values()), lambda: make(view=view))


@dataclass(frozen=True)
class _Part:
    """Points to shade and where their light goes: what is seen, or the real surfaces behind synthetic ones."""

    points: Any
    count: int
    light: Any
    before: Any
    with_before: bool


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
    """What the rays gathered at real surfaces met, at each stride; nothing where that is not kept."""
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
    real = kept.get(REAL_HITS, key, lambda: tuple(keep_rays(launcher, *grid) for grid in grids))
    # Objects that stayed since the last frame are likely to stay until the next: that frame makes room for them.
    still = (key, kept.objects)
    whole = kept.last(ALL_HITS, still)
    if whole is None:
        kept.put(ALL_HITS, still, ())
        return real
    if not whole:
        whole = tuple(keep_rays(launcher, *grid, whole=True) for grid in grids)
        kept.put(ALL_HITS, still, whole)
        kept.put(REAL_HITS, key, tuple(real_alone(rays) for rays in whole))
    return whole


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

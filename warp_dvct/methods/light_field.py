"""The lit volumes of delta voxel cone tracing (Franke 2014, section 3.2): what surfaces radiate, before and after."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kept import Kept, content_key
from warp_dvct.kernels import radiosity
from warp_dvct.kernels.volume import Volume
from warp_dvct.launch import Launcher
from warp_dvct.passes.bounces import mean_albedo, reinject, solve_bounces
from warp_dvct.passes.environment import build_environment
from warp_dvct.passes.injection import empty_flux, inject
from warp_dvct.passes.patches import bounce_field, choose_patches
from warp_dvct.passes.pyramid import build_pyramid, light_faces
from warp_dvct.passes.rsm import render_real, render_rsm
from warp_dvct.passes.voxels import Voxels, cut_triangles, part, unlit, voxelize
from warp_dvct.plan import Plan
from warp_dvct.scene import Scene

MAX_RECORDS = 2**31 - 1  # no volume has more: level 0 alone
VOLUMES = ("fine", "coarse")


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
        kept: Holds what the real scene alone decides from frame to frame, and what no light does.
    """
    kept = kept or Kept()
    settings = plan.settings
    needed = {p.name: p.needed for p in plan.passes}
    normals = kept.get(
        "all normals", kept.objects, lambda: launcher.array(unit_normals(device_scene.triangles_vs), wp.vec3)
    )
    surfaces = content_key(kept.objects, device_scene.double_sided)  # which sides show depends on the lights
    dark: list[Voxels] = []
    volumes: list[Voxels] = []
    if needed["voxelize"]:
        with launcher.scope("voxelize"):
            dark = _voxelize(launcher, device_scene, normals, plan, needed["pyramid"], kept, surfaces)
            volumes = [unlit(launcher, v) for v in dark]
    world = world_of(launcher, scene, normals, volumes)
    if not volumes:
        return LightField(world, tuple(volumes), bounce_field(launcher, None))
    fluxes = [empty_flux(launcher, v) for v in volumes]
    for voxels, flux, which in zip(volumes, fluxes, VOLUMES, strict=False):
        if settings.bounces > 0:
            _inject_lights(launcher, scene, device_scene, plan, which, voxels, flux, kept)
        with launcher.scope("light faces"):
            light_faces(launcher, voxels, flux, filter=settings.cones_filter)
    bounces = bounce_field(launcher, None)
    if settings.bounces > 1:
        with launcher.scope("bounces"):
            bounces = _bounce(launcher, device_scene, world, dark, volumes, fluxes, plan, kept, surfaces)
    if needed["pyramid"]:
        with launcher.scope("pyramid"):
            for voxels in volumes:
                build_pyramid(launcher, voxels, filter=settings.cones_filter)
    return LightField(world, tuple(volumes), bounces)


def unit_normals(triangles: np.ndarray) -> np.ndarray:
    """Geometric normals of triangles ``[t, 3, 3]``, float32 ``[t, 3]``; those without area get +z."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]).astype(np.float64)
    length = np.linalg.norm(cross, axis=-1, keepdims=True)
    return np.where(length > 0, cross / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0]).astype(np.float32)


def _voxelize(
    launcher: Launcher, scene: DeviceScene, normals: Any, plan: Plan, all_levels: bool, kept: Kept, surfaces: str
) -> list[Voxels]:
    """The fine volume, and the coarse one where there is one; levels as far up as something reads them."""
    corners = launcher.array(scene.triangles_vs.reshape(-1, 3), wp.vec3)
    boxes = [box for box in (plan.fine, plan.coarse) if box is not None]
    volumes = []
    for box, which in zip(boxes, VOLUMES, strict=False):
        real = kept.get(
            f"real fragments, {which} volume",
            box,
            lambda box=box: cut_triangles(launcher, part(launcher, corners, 0, 3 * scene.synthetic_first), box),
        )
        # Rays read level 0 alone, and patches (of the last volume) the first level that is coarse enough for them.
        most = max(1, plan.settings.patches_count // 2) if box is boxes[-1] else MAX_RECORDS
        most = 0 if all_levels else most
        surface = corners, normals, scene.geometry.double_sided, scene.synthetic_first
        make = partial(voxelize, launcher, *surface, box, most=most, real=real)
        volumes.append(kept.get(f"all voxels, {which} volume", (surfaces, box, most), make))
    return volumes


def world_of(launcher: Launcher, scene: Scene, normals: Any, volumes: list[Voxels]) -> Any:
    """``kernels.radiosity.World`` of volumes, fine first, and of the scene's domes."""
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
    launcher: Launcher,
    scene: Scene,
    device_scene: DeviceScene,
    plan: Plan,
    which: str,
    voxels: Voxels,
    flux: Any,
    kept: Kept,
) -> None:
    box = voxels.box
    middle = (box.low[0] + 0.5 * box.edge, box.low[1] + 0.5 * box.edge, box.low[2] + 0.5 * box.edge)
    for entry in plan.maps:
        size = entry.size if which == "fine" else entry.coarse_size
        target = {"center": middle, "radius": box.edge * math.sqrt(3.0) / 2.0, "start": plan.start + box.edge}
        target["seed"] = plan.settings.seed
        with launcher.scope("rsm"):
            real = kept.get(
                f"real map of light {entry.light}, {which} volume",
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
    world: Any,
    dark: list[Voxels],
    volumes: list[Voxels],
    fluxes: list[Any],
    plan: Plan,
    kept: Kept,
    surfaces: str,
) -> Any:
    """Solve second and further bounces on patches of the last volume and add them to all (``BounceField``).

    Args:
        surfaces: Key of all surfaces and of which of their sides show.
        dark: The volumes without their fields, to which nothing kept may hold on.
    """
    settings, normals = plan.settings, world.normals
    patches = kept.get(
        "all patches",
        (surfaces, dark[-1].box, dark[-1].level_records, settings.patches_count),
        lambda: choose_patches(launcher, scene, dark[-1], normals, settings.patches_count),
    )
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
    for voxels, flux, which in zip(volumes, fluxes, VOLUMES, strict=False):
        albedo = kept.get(
            f"all albedos, {which} volume",
            (surfaces, voxels.box),
            lambda voxels=voxels: mean_albedo(launcher, scene, voxels, normals),
        )
        reinject(launcher, scene, normals, voxels, albedo, flux, patches, total)
        light_faces(launcher, voxels, flux, filter=settings.cones_filter)
    return bounce_field(launcher, patches, total)

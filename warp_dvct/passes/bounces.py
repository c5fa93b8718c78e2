"""Second and further bounces: a radiosity solution on patches, re-injected into the volumes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kept import Kept
from warp_dvct.kernels import bounces as kernels
from warp_dvct.kernels import patches as patch_kernels
from warp_dvct.kernels.bounce_field import BounceField
from warp_dvct.kernels.sorting import EMPTY_KEY
from warp_dvct.kernels.volume import Volume
from warp_dvct.launch import Launcher
from warp_dvct.passes.sorting import count_below, sort_by_key, unique_runs
from warp_dvct.passes.voxels import Voxels

BURIED = 0.5  # voxels of level 0: a patch that something covers within that distance stands for little but itself
PATCH_HITS = "patches' real hits"


@dataclass(frozen=True)
class Patches:
    """One surface patch behind each occupied face of the voxels of a level.

    Attributes:
        voxels: The volume they were taken from. level, level_first: Its level, and that level's first record.
        data: ``kernels.patches.Patches``. count: How many.
        table: int ``[records of the level * 6]``, patch of a face or -1.
        walls: vec4 ``[records of the level]``, planes of thin walls or 0. has_walls: Whether there are any.
        patch_walls: vec4 ``[count]``, of the walls beside patches.
    """

    voxels: Voxels
    level: int
    level_first: int
    data: Any
    count: int
    table: Any
    walls: Any
    has_walls: bool
    patch_walls: Any


def mean_albedo(launcher: Launcher, scene: DeviceScene, voxels: Voxels, normals: Any) -> Any:
    """Area-weighted hemispherical albedo per level-0 record, before and after: vec3 ``[records * 2]``."""
    pieces = voxels.fragments
    records = voxels.level_records[0]
    albedo = launcher.zeros(max(1, records * 2), wp.vec3)
    launcher.launch(
        kernels._mean_albedo,
        records,
        [
            scene.geometry,
            scene.materials,
            normals,
            pieces.record_start,
            pieces.order,
            pieces.triangle,
            pieces.place,
            pieces.count,
            records,
        ],
        [albedo],
    )
    return albedo


def choose_patches(launcher: Launcher, scene: DeviceScene, voxels: Voxels, normals: Any, most: int) -> Patches:
    """Patches of the finest level that has no more than about ``most`` of them."""
    level = 0
    while level + 1 < len(voxels.level_records) and 2 * voxels.level_records[level] > most:
        level += 1
    level_first = sum(voxels.level_records[:level])
    records = voxels.level_records[0]
    key = launcher.empty(max(1, 12 * records), wp.int32)
    order = launcher.empty(max(1, 12 * records), wp.int32)
    launcher.launch(
        patch_kernels._face_keys,
        6 * records,
        [voxels.level_keys[0], voxels.area, voxels.volume, level, level_first, int(EMPTY_KEY)],
        [key],
    )
    sort_by_key(launcher, key, order, 6 * records)
    keys, starts = unique_runs(launcher, key, 6 * records)
    count = keys.shape[0]
    data = patch_kernels.Patches()
    data.position, data.normal, data.albedo = (launcher.zeros(max(1, count), wp.vec3) for _ in range(3))
    data.reach, data.area = (launcher.zeros(max(1, count), wp.float32) for _ in range(2))
    data.real = launcher.zeros(max(1, count), wp.int32)
    data.place = launcher.zeros(max(1, count), wp.int64)
    table = launcher.full(max(1, 6 * voxels.level_records[level]), -1, wp.int32)
    launcher.launch(
        patch_kernels._choose_patches,
        count,
        [
            scene.geometry,
            scene.materials,
            normals,
            keys,
            voxels.level_keys[level],
            starts,
            order,
            count_below(launcher, key, 6 * records),
            count,
            voxels.area,
            float(4**level),
            _fragments(voxels),
            BURIED * voxels.box.voxel,
        ],
        [data, table],
    )
    walls = launcher.zeros(max(1, voxels.level_records[level]), wp.vec4)
    found = launcher.zeros(max(1, voxels.level_records[level]), wp.int32)
    launcher.launch(
        patch_kernels._find_walls,
        voxels.level_records[level],
        [voxels.volume, level, level_first, voxels.level_keys[level], data, table],
        [walls, found],
    )
    beside = launcher.zeros(max(1, count), wp.vec4)
    patches = Patches(voxels, level, level_first, data, count, table, walls, bool(found.numpy().any()), beside)
    if patches.has_walls:
        launcher.launch(
            patch_kernels._wall_of_patches, count, [data, bounce_field(launcher, patches, data.position)], [beside]
        )
    return patches


def _fragments(voxels: Voxels) -> Any:
    """``kernels.patches.Fragments`` of a volume."""
    pieces, out = voxels.fragments, patch_kernels.Fragments()
    out.count, out.records = pieces.count, voxels.level_records[0]
    out.record_start, out.order, out.triangle, out.place = (
        pieces.record_start,
        pieces.order,
        pieces.triangle,
        pieces.place,
    )
    return out


def solve_bounces(
    launcher: Launcher,
    scene: DeviceScene,
    world: Any,
    patches: Patches,
    *,
    bounces: int,
    rays: int,
    seed: int = 0,
    kept: Kept | None = None,
) -> Any:
    """Irradiance of patches from bounces 1 … ``bounces``, before and after: vec3 ``[patches * 2]``.

    Args:
        world: ``kernels.radiosity.World`` whose volumes hold directly lit radiosity.
        rays: Cosine-distributed rays per patch; they are traced once.
        kept: Holds what these rays met in the real scene from frame to frame, patch by patch.
    """
    count = patches.count
    kept = kept or Kept()
    key = (patches.voxels.box, patches.level, rays, seed)
    hits = _patch_hits(launcher, patches, rays)
    links = launcher.empty(max(1, count * rays), wp.vec2i)
    last = launcher.zeros(max(1, 2 * count), wp.vec3)
    launcher.launch(
        kernels._link_patches,
        count,
        [
            scene.geometry,
            world,
            patches.data,
            bounce_field(launcher, patches, last),
            kept.last(PATCH_HITS, key) or kernels.PatchHits(),
            rays,
            seed,
        ],
        [links, last, hits.distance, hits.triangle],
    )
    kept.put(PATCH_HITS, key, hits)
    total = launcher.empty(max(1, 2 * count), wp.vec3)
    wp.copy(total, last)
    following = launcher.zeros(max(1, 2 * count), wp.vec3)
    for _ in range(bounces - 1):
        launcher.launch(kernels._bounce, count, [patches.data, links, rays, last], [following, total])
        last, following = following, last
    return total


def _patch_hits(launcher: Launcher, patches: Patches, rays: int) -> Any:
    """``PatchHits`` of patches, still to be filled."""
    hits, data = kernels.PatchHits(), patches.data
    hits.count = patches.count
    hits.place, hits.position, hits.normal, hits.reach = data.place, data.position, data.normal, data.reach
    hits.distance = launcher.empty(max(1, patches.count * rays), wp.float32)
    hits.triangle = launcher.empty(max(1, patches.count * rays), wp.int32)
    return hits


def bounce_field(launcher: Launcher, patches: Patches | None, total: Any = None) -> Any:
    """``BounceField`` of solved patches, or one that says that there are none."""
    field = BounceField()
    field.present = int(patches is not None)
    if patches is None:
        field.volume = Volume()
        field.table, field.real = launcher.zeros(1, wp.int32), launcher.zeros(1, wp.int32)
        field.position, field.irradiance = launcher.zeros(1, wp.vec3), launcher.zeros(1, wp.vec3)
        field.walls, field.patch_walls = launcher.zeros(1, wp.vec4), launcher.zeros(1, wp.vec4)
        return field
    field.volume = patches.voxels.volume
    field.level, field.level_first = patches.level, patches.level_first
    field.table, field.real, field.irradiance = patches.table, patches.data.real, total
    field.position, field.walls, field.has_walls = patches.data.position, patches.walls, int(patches.has_walls)
    field.patch_walls = patches.patch_walls
    return field


def reinject(launcher: Launcher, voxels: Voxels, albedo: Any, flux: Any, field: Any) -> None:
    """Add what a volume's surfaces reflect of a ``BounceField`` to ``flux``, in place."""
    launcher.launch(
        kernels._reinject,
        voxels.level_records[0],
        [voxels.level_keys[0], voxels.volume, voxels.area, albedo, field],
        [flux],
    )

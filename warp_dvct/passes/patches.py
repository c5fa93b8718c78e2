"""Patches behind the faces of a coarse level's voxels, and what parts them: thin walls and objects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import patches as kernels
from warp_dvct.kernels import walls as wall_kernels
from warp_dvct.kernels.bounce_field import NEIGHBOURS, BounceField, Patch
from warp_dvct.kernels.sorting import EMPTY_KEY
from warp_dvct.kernels.volume import Volume
from warp_dvct.launch import Launcher
from warp_dvct.passes.sorting import count_below, scan, sort_by_key, unique_runs
from warp_dvct.passes.voxels import Voxels

BURIED = 0.5  # voxels of level 0: a patch that something covers within that distance stands for little but itself


@dataclass(frozen=True)
class Patches:
    """Surface patches behind the occupied faces of the voxels of a level: one a face and, in voxels that hold something
    synthetic or a thin wall, one a sheet: real and synthetic surfaces are apart, and so are those that do not see each
    other.

    Attributes:
        voxels: The volume they were taken from. level, level_first: Its level, and that level's first record.
        data: ``kernels.bounce_field.Patch`` ``[count]``. count: How many.
        table: int ``[records of the level * 6]``, first patch of a face or -1.
        mixed: int ``[records of the level]``, 1 where the voxel or one next to it holds something synthetic or a wall.
        beside: int ``[count * 27]``, of patches in mixed voxels: the patch in each voxel around that they see, or -1.
        walls: vec4 ``[records of the level]``, planes of thin walls or 0. has_walls: Whether there are any.
    """

    voxels: Voxels
    level: int
    level_first: int
    data: Any
    count: int
    table: Any
    mixed: Any
    beside: Any
    walls: Any
    has_walls: bool


@dataclass(frozen=True)
class _Faces:
    """The occupied faces of a level's voxels: sorted keys (record * 6 + face), and the level-0 faces in each."""

    level: int
    level_first: int
    keys: Any
    starts: Any
    order: Any
    entries: int

    @property
    def count(self) -> int:
        return self.keys.shape[0]


def choose_patches(launcher: Launcher, scene: DeviceScene, voxels: Voxels, normals: Any, most: int) -> Patches:
    """Patches of the finest level that has no more than about ``most`` of them."""
    level = 0
    while level + 1 < len(voxels.level_records) and 2 * voxels.level_records[level] > most:
        level += 1
    faces = _occupied_faces(launcher, voxels, level)
    records = voxels.level_records[level]
    grid = [voxels.volume, level, faces.level_first]
    keyed = [*grid, voxels.level_keys[level]]
    occupied = launcher.zeros(max(1, 6 * records), wp.int32)
    launcher.launch(wall_kernels._mark_occupied, faces.count, [faces.keys], [occupied])
    apart = launcher.zeros(max(1, faces.count), wp.int32)
    launcher.launch(wall_kernels._mark_opposite, faces.count, [*keyed, faces.keys, occupied], [apart])
    if scene.geometry.has_synthetic:
        entries = [faces.starts, faces.order, faces.entries, faces.count]
        launcher.launch(kernels._mark_synthetic, faces.count, [scene.geometry, *entries, fragments_of(voxels)], [apart])
    data, table, holds, count = _find_patches(launcher, scene, voxels, normals, faces, apart)
    walls = launcher.zeros(max(1, records), wp.vec4)
    found = launcher.zeros(max(1, records), wp.int32)
    launcher.launch(wall_kernels._find_walls, records, [*keyed, data, table], [walls, found])
    has_walls = bool(found.numpy().any())
    mixed = launcher.zeros(max(1, records), wp.int32)
    launcher.launch(kernels._mark_mixed, records, [*keyed, holds], [mixed])
    beside = launcher.empty(max(1, NEIGHBOURS * count), wp.int32)
    launcher.launch(kernels._find_neighbours, count, [scene.geometry, *grid, data, table, mixed], [beside])
    patches = Patches(voxels, level, faces.level_first, data, count, table, mixed, beside, walls, has_walls)
    if has_walls:
        launcher.launch(
            wall_kernels._wall_of_patches, count, [bounce_field(launcher, patches, launcher.zeros(1, wp.vec3))], [data]
        )
    return patches


def _occupied_faces(launcher: Launcher, voxels: Voxels, level: int) -> _Faces:
    level_first = sum(voxels.level_records[:level])
    records = voxels.level_records[0]
    key = launcher.empty(max(1, 12 * records), wp.int32)
    order = launcher.empty(max(1, 12 * records), wp.int32)
    launcher.launch(
        kernels._face_keys,
        6 * records,
        [voxels.level_keys[0], voxels.area, voxels.volume, level, level_first, int(EMPTY_KEY)],
        [key],
    )
    sort_by_key(launcher, key, order, 6 * records)
    keys, starts = unique_runs(launcher, key, 6 * records)
    return _Faces(level, level_first, keys, starts, order, count_below(launcher, key, 6 * records))


def _find_patches(
    launcher: Launcher, scene: DeviceScene, voxels: Voxels, normals: Any, faces: _Faces, apart: Any
) -> tuple[Any, Any, Any, int]:
    """The patches, the table of first patches, in which voxels there is one a sheet, and the count.

    Args:
        apart: int ``[faces]``, 1 where the sheets of a face's voxel are told apart.
    """
    pieces, runs = fragments_of(voxels), faces.count
    entries = [faces.starts, faces.order, faces.entries, runs]
    sheets, places = kernels.Sheets(), max(1, int(kernels.MOST_SHEETS) * runs)
    sheets.fragment, sheets.buried = (launcher.zeros(places, wp.int32) for _ in range(2))
    sheets.eye = launcher.zeros(places, wp.vec3)
    counts = launcher.zeros(max(1, runs), wp.int32)
    records = voxels.level_records[faces.level]
    holds = launcher.zeros(max(1, records), wp.int32)
    near = BURIED * voxels.box.voxel
    lift = float(kernels.LIFT) * voxels.box.voxel * 2**faces.level
    launcher.launch(
        kernels._find_sheets,
        runs,
        [scene.geometry, normals, faces.keys, *entries, voxels.area, pieces, near, lift, apart],
        [sheets, counts, holds],
    )
    ends, count = scan(launcher, counts)
    data = launcher.zeros(max(1, count), Patch)
    table = launcher.full(max(1, 6 * records), -1, wp.int32)
    given = [scene.geometry, scene.materials, normals, faces.keys, voxels.level_keys[faces.level], *entries]
    launcher.launch(
        kernels._write_patches,
        runs,
        [*given, voxels.area, float(4**faces.level), pieces, sheets, counts, ends],
        [data, table],
    )
    return data, table, holds, count


def fragments_of(voxels: Voxels) -> Any:
    """``kernels.patches.Fragments`` of a volume."""
    pieces, out = voxels.fragments, kernels.Fragments()
    out.count, out.records = pieces.count, voxels.level_records[0]
    out.record_start, out.order, out.triangle, out.place = (
        pieces.record_start,
        pieces.order,
        pieces.triangle,
        pieces.place,
    )
    return out


def bounce_field(launcher: Launcher, patches: Patches | None, total: Any = None) -> Any:
    """``BounceField`` of solved patches, or one that says that there are none."""
    field = BounceField()
    field.present = int(patches is not None)
    if patches is None:
        field.volume = Volume()
        field.patches = launcher.zeros(1, Patch)
        field.table, field.mixed, field.beside = (launcher.zeros(1, wp.int32) for _ in range(3))
        field.walls, field.irradiance = launcher.zeros(1, wp.vec4), launcher.zeros(1, wp.vec3)
        return field
    field.volume = patches.voxels.volume
    field.level, field.level_first = patches.level, patches.level_first
    field.patches, field.table, field.irradiance = patches.data, patches.table, total
    field.mixed, field.beside = patches.mixed, patches.beside
    field.walls, field.has_walls = patches.walls, int(patches.has_walls)
    return field

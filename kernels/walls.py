"""Walls thinner than a voxel of the patches: both of their sides are in one voxel, or in two next to each other."""

import warp as wp

from warp_dvct.kernels.bounce_field import BounceField, Patch, off_surface, wall_beside
from warp_dvct.kernels.volume import Volume, brick_extent, find_record, key_cell

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

WALL_AREA = wp.constant(0.25)  # share of its voxel's face that a side of a thin wall covers
CLEARLY = wp.constant(1.05)  # how much larger a wall has to be than another of the same voxel: equal ones stay in order
THIN = wp.constant(0.25)  # thickest wall, in voxels of the patches' level
OPPOSITE = wp.constant(-0.9)  # cosine between the normals of a wall's two sides


@wp.func
def voxel_behind(volume: Volume, level: int, level_first: int, key: int, face: int) -> int:
    """The record, counted from the level's first, of the voxel next to one, on the side opposite ``face``; negative
    where that is empty."""
    cell = key_cell(key, brick_extent(volume.n, level))
    cell[face / 2] += wp.where((face & 1) == 0, -1, 1)
    return find_record(volume, level, cell[0], cell[1], cell[2]) - level_first


@wp.kernel
def _mark_occupied(first: int, face_key_in: wp.array(dtype=wp.int32), occupied_out: wp.array(dtype=wp.int32)):
    """1 for the faces that something shows on."""
    occupied_out[face_key_in[first + wp.tid()]] = 1


@wp.kernel
def _mark_opposite(
    first: int,
    volume: Volume,
    level: int,
    level_first: int,
    level_key_in: wp.array(dtype=wp.int32),
    face_key_in: wp.array(dtype=wp.int32),
    occupied_in: wp.array(dtype=wp.int32),
    apart_out: wp.array(dtype=wp.int32),
):
    """Mark the occupied faces whose voxel, or the next one behind, has something on the opposite face: a thin wall may
    hide there, behind furniture that looks the same way."""
    i = first + wp.tid()
    face = face_key_in[i] % 6
    voxel = face_key_in[i] / 6
    opposite = occupied_in[6 * voxel + (face ^ 1)]
    next = voxel_behind(volume, level, level_first, level_key_in[voxel], face)
    if next >= 0:
        opposite = wp.max(opposite, occupied_in[6 * next + (face ^ 1)])
    if opposite != 0:
        apart_out[i] = 1


@wp.func
def back_of(
    patches: wp.array(dtype=Patch), table: wp.array(dtype=wp.int32), front: int, place: int, thickness: float
) -> int:
    """The patch at ``place`` of the table that is the other side of the wall that ``front`` belongs to, no farther
    behind it than ``thickness``; -1 if there is none."""
    back = table[place]
    while back >= 0:
        behind = wp.dot(patches[front].position - patches[back].position, patches[front].normal)
        opposed = wp.dot(patches[back].normal, patches[front].normal) < OPPOSITE
        if patches[back].area >= WALL_AREA and opposed and behind >= 0.0 and behind <= thickness:
            return back
        back = patches[back].next
    return -1


@wp.kernel
def _find_walls(
    first: int,
    volume: Volume,
    level: int,
    level_first: int,
    level_key_in: wp.array(dtype=wp.int32),
    patches: wp.array(dtype=Patch),
    table_in: wp.array(dtype=wp.int32),
    wall_out: wp.array(dtype=wp.vec4),
    found_out: wp.array(dtype=wp.int32),
):
    """The plane of a wall thinner than a quarter of a voxel: a face whose opposite, in its voxel or the next one
    behind, shows a surface that looks the other way. 0 where there is none."""
    i = first + wp.tid()
    thickness = THIN * volume.voxel * float(1 << level)
    wall_out[i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    found_out[i] = 0
    most = float(WALL_AREA)
    for face in range(6):
        next = voxel_behind(volume, level, level_first, level_key_in[i], face)
        front = table_in[6 * i + face]
        while front >= 0:
            if patches[front].area > most:
                n = patches[front].normal
                offset = wp.dot(n, patches[front].position)
                back = back_of(patches, table_in, front, 6 * i + (face ^ 1), thickness)
                if back >= 0:
                    # Both sides are in this voxel: the middle is between them.
                    offset = 0.5 * (offset + wp.dot(n, patches[back].position))
                elif next >= 0:
                    back = back_of(patches, table_in, front, 6 * next + (face ^ 1), thickness)
                if back >= 0:
                    most = patches[front].area * CLEARLY
                    wall_out[i] = wp.vec4(n[0], n[1], n[2], offset)
                    found_out[i] = 1
            front = patches[front].next


@wp.kernel
def _wall_of_patches(first: int, field: BounceField, patch_out: wp.array(dtype=Patch)):
    """The thin wall beside each patch."""
    i = first + wp.tid()
    patch_out[i].wall = wall_beside(field, off_surface(field, patch_out[i].position, patch_out[i].normal))

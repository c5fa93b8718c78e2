"""Patches: the largest pieces of surface behind the faces of a coarse level's voxels, and thin walls between them."""

import warp as wp

from warp_dvct.kernels.bounce_field import BounceField, off_surface, wall_beside
from warp_dvct.kernels.geometry import (
    FAR,
    OFFSET_RELATIVE,
    Geometry,
    Hit,
    corner_position,
    largest_coordinate,
    trace_all,
)
from warp_dvct.kernels.materials import Materials, Surface, hemispherical_albedo, surface_at
from warp_dvct.kernels.volume import Volume, brick_extent, face_weight, find_record, key_cell

wp.set_module_options({"enable_backward": False})

WALL_AREA = wp.constant(0.25)  # share of its voxel's face that a side of a thin wall covers
CLEARLY = wp.constant(1.05)  # how much larger a wall has to be than another of the same voxel: equal ones stay in order
THIN = wp.constant(0.25)  # thickest wall, in voxels of the patches' level
OPPOSITE = wp.constant(-0.9)  # cosine between the normals of a wall's two sides


@wp.func
def fragment_surface(geo: Geometry, mats: Materials, triangle: int, position: wp.vec3, direction: wp.vec3) -> Surface:
    """The surface of a triangle at a point on it, seen along ``direction``."""
    a = corner_position(geo, triangle, 0)
    b = corner_position(geo, triangle, 1)
    c = corner_position(geo, triangle, 2)
    n = wp.cross(b - a, c - a)
    size = wp.max(wp.dot(n, n), 1.0e-30)
    hit = Hit()
    hit.found = 1
    hit.triangle = triangle
    hit.u = wp.clamp(wp.dot(wp.cross(c - b, position - b), n) / size, 0.0, 1.0)
    hit.v = wp.clamp(wp.dot(wp.cross(a - c, position - c), n) / size, 0.0, 1.0 - hit.u)
    hit.synthetic = wp.where(triangle >= geo.synthetic_first, 1, 0)
    return surface_at(geo, mats, hit, position - direction, direction)


@wp.kernel
def _face_keys(
    first: int,
    key_in: wp.array(dtype=wp.int32),
    area_in: wp.array(dtype=wp.vec2),
    volume: Volume,
    level: int,
    level_first: int,
    empty: int,
    key_out: wp.array(dtype=wp.int32),
):
    """For each face of a level-0 record: the face of the voxel of ``level`` that holds it."""
    i = first + wp.tid()
    cell = key_cell(key_in[i / 6], brick_extent(volume.n, 0))
    key = empty
    if area_in[i][1] > 0.0:
        record = find_record(volume, level, cell[0] >> level, cell[1] >> level, cell[2] >> level)
        key = (record - level_first) * 6 + i % 6
    key_out[i] = key


@wp.struct
class Patches:
    position: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    albedo: wp.array(dtype=wp.vec3)
    reach: wp.array(dtype=wp.float32)
    real: wp.array(dtype=wp.int32)
    area: wp.array(dtype=wp.float32)  # of all that shows on the face, over that of the face
    place: wp.array(dtype=wp.int64)  # key of the voxel * 6 + face: ascending, and the same whatever else is there


@wp.struct
class Fragments:
    """The pieces of triangles in each record of level 0."""

    count: wp.int32
    records: wp.int32
    record_start: wp.array(dtype=wp.int32)
    order: wp.array(dtype=wp.int32)
    triangle: wp.array(dtype=wp.int32)
    place: wp.array(dtype=wp.vec4)  # position and area


@wp.func
def largest_fragment(geo: Geometry, normals: wp.array(dtype=wp.vec3), pieces: Fragments, record: int, face: int) -> int:
    """The fragment of a record that shows most on a face."""
    stop = pieces.count
    if record + 1 < pieces.records:
        stop = pieces.record_start[record + 1]
    chosen = int(-1)
    most = float(-1.0)
    for j in range(pieces.record_start[record], stop):
        fragment = pieces.order[j]
        triangle = pieces.triangle[fragment]
        facing = face_weight(normals[triangle], face)
        if geo.double_sided[triangle] != 0:
            facing = wp.max(facing, face_weight(-normals[triangle], face))
        if facing * pieces.place[fragment][3] > most:
            most = facing * pieces.place[fragment][3]
            chosen = fragment
    return chosen


@wp.func
def fragment_normal(normals: wp.array(dtype=wp.vec3), triangle: int, face: int) -> wp.vec3:
    """The normal of the side that shows on a face."""
    normal = normals[triangle]
    return wp.where(face_weight(normal, face) > 0.0, normal, -normal)


@wp.func
def is_buried(
    geo: Geometry, normals: wp.array(dtype=wp.vec3), position: wp.vec3, normal: wp.vec3, reach: float, near: float
) -> bool:
    """Whether a surface point lies in an object, or so close under one that it stands for little but itself."""
    origin = position + normal * (OFFSET_RELATIVE * reach)
    hit = trace_all(geo, origin, normal, FAR)
    if hit.found == 0:
        return False
    from_behind = wp.dot(normals[hit.triangle], normal) > 0.0 and geo.double_sided[hit.triangle] == 0
    return hit.t < near or from_behind


@wp.kernel
def _choose_patches(
    first: int,
    geo: Geometry,
    mats: Materials,
    normal_in: wp.array(dtype=wp.vec3),
    face_key_in: wp.array(dtype=wp.int32),
    level_key_in: wp.array(dtype=wp.int32),
    start_in: wp.array(dtype=wp.int32),
    face_order_in: wp.array(dtype=wp.int32),
    entries: int,
    runs: int,
    area_in: wp.array(dtype=wp.vec2),
    faces: float,
    pieces: Fragments,
    near: float,
    patches_out: Patches,
    table_out: wp.array(dtype=wp.int32),
):
    """The largest fragment behind each occupied face that is not buried becomes its patch.

    A face covers ``faces`` of level 0; what something covers within ``near`` counts as buried.
    """
    i = first + wp.tid()
    end = entries
    if i + 1 < runs:
        end = start_in[i + 1]
    face = face_key_in[i] % 6
    best = int(-1)
    most = float(-1.0)
    shown = float(0.0)
    for j in range(start_in[i], end):
        area = area_in[face_order_in[j]][1]
        shown += area
        if area > most:
            fragment = largest_fragment(geo, normal_in, pieces, face_order_in[j] / 6, face)
            triangle = pieces.triangle[fragment]
            normal = fragment_normal(normal_in, triangle, face)
            place = pieces.place[fragment]
            position = wp.vec3(place[0], place[1], place[2])
            reach = wp.max(largest_coordinate(position), 1.0)
            buried = is_buried(geo, normal_in, position, normal, reach, near)
            if best < 0 or not buried:
                best = fragment
            if not buried:
                most = area
    patches_out.area[i] = shown / faces
    triangle = pieces.triangle[best]
    normal = fragment_normal(normal_in, triangle, face)
    place = pieces.place[best]
    s = fragment_surface(geo, mats, triangle, wp.vec3(place[0], place[1], place[2]), -normal)
    patches_out.position[i] = s.position
    patches_out.normal[i] = normal
    patches_out.albedo[i] = hemispherical_albedo(s)
    patches_out.reach[i] = s.reach
    patches_out.real[i] = 1 - s.synthetic
    patches_out.place[i] = wp.int64(level_key_in[face_key_in[i] / 6]) * wp.int64(6) + wp.int64(face_key_in[i] % 6)
    table_out[face_key_in[i]] = i


@wp.func
def backs(patches: Patches, table: wp.array(dtype=wp.int32), front: int, place: int, thickness: float) -> bool:
    """Whether the patch at ``place`` of the table is the other side of the wall that ``front`` belongs to, no farther
    behind it than ``thickness``."""
    back = table[place]
    if back < 0 or patches.area[back] < WALL_AREA:
        return False
    behind = wp.dot(patches.position[front] - patches.position[back], patches.normal[front])
    return behind >= 0.0 and behind <= thickness and wp.dot(patches.normal[back], patches.normal[front]) < OPPOSITE


@wp.kernel
def _find_walls(
    first: int,
    volume: Volume,
    level: int,
    level_first: int,
    level_key_in: wp.array(dtype=wp.int32),
    patches: Patches,
    table_in: wp.array(dtype=wp.int32),
    wall_out: wp.array(dtype=wp.vec4),
    found_out: wp.array(dtype=wp.int32),
):
    """The plane of a wall thinner than a quarter of a voxel: a face whose opposite, in its voxel or the next one
    behind, shows a surface that looks the other way. 0 where there is none."""
    i = first + wp.tid()
    thickness = THIN * volume.voxel * float(1 << level)
    cell = key_cell(level_key_in[i], brick_extent(volume.n, level))
    wall_out[i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    found_out[i] = 0
    most = float(WALL_AREA)
    for face in range(6):
        front = table_in[6 * i + face]
        if front >= 0 and patches.area[front] > most:
            opposite = face ^ 1
            step = wp.vec3i(0, 0, 0)
            step[face / 2] = wp.where((face & 1) == 0, -1, 1)
            next = find_record(volume, level, cell[0] + step[0], cell[1] + step[1], cell[2] + step[2]) - level_first
            offset = wp.dot(patches.normal[front], patches.position[front])
            found = False
            if backs(patches, table_in, front, 6 * i + opposite, thickness):
                # Both sides are in this voxel: the middle is between them.
                back = table_in[6 * i + opposite]
                offset = 0.5 * (offset + wp.dot(patches.normal[front], patches.position[back]))
                found = True
            elif next >= 0:
                found = backs(patches, table_in, front, 6 * next + opposite, thickness)
            if found:
                most = patches.area[front] * CLEARLY
                n = patches.normal[front]
                wall_out[i] = wp.vec4(n[0], n[1], n[2], offset)
                found_out[i] = 1


@wp.kernel
def _wall_of_patches(first: int, patches: Patches, field: BounceField, wall_out: wp.array(dtype=wp.vec4)):
    """The thin wall beside each patch."""
    i = first + wp.tid()
    wall_out[i] = wall_beside(field, off_surface(field, patches.position[i], patches.normal[i]))

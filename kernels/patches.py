"""Patches: the largest pieces of surface behind the faces of a coarse level's voxels."""

import warp as wp

from warp_dvct.kernels.bounce_field import NEIGHBOURS, Patch, neighbour_step
from warp_dvct.kernels.geometry import (
    FAR,
    OFFSET_RELATIVE,
    Geometry,
    Hit,
    corner_position,
    largest_coordinate,
    occluded_by_real,
    occluded_by_synthetic,
    trace_all,
)
from warp_dvct.kernels.materials import Materials, Surface, hemispherical_albedo, surface_at
from warp_dvct.kernels.volume import Volume, brick_extent, face_weight, find_record, key_cell

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

MOST_SHEETS = wp.constant(4)  # patches behind one face
LIFT = wp.constant(0.25)  # voxels of the patches' level that a patch looks around from above its surface
ANY = wp.constant(-1)  # role


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
class Sheets:
    """Pieces of surface that become patches: ``MOST_SHEETS`` places for each occupied face."""

    fragment: wp.array(dtype=wp.int32)
    eye: wp.array(dtype=wp.vec3)
    buried: wp.array(dtype=wp.int32)


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
def fragments_end(pieces: Fragments, record: int) -> int:
    """One past a record's last entry in ``pieces.order``."""
    if record + 1 < pieces.records:
        return pieces.record_start[record + 1]
    return pieces.count


@wp.func
def largest_fragment(
    geo: Geometry, normals: wp.array(dtype=wp.vec3), pieces: Fragments, record: int, face: int, role: int
) -> int:
    """The fragment of a record, of one role or of ``ANY``, that shows most on a face; -1 for none."""
    chosen = int(-1)
    most = float(0.0)
    for j in range(pieces.record_start[record], fragments_end(pieces, record)):
        fragment = pieces.order[j]
        triangle = pieces.triangle[fragment]
        if role == ANY or role == wp.where(triangle >= geo.synthetic_first, 1, 0):
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
def fragment_position(pieces: Fragments, fragment: int) -> wp.vec3:
    place = pieces.place[fragment]
    return wp.vec3(place[0], place[1], place[2])


@wp.struct
class Outlook:
    """Where a piece of surface looks around from, and whether it lies in an object, or so close under one that it
    stands for little but itself."""

    eye: wp.vec3
    buried: wp.int32


@wp.func
def outlook(
    geo: Geometry,
    normals: wp.array(dtype=wp.vec3),
    pieces: Fragments,
    fragment: int,
    face: int,
    near: float,
    lift: float,
) -> Outlook:
    """What covers a piece within ``near`` buries it; its eye is ``lift`` above it, or half as high as what is there."""
    result = Outlook()
    position = fragment_position(pieces, fragment)
    normal = fragment_normal(normals, pieces.triangle[fragment], face)
    origin = position + normal * (OFFSET_RELATIVE * wp.max(largest_coordinate(position), 1.0))
    hit = trace_all(geo, origin, normal, FAR)
    result.eye = origin + normal * wp.min(lift, 0.5 * hit.t)
    if hit.found != 0:
        from_behind = wp.dot(normals[hit.triangle], normal) > 0.0 and geo.double_sided[hit.triangle] == 0
        if hit.t < near or from_behind:
            result.buried = 1
    return result


@wp.func
def sees(geo: Geometry, one: wp.vec3, other: wp.vec3) -> bool:
    """Whether nothing is between two points."""
    d = other - one
    distance = wp.length(d)
    if distance <= 0.0:
        return True
    direction = d / distance
    if occluded_by_synthetic(geo, one, direction, distance):
        return False
    return not occluded_by_real(geo, one, direction, distance)


@wp.func
def put_sheet(sheets: Sheets, at: int, fragment: int, look: Outlook):
    sheets.fragment[at] = fragment
    sheets.eye[at] = look.eye
    sheets.buried[at] = look.buried


@wp.kernel
def _mark_synthetic(
    first: int,
    geo: Geometry,
    start_in: wp.array(dtype=wp.int32),
    face_order_in: wp.array(dtype=wp.int32),
    entries: int,
    runs: int,
    pieces: Fragments,
    apart_out: wp.array(dtype=wp.int32),
):
    """Mark the occupied faces on which something synthetic shows, or shares a record with what does."""
    i = first + wp.tid()
    end = entries
    if i + 1 < runs:
        end = start_in[i + 1]
    for j in range(start_in[i], end):
        # Real fragments come first.
        if pieces.triangle[pieces.order[fragments_end(pieces, face_order_in[j] / 6) - 1]] >= geo.synthetic_first:
            apart_out[i] = 1


@wp.func
def part_sheets(
    geo: Geometry,
    normals: wp.array(dtype=wp.vec3),
    face_order: wp.array(dtype=wp.int32),
    start: int,
    end: int,
    pieces: Fragments,
    near: float,
    lift: float,
    base: int,
    sheets: Sheets,
) -> int:
    """Sheets beside the one at ``base``: of another role, or out of its sight. Returns how many there are then.

    The largest piece of a sheet stands for it; buried ones only where nothing else of their role is behind the face.
    """
    face = face_order[start] % 6
    count = int(1)
    for role in range(2):
        known_role = bool(False)
        covered = int(-1)
        for k in range(count):
            if wp.where(pieces.triangle[sheets.fragment[base + k]] >= geo.synthetic_first, 1, 0) == role:
                known_role = True
        for j in range(start, end):
            fragment = largest_fragment(geo, normals, pieces, face_order[j] / 6, face, role)
            if fragment >= 0:
                look = outlook(geo, normals, pieces, fragment, face, near, lift)
                if look.buried != 0:
                    covered = fragment
                else:
                    known = bool(False)
                    for k in range(count):
                        other = sheets.fragment[base + k]
                        same = wp.where(pieces.triangle[other] >= geo.synthetic_first, 1, 0) == role
                        if not known and same and sheets.buried[base + k] == 0:
                            if sees(geo, look.eye, sheets.eye[base + k]):
                                known = True
                                if k > 0 and pieces.place[fragment][3] > pieces.place[other][3]:
                                    put_sheet(sheets, base + k, fragment, look)
                    if not known and count < MOST_SHEETS - 1 + role:
                        put_sheet(sheets, base + count, fragment, look)
                        count += 1
                        known_role = True
        if not known_role and covered >= 0:
            put_sheet(sheets, base + count, covered, outlook(geo, normals, pieces, covered, face, near, lift))
            count += 1
    return count


@wp.kernel
def _find_sheets(
    first: int,
    geo: Geometry,
    normal_in: wp.array(dtype=wp.vec3),
    face_key_in: wp.array(dtype=wp.int32),
    start_in: wp.array(dtype=wp.int32),
    face_order_in: wp.array(dtype=wp.int32),
    entries: int,
    runs: int,
    area_in: wp.array(dtype=wp.vec2),
    pieces: Fragments,
    near: float,
    lift: float,
    apart_in: wp.array(dtype=wp.int32),
    sheets_out: Sheets,
    count_out: wp.array(dtype=wp.int32),
    holds_out: wp.array(dtype=wp.int32),
):
    """The largest fragment behind each occupied face that is not buried, and, in voxels of which a face is marked in
    ``apart_in``, one of each further sheet. ``holds_out`` is 1 for these voxels."""
    i = first + wp.tid()
    end = entries
    if i + 1 < runs:
        end = start_in[i + 1]
    face = face_key_in[i] % 6
    at = MOST_SHEETS * i
    best = int(-1)
    most = float(0.0)
    for j in range(start_in[i], end):
        area = area_in[face_order_in[j]][1]
        if area > most:
            fragment = largest_fragment(geo, normal_in, pieces, face_order_in[j] / 6, face, ANY)
            look = outlook(geo, normal_in, pieces, fragment, face, near, lift)
            if best < 0 or look.buried == 0:
                best = fragment
                put_sheet(sheets_out, at, fragment, look)
            if look.buried == 0:
                most = area
    voxel = face_key_in[i] / 6
    holds = int(0)
    before = int(0)
    for d in range(-5, 6):
        k = i + d
        if k >= 0 and k < runs:
            if face_key_in[k] / 6 == voxel:
                holds = wp.max(holds, apart_in[k])
                if d < 0:
                    before += 1
    count = int(1)
    if holds != 0:
        count = part_sheets(geo, normal_in, face_order_in, start_in[i], end, pieces, near, lift, at, sheets_out)
    count_out[i] = count
    if before == 0:
        holds_out[voxel] = holds


@wp.kernel
def _write_patches(
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
    sheets: Sheets,
    count_in: wp.array(dtype=wp.int32),
    end_in: wp.array(dtype=wp.int32),
    patch_out: wp.array(dtype=Patch),
    table_out: wp.array(dtype=wp.int32),
):
    """The patches of one occupied face, which covers ``faces`` of level 0."""
    i = first + wp.tid()
    end = entries
    if i + 1 < runs:
        end = start_in[i + 1]
    shown = float(0.0)
    for j in range(start_in[i], end):
        shown += area_in[face_order_in[j]][1]
    face = face_key_in[i] % 6
    at = end_in[i] - count_in[i]
    table_out[face_key_in[i]] = at
    for k in range(count_in[i]):
        fragment = sheets.fragment[MOST_SHEETS * i + k]
        triangle = pieces.triangle[fragment]
        normal = fragment_normal(normal_in, triangle, face)
        s = fragment_surface(geo, mats, triangle, fragment_position(pieces, fragment), -normal)
        patch = Patch()
        patch.position = s.position
        patch.normal = normal
        patch.albedo = hemispherical_albedo(s)
        patch.eye = sheets.eye[MOST_SHEETS * i + k]
        patch.reach = s.reach
        patch.area = shown / faces
        patch.real = 1 - s.synthetic
        patch.buried = sheets.buried[MOST_SHEETS * i + k]
        patch.next = wp.where(k + 1 < count_in[i], at + k + 1, -1)
        patch.place = wp.int64(level_key_in[face_key_in[i] / 6]) * wp.int64(6) + wp.int64(face)
        patch_out[at + k] = patch


@wp.kernel
def _mark_mixed(
    first: int,
    volume: Volume,
    level: int,
    level_first: int,
    level_key_in: wp.array(dtype=wp.int32),
    holds_in: wp.array(dtype=wp.int32),
    mixed_out: wp.array(dtype=wp.int32),
):
    """Voxels whose sheets are told apart, and those next to them."""
    i = first + wp.tid()
    cell = key_cell(level_key_in[i], brick_extent(volume.n, level))
    mixed = int(0)
    for k in range(NEIGHBOURS):
        step = neighbour_step(k)
        record = find_record(volume, level, cell[0] + step[0], cell[1] + step[1], cell[2] + step[2])
        if record >= 0:
            mixed = wp.max(mixed, holds_in[record - level_first])
    mixed_out[i] = mixed


@wp.kernel
def _find_neighbours(
    first: int,
    geo: Geometry,
    volume: Volume,
    level: int,
    level_first: int,
    patches: wp.array(dtype=Patch),
    table_in: wp.array(dtype=wp.int32),
    mixed_in: wp.array(dtype=wp.int32),
    beside_out: wp.array(dtype=wp.int32),
):
    """For each patch of a mixed voxel and each voxel around: the patch behind the same face there that it sees, of its
    own role where there is one; or -1."""
    i = first + wp.tid()
    cell = key_cell(int(patches[i].place / wp.int64(6)), brick_extent(volume.n, level))
    face = int(patches[i].place % wp.int64(6))
    mixed = mixed_in[find_record(volume, level, cell[0], cell[1], cell[2]) - level_first]
    for k in range(NEIGHBOURS):
        best = int(-1)
        if mixed != 0:
            step = neighbour_step(k)
            record = find_record(volume, level, cell[0] + step[0], cell[1] + step[1], cell[2] + step[2])
            patch = int(-1)
            if record >= 0:
                patch = table_in[6 * (record - level_first) + face]
            while patch >= 0:
                better = bool(best < 0)
                if not better:
                    better = patches[patch].real == patches[i].real and patches[best].real != patches[i].real
                if better and sees(geo, patches[i].eye, patches[patch].eye):
                    best = patch
                patch = patches[patch].next
            if step[0] == 0 and step[1] == 0 and step[2] == 0:
                best = i
        beside_out[NEIGHBOURS * i + k] = best

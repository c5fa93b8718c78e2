"""Second and further bounces by re-injection: a radiosity solution on patches, added to the voxels' flux.

A patch's rays are traced once; every further bounce only follows the links from patch to patch.
"""

import warp as wp

from warp_dvct.kernels import CPU_FLAGS
from warp_dvct.kernels.bounce_field import (
    Bounced,
    BounceField,
    Patch,
    bounced_at_home,
    bounced_irradiance,
    home_of,
    is_parted,
    off_surface,
    own_patch,
    record_of,
    wall_beside,
    wall_side,
)
from warp_dvct.kernels.geometry import FAR, Geometry, Hit, trace_real, trace_synthetic
from warp_dvct.kernels.materials import Materials, Surface, hemispherical_albedo, spawn_point
from warp_dvct.kernels.patches import (
    LIFT,
    Fragments,
    fragment_position,
    fragment_surface,
    fragments_end,
    largest_fragment,
    outlook,
    sees,
)
from warp_dvct.kernels.radiosity import World, radiosity_at
from warp_dvct.kernels.sampling import PI, cosine_hemisphere, from_frame, sobol2
from warp_dvct.kernels.volume import Volume, brick_extent, face_of, face_weight, key_cell

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "cpu_compiler_flags": CPU_FLAGS})


@wp.kernel
def _mean_albedo(
    first: int,
    geo: Geometry,
    mats: Materials,
    normal_in: wp.array(dtype=wp.vec3),
    record_start_in: wp.array(dtype=wp.int32),
    order_in: wp.array(dtype=wp.int32),
    triangle_in: wp.array(dtype=wp.int32),
    fragment_in: wp.array(dtype=wp.vec4),
    fragments: int,
    records: int,
    albedo_out: wp.array(dtype=wp.vec3),
):
    """Area-weighted albedo of a record's surfaces, of the real and of the synthetic ones; 0 where there are none."""
    i = first + wp.tid()
    end = fragments
    if i + 1 < records:
        end = record_start_in[i + 1]
    real = wp.vec3(0.0, 0.0, 0.0)
    synthetic = wp.vec3(0.0, 0.0, 0.0)
    real_area = float(0.0)
    synthetic_area = float(0.0)
    for j in range(record_start_in[i], end):
        fragment = order_in[j]
        triangle = triangle_in[fragment]
        place = fragment_in[fragment]
        s = fragment_surface(geo, mats, triangle, wp.vec3(place[0], place[1], place[2]), -normal_in[triangle])
        albedo = hemispherical_albedo(s) * place[3]
        if triangle < geo.synthetic_first:
            real += albedo
            real_area += place[3]
        else:
            synthetic += albedo
            synthetic_area += place[3]
    albedo_out[2 * i] = real / wp.max(real_area, 1.0e-20)
    albedo_out[2 * i + 1] = synthetic / wp.max(synthetic_area, 1.0e-20)


@wp.struct
class PatchHits:
    """What the rays of an earlier frame's patches met in the real scene."""

    count: wp.int32
    patches: wp.array(dtype=Patch)
    distance: wp.array(dtype=wp.float32)  # [count * rays]
    triangle: wp.array(dtype=wp.int32)  # [count * rays], -1 where a ray meets nothing


@wp.func
def seen_patch(geo: Geometry, field: BounceField, head: int, guess: int, eye: wp.vec3, synthetic: int) -> int:
    """Of the patches of a role behind one face: ``guess``, or one that a free place above the point sees instead."""
    best = int(guess)
    candidate = int(guess)
    rest = int(head)
    while candidate >= 0:
        if sees(geo, eye, field.patches[candidate].eye):
            best = candidate
            rest = int(-1)
        candidate = int(-1)
        while candidate < 0 and rest >= 0:
            other = field.patches[rest]
            if rest != guess and other.real != synthetic:
                candidate = rest
            rest = other.next
    return best


@wp.func
def patch_behind(
    geo: Geometry,
    field: BounceField,
    record: int,
    position: wp.vec3,
    normal: wp.vec3,
    eye: wp.vec3,
    synthetic: int,
) -> int:
    """The patch of a surface point behind the face that its normal shows on most, then on less, one of its own role
    before others; -1 for none."""
    first = int(-1)
    best = int(-1)
    most = float(0.0)
    for axis in range(3):
        share = wp.abs(normal[axis])
        if share + 1.0 > most:
            head = field.table[(record - field.level_first) * 6 + face_of(axis, normal[axis])]
            if head >= 0:
                patch = int(head)
                if field.patches[head].next >= 0:
                    patch = own_patch(field, head, position, synthetic)
                share += wp.where(field.patches[patch].real != synthetic, 1.0, 0.0)
                if share > most:
                    most = share
                    best = patch
                    first = head
    if best >= 0:
        if field.patches[first].next >= 0:
            best = seen_patch(geo, field, first, best, eye, synthetic)
    return best


@wp.func
def patch_at(
    geo: Geometry,
    field: BounceField,
    position: wp.vec3,
    normal: wp.vec3,
    eye: wp.vec3,
    synthetic: int,
) -> int:
    """The patch of a surface point; where a thin wall parts it from its voxel's, that of the next voxel on its side."""
    record = record_of(field, position)
    if record < 0:
        return -1
    best = patch_behind(geo, field, record, position, normal, eye, synthetic)
    if best >= 0 and field.has_walls != 0:
        point = off_surface(field, position, normal)
        wall = wall_beside(field, point)
        if is_parted(wall, point, field.patches[best].position):
            size = field.volume.voxel * float(1 << field.level)
            away = wp.vec3(wall[0], wall[1], wall[2]) * (wp.sign(wall_side(wall, point)) * size)
            record = record_of(field, position + away)
            if record >= 0:
                other = patch_behind(geo, field, record, position, normal, eye, synthetic)
                if other >= 0 and not is_parted(wall, point, field.patches[other].position):
                    best = other
    return best


@wp.func
def find_patch(hits: PatchHits, patches: wp.array(dtype=Patch), i: int) -> int:
    """The same patch among those of an earlier frame, or -1: the same place, and the same surface in it."""
    place = patches[i].place
    low = int(0)
    high = int(hits.count)
    while low < high:
        middle = (low + high) / 2
        if hits.patches[middle].place < place:
            low = middle + 1
        else:
            high = middle
    while low < hits.count:
        if hits.patches[low].place != place:
            return -1
        if (
            hits.patches[low].reach == patches[i].reach
            and wp.length_sq(hits.patches[low].position - patches[i].position) == 0.0
            and wp.length_sq(hits.patches[low].normal - patches[i].normal) == 0.0
        ):
            return low
        low += 1
    return -1


@wp.kernel
def _link_patches(
    first: int,
    geo: Geometry,
    world: World,
    patches: wp.array(dtype=Patch),
    field: BounceField,
    last: PatchHits,
    rays: int,
    parts: int,
    seed: int,
    link_out: wp.array(dtype=wp.vec2i),
    irradiance_out: wp.array(dtype=wp.vec3),
    distance_out: wp.array(dtype=wp.float32),
    triangle_out: wp.array(dtype=wp.int32),
):
    """Trace one of ``parts`` parts of a patch's rays: where they end (before, after), and their share of the first
    bounce's irradiance."""
    i = (first + wp.tid()) / parts
    part = (first + wp.tid()) % parts
    known = find_patch(last, patches, i)
    # Random numbers go by place, not by rank, which depends on what else there is.
    index = int(patches[i].place / wp.int64(6))
    face = int(patches[i].place % wp.int64(6))
    normal = patches[i].normal
    s = Surface()
    s.position = patches[i].position
    s.normal_g = normal
    s.reach = patches[i].reach
    before = wp.vec3(0.0, 0.0, 0.0)
    after = wp.vec3(0.0, 0.0, 0.0)
    width = wp.sqrt(PI / float(rays))
    solutions = int(2)  # before and after; as a constant the loop would be unrolled
    lift = LIFT * field.volume.voxel * float(1 << field.level)
    for k in range(rays * part / parts, rays * (part + 1) / parts):
        direction = from_frame(cosine_hemisphere(sobol2(seed, index, k, 23 + face)), normal)
        origin = spawn_point(s, direction)
        real = Hit()
        if known >= 0:
            real.t = last.distance[known * rays + k]
            real.triangle = last.triangle[known * rays + k]
            real.found = wp.where(real.triangle >= 0, 1, 0)
        else:
            real = trace_real(geo, origin, direction, FAR)
        distance_out[i * rays + k] = real.t
        triangle_out[i * rays + k] = real.triangle
        synthetic = trace_synthetic(geo, origin, direction, real.t)
        link = wp.vec2i(-1, -1)
        for solution in range(solutions):
            hit = real
            if solution == 1:
                hit = synthetic
            if hit.found != 0:
                n = world.normals[hit.triangle]
                n = wp.where(wp.dot(n, direction) > 0.0, -n, n)
                position = origin + direction * hit.t
                light = radiosity_at(world, position, n, width * hit.t)
                eye = origin + direction * wp.max(hit.t - lift, 0.5 * hit.t)
                patch = patch_at(geo, field, position, n, eye, solution)
                if solution == 0:
                    before += light.before
                    link[0] = patch
                if solution == 1 or synthetic.found == 0:
                    after += light.after
                    link[1] = patch
        link_out[i * rays + k] = link
    irradiance_out[2 * i * parts + part] = before / float(rays)
    irradiance_out[(2 * i + 1) * parts + part] = after / float(rays)


@wp.kernel
def _sum_parts(first: int, parts: int, part_in: wp.array(dtype=wp.vec3), sum_out: wp.array(dtype=wp.vec3)):
    i = first + wp.tid()
    total = wp.vec3()
    for k in range(i * parts, (i + 1) * parts):
        total += part_in[k]
    sum_out[i] = total


@wp.kernel
def _bounce(
    first: int,
    patches: wp.array(dtype=Patch),
    link_in: wp.array(dtype=wp.vec2i),
    rays: int,
    irradiance_in: wp.array(dtype=wp.vec3),
    irradiance_out: wp.array(dtype=wp.vec3),
    total_out: wp.array(dtype=wp.vec3),
):
    """The next bounce's irradiance from the last one's, along the links; ``total_out`` collects all bounces.

    Where an object lies so close before a real surface that the patch behind their face is the object's, nothing is
    known of that surface before: its rays are taken to bring what the others bring.
    """
    i = first + wp.tid()
    known = float(0.0)
    before = wp.vec3(0.0, 0.0, 0.0)
    after = wp.vec3(0.0, 0.0, 0.0)
    for k in range(rays):
        link = link_in[i * rays + k]
        if link[0] < 0:
            known += 1.0
        elif patches[link[0]].real != 0:
            known += 1.0
            before += wp.cw_mul(patches[link[0]].albedo, irradiance_in[2 * link[0]])
        if link[1] >= 0:
            after += wp.cw_mul(patches[link[1]].albedo, irradiance_in[2 * link[1] + 1])
    before = before / wp.max(known, 1.0)
    after = after / float(rays)
    irradiance_out[2 * i] = before
    irradiance_out[2 * i + 1] = after
    total_out[2 * i] += before
    total_out[2 * i + 1] += after


@wp.func
def shown_area(
    geo: Geometry, normals: wp.array(dtype=wp.vec3), pieces: Fragments, record: int, face: int, role: int
) -> float:
    """Projected area that a role's surfaces in a record show on one face."""
    total = float(0.0)
    for j in range(pieces.record_start[record], fragments_end(pieces, record)):
        fragment = pieces.order[j]
        triangle = pieces.triangle[fragment]
        if role == wp.where(triangle >= geo.synthetic_first, 1, 0):
            shown = face_weight(normals[triangle], face)
            if geo.double_sided[triangle] != 0:
                shown += face_weight(-normals[triangle], face)
            total += shown * pieces.place[fragment][3]
    return total


@wp.struct
class Side:
    """A face of a record."""

    record: wp.int32
    face: wp.int32
    center: wp.vec3  # of its voxel
    axis: wp.vec3  # outward


@wp.func
def shown_position(
    geo: Geometry, normals: wp.array(dtype=wp.vec3), pieces: Fragments, field: BounceField, side: Side, role: int
) -> wp.vec3:
    """Where what a role shows on a record's face gets its light: at the middle of the voxel or, where a thin wall parts
    the two, on the largest piece. One side of a wall is often in another room than that middle."""
    position = side.center
    if field.has_walls != 0:
        fragment = largest_fragment(geo, normals, pieces, side.record, side.face, role)
        if fragment >= 0:
            place = fragment_position(pieces, fragment)
            point = off_surface(field, place, side.axis)
            if is_parted(wall_beside(field, point), point, side.center):
                position = place
    return position


@wp.struct
class Received:
    """Irradiance of a piece of surface, and whether something covers it closely."""

    light: Bounced
    buried: wp.int32


@wp.func
def received(
    geo: Geometry, normals: wp.array(dtype=wp.vec3), pieces: Fragments, field: BounceField, side: Side, role: int
) -> Received:
    """What a role's surfaces behind a record's face get; where there are several sheets, its largest piece tells which
    one that is."""
    result = Received()
    position = shown_position(geo, normals, pieces, field, side, role)
    home = home_of(field, position, side.axis, role)
    if home.several != 0:
        fragment = largest_fragment(geo, normals, pieces, side.record, side.face, role)
        position = fragment_position(pieces, fragment)
        home = home_of(field, position, side.axis, role)
        voxel = record_of(field, off_surface(field, position, side.axis)) - field.level_first
        if home.several != 0 and voxel >= 0:
            lift = LIFT * field.volume.voxel * float(1 << field.level)
            look = outlook(geo, normals, pieces, fragment, side.face, 0.0, lift)
            head = field.table[voxel * 6 + side.face]
            own = seen_patch(geo, field, head, home.own[side.face / 2], look.eye, role)
            home.own[side.face / 2] = own
            result.buried = field.patches[own].buried
    result.light = bounced_at_home(field, position, side.axis, home)
    return result


@wp.kernel
def _reinject(
    first: int,
    geo: Geometry,
    normal_in: wp.array(dtype=wp.vec3),
    key_in: wp.array(dtype=wp.int32),
    target: Volume,
    area_in: wp.array(dtype=wp.vec2),
    pieces: Fragments,
    albedo_in: wp.array(dtype=wp.vec3),
    field: BounceField,
    flux_out: wp.array(dtype=wp.vec3),
):
    """Add what a record's faces reflect of the bounces.

    Where real and synthetic surfaces share a face, each reflects what it gets itself; one that an object covers is not
    seen and leaves its share of the face to the object.
    """
    i = first + wp.tid()
    cell = key_cell(key_in[i], brick_extent(target.n, 0))
    center = wp.vec3(float(cell[0]) + 0.5, float(cell[1]) + 0.5, float(cell[2]) + 0.5) * target.voxel + target.low
    # Real fragments come first.
    has_real = pieces.triangle[pieces.order[pieces.record_start[i]]] < geo.synthetic_first
    has_synthetic = pieces.triangle[pieces.order[fragments_end(pieces, i) - 1]] >= geo.synthetic_first
    record = record_of(field, center)
    mixed = bool(True)
    if record >= 0:
        mixed = field.mixed[record - field.level_first] != 0
    faces = int(6)  # as a constant the loop would be unrolled, and spill 11 kB on GPUs
    for face in range(faces):
        area = area_in[i * 6 + face]
        if area[1] > 0.0:
            side = Side()
            side.record = i
            side.face = face
            side.center = center
            side.axis[face / 2] = wp.where((face & 1) == 0, 1.0, -1.0)
            before = wp.vec3(0.0, 0.0, 0.0)
            after = wp.vec3(0.0, 0.0, 0.0)
            real_share = wp.where(has_real, 1.0, 0.0)
            if mixed:
                if has_real and has_synthetic:
                    real = shown_area(geo, normal_in, pieces, i, face, 0)
                    real_share = real / wp.max(real + shown_area(geo, normal_in, pieces, i, face, 1), 1.0e-20)
                if real_share > 0.0:
                    got = received(geo, normal_in, pieces, field, side, 0)
                    before = wp.cw_mul(albedo_in[2 * i], got.light.before)
                    if got.buried != 0 and real_share < 1.0:
                        real_share = 0.0
                    after = wp.cw_mul(albedo_in[2 * i], got.light.after) * real_share
                if real_share < 1.0:
                    added = received(geo, normal_in, pieces, field, side, 1)
                    after += wp.cw_mul(albedo_in[2 * i + 1], added.light.after) * (1.0 - real_share)
            else:
                position = shown_position(geo, normal_in, pieces, field, side, 0)
                light = bounced_irradiance(field, position, side.axis, 0)
                before = wp.cw_mul(albedo_in[2 * i], light.before)
                after = wp.cw_mul(albedo_in[2 * i], light.after)
            flux_out[(i * 6 + face) * 2] += before * area[0]
            flux_out[(i * 6 + face) * 2 + 1] += after * area[1]

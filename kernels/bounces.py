"""Second and further bounces by re-injection: a radiosity solution on patches, added to the voxels' flux.

A patch's rays are traced once; every further bounce only follows the links from patch to patch.
"""

import warp as wp

from warp_dvct.kernels.bounce_field import (
    BounceField,
    bounced_irradiance,
    is_parted,
    off_surface,
    record_of,
    wall_beside,
    wall_side,
)
from warp_dvct.kernels.geometry import FAR, Geometry, Hit, trace_real, trace_synthetic
from warp_dvct.kernels.materials import Materials, Surface, hemispherical_albedo, spawn_point
from warp_dvct.kernels.patches import Patches, fragment_surface
from warp_dvct.kernels.radiosity import World, radiosity_at
from warp_dvct.kernels.sampling import PI, cosine_hemisphere, from_frame, sobol2
from warp_dvct.kernels.volume import Volume, brick_extent, face_of, key_cell

wp.set_module_options({"enable_backward": False})


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
    """Area-weighted albedo of a record's surfaces, before and after."""
    i = first + wp.tid()
    end = fragments
    if i + 1 < records:
        end = record_start_in[i + 1]
    real = wp.vec3(0.0, 0.0, 0.0)
    every = wp.vec3(0.0, 0.0, 0.0)
    real_area = float(0.0)
    area = float(0.0)
    for j in range(record_start_in[i], end):
        fragment = order_in[j]
        triangle = triangle_in[fragment]
        place = fragment_in[fragment]
        s = fragment_surface(geo, mats, triangle, wp.vec3(place[0], place[1], place[2]), -normal_in[triangle])
        albedo = hemispherical_albedo(s) * place[3]
        every += albedo
        area += place[3]
        if triangle < geo.synthetic_first:
            real += albedo
            real_area += place[3]
    albedo_out[2 * i] = real / wp.max(real_area, 1.0e-20)
    albedo_out[2 * i + 1] = every / wp.max(area, 1.0e-20)


@wp.struct
class PatchHits:
    """What the rays of an earlier frame's patches met in the real scene."""

    count: wp.int32  # patches
    place: wp.array(dtype=wp.int64)
    position: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    reach: wp.array(dtype=wp.float32)
    distance: wp.array(dtype=wp.float32)  # [count * rays]
    triangle: wp.array(dtype=wp.int32)  # [count * rays], -1 where a ray meets nothing


@wp.func
def patch_behind(field: BounceField, record: int, normal: wp.vec3) -> int:
    """The patch behind the face that a normal shows on most, then on less; -1 for none."""
    best = int(-1)
    most = float(0.0)
    for axis in range(3):
        share = wp.abs(normal[axis])
        patch = field.table[(record - field.level_first) * 6 + face_of(axis, normal[axis])]
        if patch >= 0 and share > most:
            most = share
            best = patch
    return best


@wp.func
def patch_at(field: BounceField, position: wp.vec3, normal: wp.vec3) -> int:
    """The patch of a surface point; where a thin wall parts it from its voxel's, that of the next voxel on its side."""
    record = record_of(field, position)
    if record < 0:
        return -1
    best = patch_behind(field, record, normal)
    if best >= 0 and field.has_walls != 0:
        point = off_surface(field, position, normal)
        wall = wall_beside(field, point)
        if is_parted(wall, point, field.position[best]):
            size = field.volume.voxel * float(1 << field.level)
            away = wp.vec3(wall[0], wall[1], wall[2]) * (wp.sign(wall_side(wall, point)) * size)
            record = record_of(field, position + away)
            if record >= 0:
                other = patch_behind(field, record, normal)
                if other >= 0 and not is_parted(wall, point, field.position[other]):
                    best = other
    return best


@wp.func
def find_patch(hits: PatchHits, patches: Patches, i: int) -> int:
    """The same patch among those of an earlier frame, or -1: the same place, and the same surface in it."""
    place = patches.place[i]
    low = int(0)
    high = int(hits.count)
    while low < high:
        middle = (low + high) / 2
        if hits.place[middle] < place:
            low = middle + 1
        else:
            high = middle
    if low >= hits.count:
        return -1
    if hits.place[low] != place or hits.reach[low] != patches.reach[i]:
        return -1
    for axis in range(3):
        if hits.position[low][axis] != patches.position[i][axis] or hits.normal[low][axis] != patches.normal[i][axis]:
            return -1
    return low


@wp.kernel
def _link_patches(
    first: int,
    geo: Geometry,
    world: World,
    patches: Patches,
    field: BounceField,
    last: PatchHits,
    rays: int,
    seed: int,
    link_out: wp.array(dtype=wp.vec2i),
    irradiance_out: wp.array(dtype=wp.vec3),
    distance_out: wp.array(dtype=wp.float32),
    triangle_out: wp.array(dtype=wp.int32),
):
    """Trace a patch's rays: where they end (before, after), and the first bounce's irradiance."""
    i = first + wp.tid()
    known = find_patch(last, patches, i)
    # Random numbers go by place, not by rank, which depends on what else there is.
    index = int(patches.place[i] / wp.int64(6))
    face = int(patches.place[i] % wp.int64(6))
    normal = patches.normal[i]
    s = Surface()
    s.position = patches.position[i]
    s.normal_g = normal
    s.reach = patches.reach[i]
    before = wp.vec3(0.0, 0.0, 0.0)
    after = wp.vec3(0.0, 0.0, 0.0)
    width = wp.sqrt(PI / float(rays))
    for k in range(rays):
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
        if real.found != 0:
            n = world.normals[real.triangle]
            n = wp.where(wp.dot(n, direction) > 0.0, -n, n)
            position = origin + direction * real.t
            light = radiosity_at(world, position, n, width * real.t)
            before += light.before
            link[0] = patch_at(field, position, n)
            if synthetic.found == 0:
                after += light.after
                link[1] = link[0]
        if synthetic.found != 0:
            n = world.normals[synthetic.triangle]
            n = wp.where(wp.dot(n, direction) > 0.0, -n, n)
            position = origin + direction * synthetic.t
            light = radiosity_at(world, position, n, width * synthetic.t)
            after += light.after
            link[1] = patch_at(field, position, n)
        link_out[i * rays + k] = link
    irradiance_out[2 * i] = before / float(rays)
    irradiance_out[2 * i + 1] = after / float(rays)


@wp.kernel
def _bounce(
    first: int,
    patches: Patches,
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
        elif patches.real[link[0]] != 0:
            known += 1.0
            before += wp.cw_mul(patches.albedo[link[0]], irradiance_in[2 * link[0]])
        if link[1] >= 0:
            after += wp.cw_mul(patches.albedo[link[1]], irradiance_in[2 * link[1] + 1])
    before = before / wp.max(known, 1.0)
    after = after / float(rays)
    irradiance_out[2 * i] = before
    irradiance_out[2 * i + 1] = after
    total_out[2 * i] += before
    total_out[2 * i + 1] += after


@wp.kernel
def _reinject(
    first: int,
    key_in: wp.array(dtype=wp.int32),
    target: Volume,
    area_in: wp.array(dtype=wp.vec2),
    albedo_in: wp.array(dtype=wp.vec3),
    field: BounceField,
    flux_out: wp.array(dtype=wp.vec3),
):
    """Add what a record's faces reflect of the bounces."""
    i = first + wp.tid()
    cell = key_cell(key_in[i], brick_extent(target.n, 0))
    center = wp.vec3(float(cell[0]) + 0.5, float(cell[1]) + 0.5, float(cell[2]) + 0.5) * target.voxel + target.low
    for face in range(6):
        area = area_in[i * 6 + face]
        if area[1] > 0.0:
            axis = wp.vec3(0.0, 0.0, 0.0)
            axis[face / 2] = wp.where((face & 1) == 0, 1.0, -1.0)
            light = bounced_irradiance(field, center, axis)
            flux_out[(i * 6 + face) * 2] += wp.cw_mul(albedo_in[2 * i], light.before) * area[0]
            flux_out[(i * 6 + face) * 2 + 1] += wp.cw_mul(albedo_in[2 * i + 1], light.after) * area[1]

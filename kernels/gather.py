"""Indirect light at shading points by exact rays into the radiosity volume, and its diffuse reflection."""

from typing import Any

import warp as wp

from warp_dvct.kernels import CPU_FLAGS
from warp_dvct.kernels.aim import NUMBERS, Targets, aim_at, ray_weight, sector_point
from warp_dvct.kernels.environment import environment_radiance
from warp_dvct.kernels.gbuffer import (
    BACKGROUND,
    SYNTHETIC,
    UNSEEN,
    Points,
    first_sample,
    load_surface,
    pixel_points,
    share_of,
)
from warp_dvct.kernels.geometry import (
    FAR,
    Geometry,
    Hit,
    no_hit,
    trace_real,
    trace_synthetic,
)
from warp_dvct.kernels.glossy_hits import GlossyHits, Sent, focused
from warp_dvct.kernels.hull import body_left, clear_of_objects
from warp_dvct.kernels.materials import (
    Surface,
    fresnel,
    hemispherical_albedo_specular,
    spawn_point,
)
from warp_dvct.kernels.radiosity import Incident, World, radiosity_at
from warp_dvct.kernels.sampling import INV_PI, PI, concentric_disk, from_frame, sobol2

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "cpu_compiler_flags": CPU_FLAGS})

RUN = 32  # points


@wp.func
def hit_incident(
    world: World, real: Hit, synthetic: Hit, origin: wp.vec3, direction: wp.vec3, solid_angle: float
) -> Incident:
    """Light along an exact ray, before and after: the hit voxel's radiosity, or the environment's.

    ``real`` is what the ray meets in the real scene, ``synthetic`` the synthetic surface before that.
    """
    result = Incident()
    result.before = wp.vec3(0.0, 0.0, 0.0)
    result.after = wp.vec3(0.0, 0.0, 0.0)
    width = wp.sqrt(solid_angle)
    if real.found != 0:
        n = world.normals[real.triangle]
        n = wp.where(wp.dot(n, direction) > 0.0, -n, n)
        result = radiosity_at(world, origin + direction * real.t, n, width * real.t)
    elif world.env.levels > 0:
        result.before = environment_radiance(world.env, direction, solid_angle, 0) * PI
        result.after = environment_radiance(world.env, direction, solid_angle, 1) * PI
    if synthetic.found != 0:
        n = world.normals[synthetic.triangle]
        n = wp.where(wp.dot(n, direction) > 0.0, -n, n)
        inserted = radiosity_at(world, origin + direction * synthetic.t, n, width * synthetic.t)
        result.after = inserted.after
    result.distance_before = real.t
    result.distance_after = synthetic.t
    return result


@wp.func
def ray_incident(world: World, geo: Geometry, origin: wp.vec3, direction: wp.vec3, solid_angle: float) -> Incident:
    """As ``hit_incident``, for a ray that nobody has traced yet."""
    real = trace_real(geo, origin, direction, FAR)
    synthetic = trace_synthetic(geo, origin, direction, real.t)
    return hit_incident(world, real, synthetic, origin, direction, solid_angle)


@wp.struct
class KeptRays:
    """What the rays of gather points met, from frame to frame of a shot: in the real scene and, where objects stay as
    well, on these.

    Each block of ``stride`` x ``stride`` pixels has a slot for its point's rays, which is refilled whenever that point
    is another one.
    """

    slots: wp.int32  # 0: nothing is kept, the arrays are empty
    columns: wp.int32  # blocks in a row of the picture
    point: wp.array(dtype=wp.int32)  # [slots * parts], -1 at first
    count: wp.array(dtype=wp.int32)  # [slots * parts], how many of its rays are kept
    whole: wp.int32  # rays of a slot, aimed ones too, if what they meet on objects is kept; 0: even ones, real surfaces
    hits: wp.array(dtype=wp.vec2i)  # [slots * rays], triangle or -1, bits of the distance; then the same of objects


@wp.func
def kept_slot(kept: KeptRays, points: Points, j: int, stride: int) -> int:
    """The slot of the block of a point, if anything is kept."""
    if kept.slots == 0:
        return 0
    return (points.pixel[j][1] / stride) * kept.columns + points.pixel[j][0] / stride


@wp.func
def kept_hit(bits: wp.vec2i) -> Hit:
    """What was kept of a hit."""
    hit = Hit()
    hit.triangle = bits[0]
    hit.t = wp.cast(bits[1], wp.float32)
    hit.found = wp.where(hit.triangle >= 0, 1, 0)
    return hit


@wp.func
def kept_real(
    kept: KeptRays, keeps: bool, known: bool, at: int, geo: Geometry, origin: wp.vec3, direction: wp.vec3
) -> Hit:
    """The real surface along a ray: the kept one, or a traced one, which is kept if the ray is one of those."""
    hit = Hit()
    if known:
        hit = kept_hit(kept.hits[at])
    else:
        hit = trace_real(geo, origin, direction, FAR)
        if keeps:
            kept.hits[at] = wp.vec2i(hit.triangle, wp.cast(hit.t, wp.int32))
    return hit


@wp.struct
class Ray:
    """A gathered ray and what it met; ``up`` is 0 where it would start below the surface."""

    up: wp.int32
    origin: wp.vec3
    direction: wp.vec3
    solid_angle: wp.float32
    real: Hit
    synthetic: Hit


@wp.func
def kept_synthetic(
    kept: KeptRays, keeps: bool, known: bool, at: int, geo: Geometry, body: int, s: Surface, ray: Ray
) -> Hit:
    """The synthetic surface along a ray before the real one: as ``kept_real``."""
    hit = no_hit(ray.real.t)
    if known:
        hit = kept_hit(kept.hits[at])
        hit.synthetic = hit.found
    else:
        if not clear_of_objects(geo, body, s.normal_g, ray.origin, ray.direction, ray.real.t):
            hit = trace_synthetic(geo, ray.origin, ray.direction, ray.real.t)
        if keeps:
            kept.hits[at] = wp.vec2i(hit.triangle, wp.cast(hit.t, wp.int32))
    return hit


@wp.func
def ray_over(s: Surface, disk: wp.vec2, weight: float) -> Ray:
    """The ray over a point of the disk under the hemisphere, which stands for a share ``weight`` of the disk."""
    ray = Ray()
    height = wp.sqrt(wp.max(0.0, 1.0 - wp.length_sq(disk)))
    ray.direction = from_frame(wp.vec3(disk[0], disk[1], height), s.normal)
    ray.solid_angle = PI * weight / wp.max(height, 0.05)
    if wp.dot(ray.direction, s.normal_g) > 0.0:
        ray.up = 1
        ray.origin = spawn_point(s, ray.direction)
    return ray


@wp.struct
class Gathered:
    """Means over a point's rays."""

    before: wp.vec3
    after: wp.vec3
    nearness: wp.float32


@wp.func
def add_light(total: Gathered, light: Incident, weight: float) -> Gathered:
    total.before += light.before * weight
    total.after += light.after * weight
    total.nearness += weight * inverse_distance(light)
    return total


@wp.func
def focused_incident(light: Incident, hits: GlossyHits, geo: Geometry, world: World, ray: Ray, sample: int) -> Incident:
    """``light``, with what glossy surfaces send along the ray put right."""
    result = light
    even = Sent()
    even.before = light.before
    even.after = light.after
    if ray.real.found != 0:
        if hits.focuses[geo.material[ray.real.triangle]] != 0:
            sent = focused(hits, geo, world.env, ray.real, ray.origin, ray.direction, ray.solid_angle, even, 1, sample)
            result.before = sent.before
            result.after = sent.after
    if ray.synthetic.found != 0:
        result.after = light.after
        if hits.focuses[geo.material[ray.synthetic.triangle]] != 0:
            even.before = light.after
            sent = focused(
                hits, geo, world.env, ray.synthetic, ray.origin, ray.direction, ray.solid_angle, even, 0, sample
            )
            result.after = sent.after
    return result


@wp.struct
class Lambertian:
    """Stands for ``GlossyHits`` where no surface sends light to places."""

    present: wp.int32


@wp.func
def focused_incident(  # noqa: F811 - an overload for other hits
    light: Incident, hits: Lambertian, geo: Geometry, world: World, ray: Ray, sample: int
) -> Incident:
    return light


@wp.func
def inverse_distance(light: Incident) -> float:
    return 1.0 / wp.max(wp.min(light.distance_before, light.distance_after), 1.0e-6)


@wp.func
def gather_at(
    part: wp.vec3i,
    j: int,
    points: Points,
    geo: Geometry,
    world: World,
    hits: Any,
    targets: Targets,
    rays: int,
    aimed: float,
    edge_samples: int,
    stride: int,
    seed: int,
    kept_out: KeptRays,
) -> Gathered:
    """Of point ``j``'s rays, those of a part: the slot that keeps them, the part's number, how many parts there are.

    ``hits``: ``GlossyHits`` or ``Lambertian``.
    """
    total = Gathered()
    s = load_surface(points, j)
    body = body_left(geo, s)
    even = share_of(rays, points, j, edge_samples)
    few = int(float(even) * aimed)
    aim = aim_at(targets, s, few)
    if aim.rays > 0:
        even = few
    known = int(0)  # rays
    if kept_out.slots != 0:
        slot = part[0] * part[2] + part[1]
        # As many even rays as before are the same rays: their numbers start by how many there are. So are the aimed.
        if kept_out.point[slot] == j and kept_out.count[slot] == even:
            known = wp.max(even, kept_out.whole)
        kept_out.point[slot] = j
        kept_out.count[slot] = even
    start = first_sample(even * pixel_points(points, j, edge_samples), even, stride, points, j)
    count = even + aim.rays
    for k in range(count * part[1] / part[2], count * (part[1] + 1) / part[2]):
        disk = wp.vec2()
        drawn = int(-1)
        if k < even:
            disk = concentric_disk(sobol2(seed, 0, start + k, 11))
        else:
            xi = sobol2(seed, 0, start * NUMBERS + k - even, 12)
            drawn = wp.where(k - even < aim.first, 0, 1)
            disk = sector_point(wp.where(drawn == 0, aim.sector, aim.other), xi)
        weight = ray_weight(aim, even, disk, drawn)
        ray = ray_over(s, disk, weight)
        if ray.up != 0:
            at = part[0] * rays + k
            whole = k < kept_out.whole
            keeps = whole or (kept_out.slots != 0 and k < even)
            ray.real = kept_real(kept_out, keeps, k < known, at, geo, ray.origin, ray.direction)
            at += kept_out.slots * rays
            ray.synthetic = kept_synthetic(kept_out, whole, whole and k < known, at, geo, body, s, ray)
            light = hit_incident(world, ray.real, ray.synthetic, ray.origin, ray.direction, ray.solid_angle)
            light = focused_incident(light, hits, geo, world, ray, start + k)
            total = add_light(total, light, weight)
    return total


@wp.func
def of_turn(i: int, number: int, of: int) -> int:
    """The ``i``-th element of a turn. It takes one of ``of`` runs of neighbours, whose rays meet the same surfaces, and
    another one of the next ``of``: else it might hold one side of the picture."""
    group = i / RUN
    return (group * of + (number + group) % of) * RUN + i % RUN


@wp.kernel(cuda_max_registers=128)  # two blocks of 256 threads a multiprocessor
def _gather_rays(
    first: int,
    points: Points,
    index_in: wp.array(dtype=wp.int32),
    geo: Geometry,
    world: World,
    targets: Targets,
    turn: wp.vec4i,
    rays: int,
    aimed: float,
    edge_samples: int,
    stride: int,
    seed: int,
    kept_out: KeptRays,
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
    nearness_out: wp.array(dtype=wp.float32),
):
    """Irradiance [W m^-2] from indirect light and domes, by exact rays (eq. 6's integral).

    They are cosine-distributed. Where the synthetic objects take up little of the view, only a share ``aimed`` of them
    is, if that is not 0, and others are aimed at the objects (``kernels.aim``). ``turn`` has its number, how many there
    are, how many points in all of them, and how many parts a point's rays are gathered in, each of which writes its
    share. ``stride`` is the spacing of the gathered points in pixels; a pixel's ``edge_samples`` points share its rays
    out. ``nearness_out`` is the mean inverse distance of what the rays met.
    """
    t = first + wp.tid()
    i = of_turn(t / turn[3], turn[0], turn[1])
    if i >= turn[2]:
        return
    part = wp.vec3i(0, t % turn[3], turn[3])
    j = index_in[i]
    total = Gathered()
    if j >= 0:
        if points.role[j] != BACKGROUND:
            hits = Lambertian()
            part[0] = kept_slot(kept_out, points, j, stride)
            total = gather_at(
                part, j, points, geo, world, hits, targets, rays, aimed, edge_samples, stride, seed, kept_out
            )
    at = i * turn[3] + part[1]
    before_out[at] = total.before
    after_out[at] = total.after
    nearness_out[at] = total.nearness


@wp.kernel
def _gather_rays_glossy(
    first: int,
    points: Points,
    index_in: wp.array(dtype=wp.int32),
    geo: Geometry,
    world: World,
    hits: GlossyHits,
    targets: Targets,
    turn: wp.vec4i,
    rays: int,
    aimed: float,
    edge_samples: int,
    stride: int,
    seed: int,
    kept_out: KeptRays,
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
    nearness_out: wp.array(dtype=wp.float32),
):
    """As ``_gather_rays``, where what rays meet may be glossy: apart, because it takes three times the registers."""
    t = first + wp.tid()
    i = of_turn(t / turn[3], turn[0], turn[1])
    if i >= turn[2]:
        return
    part = wp.vec3i(0, t % turn[3], turn[3])
    j = index_in[i]
    total = Gathered()
    if j >= 0:
        if points.role[j] != BACKGROUND:
            part[0] = kept_slot(kept_out, points, j, stride)
            total = gather_at(
                part, j, points, geo, world, hits, targets, rays, aimed, edge_samples, stride, seed, kept_out
            )
    at = i * turn[3] + part[1]
    before_out[at] = total.before
    after_out[at] = total.after
    nearness_out[at] = total.nearness


@wp.kernel
def _sum_parts(
    first: int,
    parts: int,
    before_in: wp.array(dtype=wp.vec3),
    after_in: wp.array(dtype=wp.vec3),
    nearness_in: wp.array(dtype=wp.float32),
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
    nearness_out: wp.array(dtype=wp.float32),
):
    """Points' irradiance and nearness, of those of the parts of their rays."""
    i = first + wp.tid()
    before = wp.vec3()
    after = wp.vec3()
    nearness = float(0.0)
    for k in range(i * parts, (i + 1) * parts):
        before += before_in[k]
        after += after_in[k]
        nearness += nearness_in[k]
    before_out[i] = before
    after_out[i] = after
    nearness_out[i] = nearness


@wp.func
def diffuse_reflectance(s: Surface, wo: wp.vec3, alpha_max: float) -> wp.vec3:
    """Radiance per irradiance of hemispherical light: the Lambert lobe under its interface, and a GGX lobe that is too
    rough for the specular pass."""
    one = wp.vec3(1.0, 1.0, 1.0)
    enter = one - s.f0 - (wp.vec3(s.f90, s.f90, s.f90) - s.f0) * (1.0 / 21.0)
    leave = one - fresnel(s.f0, s.f90, wp.dot(s.normal, wo))
    result = wp.cw_mul(s.diffuse, wp.cw_mul(enter, leave)) * INV_PI
    if s.f90 > 0.0 and s.alpha > alpha_max:
        result += hemispherical_albedo_specular(s) * INV_PI
    return result


@wp.kernel
def _shade_indirect(
    first: int,
    points: Points,
    before_in: wp.array(dtype=wp.vec3),
    after_in: wp.array(dtype=wp.vec3),
    alpha_max: float,
    with_before: int,
    light_out: wp.array(dtype=wp.vec3),
    radiance_before_out: wp.array(dtype=wp.vec3),
):
    """Add diffusely reflected indirect light: after on synthetic points (eq. 8), the change on real ones (eq. 6)."""
    i = first + wp.tid()
    role = points.role[i]
    if role != BACKGROUND and points.slot[i] != UNSEEN:
        s = load_surface(points, i)
        reflectance = diffuse_reflectance(s, points.view[i], alpha_max)
        if role == SYNTHETIC:
            light_out[i] += wp.cw_mul(reflectance, after_in[i])
        else:
            light_out[i] += wp.cw_mul(reflectance, after_in[i] - before_in[i])
            if with_before != 0:
                radiance_before_out[i] += wp.cw_mul(reflectance, before_in[i])

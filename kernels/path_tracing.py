"""The reference: unbiased path tracing of the real scene (before) and of the whole scene (after) at once.

The two pictures share camera samples, light samples and scattering samples at equal path vertices. As long as no ray of
a path meets anything synthetic there is one path for both, so equal values are equal bit for bit; where it does, the
path splits and each half goes on with the same random numbers. Knecht 2012, eq. 1-8 name the terms; Franke 2014, eq. 1
is their difference.

Every light is sampled at every vertex and weighted against scattered rays by the power heuristic (Veach 1997).
"""

import warp as wp

from warp_dvct.kernels.geometry import (
    FAR,
    SHADOW_SHORTENING,
    CameraFrame,
    Geometry,
    Hit,
    camera_depth,
    camera_ray,
    no_hit,
    occluded_by_real,
    occluded_by_synthetic,
    offset_point,
    trace_all,
    trace_real,
    trace_synthetic,
)
from warp_dvct.kernels.lights import ADDED, DOME, Lights, dome_radiance, light_along_ray, sample_light
from warp_dvct.kernels.materials import (
    Materials,
    Surface,
    brdf_cos,
    brdf_pdf,
    brdf_sample,
    spawn_point,
    surface_at,
)
from warp_dvct.kernels.sampling import PI, cosine_hemisphere, from_frame, sobol2

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Which of the two pictures a path contributes to.
BEFORE = wp.constant(1)
AFTER = wp.constant(2)
BOTH = wp.constant(3)

# From this vertex on a path survives with the probability of its throughput, at most ROULETTE_CEILING.
ROULETTE_FIRST = wp.constant(4)
ROULETTE_CEILING = wp.constant(0.95)

# Random dimensions: 0 is the camera (or gather) sample; each vertex then has these two and one per light.
LOBE = wp.constant(1)
SCATTER = wp.constant(2)
VERTEX_DIMENSIONS = wp.constant(2)


@wp.struct
class PathConfig:
    """``bounces`` is the number of indirect ones; ``any_extended`` is 0 where no light can be met by a ray."""

    bounces: int
    seed: int
    any_extended: int


@wp.struct
class Pair:
    """Radiance of the real scene alone, and of the whole scene."""

    before: wp.vec3
    after: wp.vec3


@wp.struct
class Vertex:
    """A surface that a ray has hit, and what the path carries there."""

    origin: wp.vec3
    direction: wp.vec3
    throughput: wp.vec3
    depth: int
    hit: Hit


@wp.struct
class Walk:
    """What a path gathered; the vertices where its two halves go on if it was split (hits found)."""

    before: wp.vec3
    after: wp.vec3
    on_before: Vertex
    on_after: Vertex


@wp.func
def is_positive(c: wp.vec3) -> bool:
    """Whether any channel is above zero."""
    return wp.max(c[0], wp.max(c[1], c[2])) > 0.0


@wp.func
def power_heuristic(chosen: float, other: float) -> float:
    """Weight of a sample taken with density ``chosen`` that could also have been taken with ``other``."""
    ratio = other / chosen
    return 1.0 / (1.0 + ratio * ratio)


@wp.func
def is_sampled(lights: Lights, i: int) -> bool:
    """Whether light ``i`` is sampled at all; scattered rays alone do better for a constant dome."""
    return lights.kind[i] != DOME or lights.dome_width[i] != 0


@wp.func
def gather_lights(
    geo: Geometry,
    lights: Lights,
    s: Surface,
    wo: wp.vec3,
    want: int,
    seed: int,
    index: int,
    sample: int,
    dimension: int,
) -> Pair:
    """Light reflected towards ``wo`` by next-event estimation; both pictures share sample and real visibility."""
    out = Pair()
    for i in range(lights.count):
        plate = lights.role[i] != ADDED
        if is_sampled(lights, i) and (plate or want != BEFORE):
            light = sample_light(lights, i, s.position, sobol2(seed, index, sample, dimension + i))
            value = wp.cw_mul(brdf_cos(s, wo, light.direction), light.value)
            if is_positive(value):
                if light.pdf > 0.0:
                    value = value * power_heuristic(light.pdf, brdf_pdf(s, wo, light.direction))
                origin = spawn_point(s, light.direction)
                t_max = light.distance * (1.0 - SHADOW_SHORTENING)
                if not occluded_by_real(geo, origin, light.direction, t_max):
                    if plate and want != AFTER:
                        out.before += value
                    if want != BEFORE and not occluded_by_synthetic(geo, origin, light.direction, t_max):
                        out.after += value
    return out


@wp.func
def light_reach(lights: Lights, origin: wp.vec3, direction: wp.vec3) -> float:
    """Distance of the farthest light on a ray, 0 where it meets none."""
    reach = float(0.0)
    for i in range(lights.count):
        light = light_along_ray(lights, i, origin, direction)
        if is_positive(light.radiance):
            reach = wp.max(reach, light.distance)
    return reach


@wp.func
def meet_lights(
    lights: Lights, origin: wp.vec3, direction: wp.vec3, pdf: float, want: int, open_before: float, open_after: float
) -> Pair:
    """Radiance of the lights on a scattered ray, each weighted against its own sampling, up to the open distances."""
    out = Pair()
    for i in range(lights.count):
        light = light_along_ray(lights, i, origin, direction)
        if is_positive(light.radiance):
            value = light.radiance
            if is_sampled(lights, i):
                value = value * power_heuristic(pdf, light.pdf)
            needed = light.distance * (1.0 - SHADOW_SHORTENING)
            if want != AFTER and lights.role[i] != ADDED and open_before >= needed:
                out.before += value
            if want != BEFORE and open_after >= needed:
                out.after += value
    return out


@wp.func
def make_vertex(origin: wp.vec3, direction: wp.vec3, throughput: wp.vec3, depth: int, hit: Hit) -> Vertex:
    """A vertex from its parts."""
    v = Vertex()
    v.origin = origin
    v.direction = direction
    v.throughput = throughput
    v.depth = depth
    v.hit = hit
    return v


@wp.func
def follow(
    geo: Geometry,
    mats: Materials,
    lights: Lights,
    config: PathConfig,
    start: Vertex,
    want: int,
    index: int,
    sample: int,
) -> Walk:
    """Follow a path from a surface to its end, or, for BOTH, to where it meets a synthetic surface and splits."""
    out = Walk()
    origin = start.origin
    direction = start.direction
    throughput = start.throughput
    hit = start.hit
    for depth in range(start.depth, config.bounces + 1):
        dimension = 1 + depth * (VERTEX_DIMENSIONS + lights.count)
        s = surface_at(geo, mats, hit, origin, direction)
        wo = -direction
        lit = gather_lights(geo, lights, s, wo, want, config.seed, index, sample, dimension + VERTEX_DIMENSIONS)
        out.before += wp.cw_mul(throughput, lit.before)
        out.after += wp.cw_mul(throughput, lit.after)

        last = depth == config.bounces
        if last and config.any_extended == 0:
            break
        choice = sobol2(config.seed, index, sample, dimension + LOBE - 1)
        wi = brdf_sample(s, wo, choice[0], sobol2(config.seed, index, sample, dimension + SCATTER - 1))
        pdf = brdf_pdf(s, wo, wi)
        value = brdf_cos(s, wo, wi)
        if pdf <= 0.0 or not is_positive(value):
            break
        throughput = wp.cw_mul(throughput, value / pdf)
        origin = spawn_point(s, wi)
        direction = wi
        if depth >= ROULETTE_FIRST:
            survival = wp.min(wp.max(throughput[0], wp.max(throughput[1], throughput[2])), ROULETTE_CEILING)
            if choice[1] >= survival:
                break
            throughput = throughput / survival

        t_max = float(FAR)
        if last:
            t_max = light_reach(lights, origin, wi)
            if t_max == 0.0:
                break
        real = trace_real(geo, origin, wi, t_max)
        synthetic = no_hit(real.t)
        if want != BEFORE:
            synthetic = trace_synthetic(geo, origin, wi, real.t)
        if config.any_extended != 0:
            met = meet_lights(lights, origin, wi, pdf, want, real.t, synthetic.t)
            out.before += wp.cw_mul(throughput, met.before)
            out.after += wp.cw_mul(throughput, met.after)
        if last:
            break
        if synthetic.found != 0:
            if want == BOTH:
                out.on_after = make_vertex(origin, wi, throughput, depth + 1, synthetic)
                out.on_before = make_vertex(origin, wi, throughput, depth + 1, real)
                break
            hit = synthetic
        elif real.found != 0:
            hit = real
        else:
            break
    return out


@wp.func
def follow_pair(
    geo: Geometry,
    mats: Materials,
    lights: Lights,
    config: PathConfig,
    on_both: Vertex,
    on_after: Vertex,
    on_before: Vertex,
    index: int,
    sample: int,
) -> Pair:
    """Follow a path for both pictures, or its two halves; vertices without a hit have nothing to follow."""
    out = Pair()
    part = int(0)
    while part < 3:
        want = int(BOTH)
        start = on_both
        if part == 1:
            want = AFTER
            start = on_after
        if part == 2:
            want = BEFORE
            start = on_before
        if start.hit.found != 0:
            walk = follow(geo, mats, lights, config, start, want, index, sample)
            out.before += walk.before
            out.after += walk.after
            if part == 0:
                on_after = walk.on_after
                on_before = walk.on_before
        part += 1
    return out


@wp.func
def trace_pair(
    geo: Geometry,
    mats: Materials,
    lights: Lights,
    config: PathConfig,
    origin: wp.vec3,
    direction: wp.vec3,
    real: Hit,
    synthetic: Hit,
    index: int,
    sample: int,
) -> Pair:
    """Radiance along a ray whose nearest real surface, and synthetic surface in front of it, are known."""
    one = wp.vec3(1.0, 1.0, 1.0)
    on_real = make_vertex(origin, direction, one, 0, real)
    nothing = make_vertex(origin, direction, one, 0, no_hit(FAR))
    if synthetic.found != 0:
        on_synthetic = make_vertex(origin, direction, one, 0, synthetic)
        return follow_pair(geo, mats, lights, config, nothing, on_synthetic, on_real, index, sample)
    return follow_pair(geo, mats, lights, config, on_real, nothing, nothing, index, sample)


@wp.kernel
def _trace_pixels(
    first: int,
    geo: Geometry,
    mats: Materials,
    lights: Lights,
    cam: CameraFrame,
    config: PathConfig,
    width: int,
    height: int,
    sample_first: int,
    sample_count: int,
    before_out: wp.array(dtype=wp.vec3d),
    delta_out: wp.array(dtype=wp.vec3d),
    synthetic_out: wp.array(dtype=wp.vec4d),
    real_out: wp.array(dtype=int),
):
    """Add samples to the sums of each pixel: radiance before, delta where no synthetic surface is seen, else after."""
    i = first + wp.tid()
    x = i % width
    y = i // width
    before = before_out[i]
    delta = delta_out[i]
    synthetic_sum = synthetic_out[i]
    real_count = real_out[i]
    for k in range(sample_count):
        sample = sample_first + k
        jitter = sobol2(config.seed, i, sample, 0)
        ray = camera_ray(cam, float(x) + jitter[0], float(y) + jitter[1], width, height)
        real = trace_real(geo, ray.origin, ray.direction, ray.t_max)
        synthetic = trace_synthetic(geo, ray.origin, ray.direction, real.t)
        light = trace_pair(geo, mats, lights, config, ray.origin, ray.direction, real, synthetic, i, sample)
        if real.found == 0:
            background = dome_radiance(lights, ray.direction, 0)
            light.before += background
            if synthetic.found == 0:
                light.after += background
        before += wp.vec3d(light.before)
        if synthetic.found != 0:
            a = wp.vec3d(light.after)
            synthetic_sum += wp.vec4d(a[0], a[1], a[2], wp.float64(1.0))
        else:
            delta += wp.vec3d(light.after - light.before)
            real_count += real.found
    before_out[i] = before
    delta_out[i] = delta
    synthetic_out[i] = synthetic_sum
    real_out[i] = real_count


@wp.kernel
def _resolve_pixels(
    first: int,
    before_in: wp.array(dtype=wp.vec3d),
    delta_in: wp.array(dtype=wp.vec3d),
    synthetic_in: wp.array(dtype=wp.vec4d),
    real_in: wp.array(dtype=int),
    samples: int,
    before_out: wp.array(dtype=wp.vec3),
    delta_out: wp.array(dtype=wp.vec3),
    synthetic_out: wp.array(dtype=wp.vec4),
    mask_real_out: wp.array(dtype=float),
):
    """Sums to means over the whole pixel; the delta holds only the samples that saw no synthetic surface."""
    i = first + wp.tid()
    total = wp.float64(samples)
    synthetic = synthetic_in[i]
    before_out[i] = wp.vec3(before_in[i] / total)
    synthetic_out[i] = wp.vec4(synthetic / total)
    mask_real_out[i] = float(real_in[i]) / float(samples)
    delta_out[i] = wp.vec3(delta_in[i] / total)


@wp.kernel
def _find_first_surfaces(
    first: int,
    geo: Geometry,
    mats: Materials,
    cam: CameraFrame,
    width: int,
    height: int,
    origin_ws: wp.vec3,
    metres: float,
    albedo_out: wp.array(dtype=wp.vec3),
    normal_out: wp.array(dtype=wp.vec3),
    position_out: wp.array(dtype=wp.vec3),
    depth_out: wp.array(dtype=float),
):
    """What the rays through the pixels' centres see first, in world space; ``metres`` is the length of a unit."""
    i = first + wp.tid()
    ray = camera_ray(cam, float(i % width) + 0.5, float(i // width) + 0.5, width, height)
    hit = trace_all(geo, ray.origin, ray.direction, ray.t_max)
    albedo_out[i] = wp.vec3(0.0, 0.0, 0.0)
    normal_out[i] = wp.vec3(0.0, 0.0, 0.0)
    position_out[i] = wp.vec3(0.0, 0.0, 0.0)
    depth_out[i] = wp.inf
    if hit.found != 0:
        s = surface_at(geo, mats, hit, ray.origin, ray.direction)
        albedo_out[i] = s.base_color
        normal_out[i] = s.normal
        position_out[i] = s.position * metres + origin_ws
        depth_out[i] = camera_depth(cam, s.position) * metres


@wp.kernel
def _gather_irradiance(
    first: int,
    geo: Geometry,
    mats: Materials,
    lights: Lights,
    config: PathConfig,
    position_in: wp.array(dtype=wp.vec3),
    normal_in: wp.array(dtype=wp.vec3),
    samples: int,
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
):
    """Indirect irradiance at points by cosine-distributed rays, before and after."""
    i = first + wp.tid()
    before = wp.vec3d()
    after = wp.vec3d()
    origin = offset_point(position_in[i], normal_in[i])
    for sample in range(samples):
        direction = from_frame(cosine_hemisphere(sobol2(config.seed, i, sample, 0)), normal_in[i])
        real = trace_real(geo, origin, direction, FAR)
        synthetic = trace_synthetic(geo, origin, direction, real.t)
        light = trace_pair(geo, mats, lights, config, origin, direction, real, synthetic, i, sample)
        before += wp.vec3d(light.before)
        after += wp.vec3d(light.after)
    weight = wp.float64(PI) / wp.float64(samples)
    before_out[i] = wp.vec3(before * weight)
    after_out[i] = wp.vec3(after * weight)

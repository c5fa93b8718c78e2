"""Specular reflections at shading points: exact rays whose hits are shaded by the lights, or one cone per lobe."""

import warp as wp

from warp_dvct.kernels import CPU_FLAGS
from warp_dvct.kernels.bounce_field import BounceField, bounced_irradiance
from warp_dvct.kernels.cones import ConeSettings
from warp_dvct.kernels.environment import environment_radiance
from warp_dvct.kernels.gather import diffuse_reflectance, hit_incident, inverse_distance, ray_incident
from warp_dvct.kernels.gather_cones import cone_incident
from warp_dvct.kernels.gbuffer import BACKGROUND, UNSEEN, Points, first_sample, load_surface, share_of
from warp_dvct.kernels.geometry import (
    FAR,
    Geometry,
    blocked_by_real,
    occluded_by_real,
    occluded_by_synthetic,
    trace_real,
    trace_synthetic,
)
from warp_dvct.kernels.lights import ADDED, DOME, Lights, light_along_ray, sample_light
from warp_dvct.kernels.lobe_smoothing import Reflected
from warp_dvct.kernels.materials import (
    Materials,
    Surface,
    brdf_cos_diffuse,
    brdf_cos_specular,
    fresnel,
    spawn_point,
    surface_at,
)
from warp_dvct.kernels.radiosity import Incident, World
from warp_dvct.kernels.sampling import INV_PI, sobol2
from warp_dvct.kernels.shading import SHADOW_END, power_share, reflect_visible, vndf_pdf

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "cpu_compiler_flags": CPU_FLAGS})


# A GGX alpha from which on a lobe blurs what it shows by more than the voxels do: its rays read their radiosity, but
# for surfaces that focus.
BLURRED = wp.constant(0.1)


@wp.struct
class Glossy:
    """Settings of the specular pass."""

    rays: wp.int32  # per pixel
    edge_samples: wp.int32  # points of an edge pixel, which share its rays out
    light_samples: wp.int32  # of the direct pass, which shares the highlights
    alpha_max: wp.float32  # roughest lobe that is traced
    again: wp.int32  # 1: what a reflection shows may itself reflect
    seed: wp.int32


@wp.func
def lights_along(
    lights: Lights, origin: wp.vec3, direction: wp.vec3, reach: float, density: float, samples: float, with_added: int
) -> wp.vec3:
    """Finite lights that a reflected ray meets, with the share that ``samples`` light samples leave to it."""
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(lights.count):
        if lights.kind[k] != DOME and (lights.role[k] != ADDED or with_added != 0):
            met = light_along_ray(lights, k, origin, direction)
            if met.pdf > 0.0 and met.distance < reach:
                total += met.radiance * power_share(density, samples * met.pdf)
    return total


@wp.func
def lit_by_lights(
    geo: Geometry, lights: Lights, s: Surface, wo: wp.vec3, glossy: Glossy, with_before: int, index: int, sample: int
) -> Incident:
    """Radiance that a hit surface sends back of all lights, domes included: one shadow ray per light."""
    result = Incident()
    result.before = wp.vec3(0.0, 0.0, 0.0)
    result.after = wp.vec3(0.0, 0.0, 0.0)
    for k in range(lights.count):
        light = sample_light(lights, k, s.position, sobol2(glossy.seed, index, sample, 2 * k + 31))
        f = brdf_cos_diffuse(s, wo, light.direction)
        if s.f90 > 0.0:
            share = float(1.0)
            if s.alpha <= glossy.alpha_max and light.pdf > 0.0 and lights.kind[k] != DOME:
                share = power_share(light.pdf, vndf_pdf(s, wo, light.direction))
            if lights.kind[k] != DOME or s.alpha > glossy.alpha_max:
                f += brdf_cos_specular(s, wo, light.direction) * share
        f = wp.cw_mul(f, light.value)
        if wp.max(f[0], wp.max(f[1], f[2])) > 0.0:
            origin = spawn_point(s, light.direction)
            reach = light.distance * SHADOW_END
            hidden = bool(False)
            if lights.kind[k] == DOME:
                hidden = occluded_by_real(geo, origin, light.direction, reach)
            else:
                hidden = blocked_by_real(geo, origin, light.direction, reach)
            if not hidden:
                if with_before != 0 and lights.role[k] != ADDED:
                    result.before += f
                if not occluded_by_synthetic(geo, origin, light.direction, reach):
                    result.after += f
    return result


@wp.func
def shade_hit(
    geo: Geometry,
    world: World,
    bounces: BounceField,
    lights: Lights,
    s: Surface,
    wo: wp.vec3,
    glossy: Glossy,
    with_before: int,
    index: int,
    sample: int,
) -> Incident:
    """Radiance that a surface met by a reflected ray sends back: direct light by shadow rays, further bounces from the
    patches, and its own reflection by one more ray."""
    result = lit_by_lights(geo, lights, s, wo, glossy, with_before, index, sample)
    bounced = bounced_irradiance(bounces, s.position, s.normal_g, s.synthetic)
    reflectance = diffuse_reflectance(s, wo, glossy.alpha_max)
    result.before += wp.cw_mul(reflectance, bounced.before)
    result.after += wp.cw_mul(reflectance, bounced.after)
    if s.f90 > 0.0 and s.alpha <= glossy.alpha_max:
        direction = reflect_visible(s, wo, sobol2(glossy.seed, index, sample, 19))
        density = vndf_pdf(s, wo, direction)
        if density > 0.0 and wp.dot(direction, s.normal_g) > 0.0:
            weight = brdf_cos_specular(s, wo, direction) / density
            origin = spawn_point(s, direction)
            seen = ray_incident(world, geo, origin, direction, 1.0 / density)
            before = lights_along(lights, origin, direction, seen.distance_before, density, 1.0, 0)
            after = lights_along(lights, origin, direction, seen.distance_after, density, 1.0, 1)
            # An open ray sees the domes directly: that is light of this bounce, not of one more.
            if glossy.again != 0 or seen.distance_before >= FAR:
                before += seen.before * INV_PI
            if glossy.again != 0 or seen.distance_after >= FAR:
                after += seen.after * INV_PI
            result.before += wp.cw_mul(weight, before)
            result.after += wp.cw_mul(weight, after)
    return result


@wp.func
def reflected_along(
    geo: Geometry,
    mats: Materials,
    world: World,
    bounces: BounceField,
    lights: Lights,
    origin: wp.vec3,
    direction: wp.vec3,
    density: float,
    glossy: Glossy,
    blurred: bool,
    focuses: wp.array(dtype=wp.int32),
    with_before: int,
    index: int,
    sample: int,
) -> Incident:
    """Radiance along a reflected ray, before and after, with the share of the lights that is the ray's.

    Surfaces met are shaded by the lights; for a ``blurred`` ray the voxels' radiosity stands for those that spread
    their light, whose materials ``focuses`` does not mark.
    """
    result = Incident()
    real = trace_real(geo, origin, direction, FAR)
    synthetic = trace_synthetic(geo, origin, direction, real.t)
    result.distance_before = real.t
    result.distance_after = synthetic.t
    samples = float(glossy.light_samples)
    rays = density * float(glossy.rays)
    shade_real = real.found != 0 and (with_before != 0 or synthetic.found == 0)
    shade_synthetic = synthetic.found != 0
    if blurred:
        result = hit_incident(world, real, synthetic, origin, direction, 1.0 / rays)
        result.before = result.before * INV_PI
        result.after = result.after * INV_PI
        if shade_real:
            shade_real = focuses[geo.material[real.triangle]] != 0
        if shade_synthetic:
            shade_synthetic = focuses[geo.material[synthetic.triangle]] != 0
    elif real.found == 0:
        result.before = environment_radiance(world.env, direction, 1.0 / rays, 0)
        result.after = environment_radiance(world.env, direction, 1.0 / rays, 1)
    if shade_real:
        s = surface_at(geo, mats, real, origin, direction)
        seen = shade_hit(geo, world, bounces, lights, s, -direction, glossy, with_before, index, sample)
        result.before = seen.before
        if synthetic.found == 0:
            result.after = seen.after
    if shade_synthetic:
        s = surface_at(geo, mats, synthetic, origin, direction)
        seen = shade_hit(geo, world, bounces, lights, s, -direction, glossy, 0, index, sample)
        result.after = seen.after
    result.before += lights_along(lights, origin, direction, real.t, rays, samples, 0)
    result.after += lights_along(lights, origin, direction, synthetic.t, rays, samples, 1)
    return result


@wp.kernel
def _shade_specular_rays(
    first: int,
    points: Points,
    index_in: wp.array(dtype=wp.int32),
    geo: Geometry,
    mats: Materials,
    world: World,
    bounces: BounceField,
    lights: Lights,
    glossy: Glossy,
    focuses_in: wp.array(dtype=wp.int32),
    reflected_out: Reflected,
):
    """The GGX lobe's reflections by exact rays with visible-normal sampling (eq. 6's second term)."""
    i = first + wp.tid()
    j = index_in[i]
    s = load_surface(points, j)
    wo = points.view[j]
    before = wp.vec3(0.0, 0.0, 0.0)
    after = wp.vec3(0.0, 0.0, 0.0)
    nearness = float(0.0)
    rays = share_of(glossy.rays, points, j, glossy.edge_samples)
    start = first_sample(glossy.rays, rays, 1, points, j)
    for k in range(start, start + rays):
        direction = reflect_visible(s, wo, sobol2(glossy.seed, 0, k, 17))
        density = vndf_pdf(s, wo, direction)
        if wp.dot(direction, s.normal_g) > 0.0 and density > 0.0:
            weight = brdf_cos_specular(s, wo, direction) / density
            origin = spawn_point(s, direction)
            blurred = s.alpha >= BLURRED
            light = reflected_along(
                geo,
                mats,
                world,
                bounces,
                lights,
                origin,
                direction,
                density,
                glossy,
                blurred,
                focuses_in,
                1 - s.synthetic,
                0,
                k,
            )
            nearness += inverse_distance(light)
            after += wp.cw_mul(weight, light.after)
            if s.synthetic == 0:
                before += wp.cw_mul(weight, light.before)
    after = after / float(rays)
    before = before / float(rays)
    reflected_out.change[i] = after - before
    reflected_out.before[i] = before
    reflected_out.nearness[i] = nearness / float(rays)


@wp.kernel
def _shade_specular_cones(
    first: int,
    points: Points,
    index_in: wp.array(dtype=wp.int32),
    geo: Geometry,
    world: World,
    cone: ConeSettings,
    with_before: int,
    light_out: wp.array(dtype=wp.vec3),
    before_out: wp.array(dtype=wp.vec3),
):
    """Add the GGX lobe's reflections by one cone around the mirror direction, as wide as the lobe (eq. 6).

    The cone's half angle holds half of the lobe: tan = alpha for normals (GGX's median slope is alpha), doubled by the
    reflection.
    """
    i = first + wp.tid()
    j = index_in[i]
    s = load_surface(points, j)
    wo = points.view[j]
    direction = wp.normalize(s.normal * (2.0 * wp.dot(s.normal, wo)) - wo)
    if wp.dot(direction, s.normal_g) > 0.0:
        shaft = cone
        shaft.aperture = wp.min(4.0 * wp.atan(s.alpha), 3.0)
        light = cone_incident(world, geo, s, direction, shaft, with_before)
        weight = fresnel(s.f0, s.f90, wp.dot(s.normal, wo)) * INV_PI
        if s.synthetic != 0:
            light_out[j] += wp.cw_mul(weight, light.after)
        else:
            light_out[j] += wp.cw_mul(weight, light.after - light.before)
            if with_before != 0:
                before_out[j] += wp.cw_mul(weight, light.before)


@wp.kernel
def _mark_glossy(first: int, points: Points, alpha_max: float, flag_out: wp.array(dtype=wp.int32)):
    """1 where a point has a specular lobe that the specular pass treats."""
    i = first + wp.tid()
    glossy = (
        points.role[i] != BACKGROUND
        and points.slot[i] != UNSEEN
        and points.lobe[i][0] > 0.0
        and points.lobe[i][1] <= alpha_max
    )
    flag_out[i] = wp.where(glossy, 1, 0)

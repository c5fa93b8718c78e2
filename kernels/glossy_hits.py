"""What a glossy surface sends along a gathered ray: the lights in its lobe, instead of an even share to all sides.

Voxels hold radiosity, so a surface met through them looks Lambertian. For a narrow lobe that is wrong where it matters
most: a glossy floor sends a lamp's light to one place, brightly, and to the others hardly any.
"""

import warp as wp

from warp_dvct.kernels.bounce_field import BounceField, bounced_irradiance
from warp_dvct.kernels.environment import Environment, environment_radiance
from warp_dvct.kernels.geometry import (
    FAR,
    Geometry,
    Hit,
    corner_position,
    occluded_by_real,
    occluded_by_synthetic,
)
from warp_dvct.kernels.lights import ADDED, DOME, Lights, light_along_ray, sample_light
from warp_dvct.kernels.materials import (
    Materials,
    Surface,
    brdf_cos_specular,
    fresnel,
    hemispherical_albedo_diffuse,
    hemispherical_albedo_specular,
    spawn_point,
    surface_at,
)
from warp_dvct.kernels.sampling import PI, sobol2
from warp_dvct.kernels.shading import SHADOW_END, look, power_share, reflect_visible, vndf_pdf

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

FOCUSING = wp.constant(0.2)  # a GGX alpha up to which a lobe sends light to places rather than all around
NEGLIGIBLE = wp.constant(0.01)  # share of the diffuse light below which a lobe's light is not worth a shadow ray


@wp.struct
class GlossyHits:
    """What is needed to shade a glossy hit."""

    mats: Materials
    lights: Lights
    bounces: BounceField
    focuses: wp.array(dtype=wp.int32)  # [materials], 1 where the lobe may be narrower than FOCUSING
    seed: wp.int32


@wp.struct
class Sent:
    """Radiosity (pi times radiance) that a surface sends along a ray, before and after."""

    before: wp.vec3
    after: wp.vec3


@wp.func
def divided(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    tiny = wp.vec3(1.0e-12, 1.0e-12, 1.0e-12)
    return wp.cw_div(a, wp.max(b, tiny))


@wp.func
def domes_in_lobe(geo: Geometry, env: Environment, s: Surface, wo: wp.vec3) -> Sent:
    """The environment around the mirror direction, over the lobe's solid angle, where the direction is open."""
    sent = Sent()
    direction = wp.normalize(s.normal * (2.0 * wp.dot(s.normal, wo)) - wo)
    if env.levels > 0 and wp.dot(direction, s.normal_g) > 0.0:
        origin = spawn_point(s, direction)
        if not occluded_by_real(geo, origin, direction, FAR):
            # Directions spread by twice the normals' slope.
            solid_angle = PI * 4.0 * s.alpha * s.alpha
            weight = fresnel(s.f0, s.f90, wp.dot(s.normal, wo))
            sent.before = wp.cw_mul(weight, environment_radiance(env, direction, solid_angle, 0))
            if not occluded_by_synthetic(geo, origin, direction, FAR):
                sent.after = wp.cw_mul(weight, environment_radiance(env, direction, solid_angle, 1))
    return sent


@wp.func
def lights_in_lobe(
    geo: Geometry,
    lights: Lights,
    s: Surface,
    wo: wp.vec3,
    faint: float,
    with_before: int,
    seed: int,
    index: int,
    sample: int,
) -> Sent:
    """Radiance of the finite lights reflected by the lobe, by shadow rays; less than ``faint`` is left out.

    One sample of each light and one of the lobe share the work by the power heuristic (Veach 1997): where the light
    covers more than the lobe, samples of the light alone would be rare and far too bright.
    """
    sent = Sent()
    bounce = reflect_visible(s, wo, sobol2(seed, index, sample, 59))
    bounce_density = vndf_pdf(s, wo, bounce)
    bounce_weight = wp.vec3(0.0, 0.0, 0.0)
    if bounce_density > 0.0 and wp.dot(bounce, s.normal_g) > 0.0:
        bounce_weight = brdf_cos_specular(s, wo, bounce) / bounce_density
    for k in range(lights.count):
        if lights.kind[k] != DOME:
            real_before = with_before != 0 and lights.role[k] != ADDED
            light = sample_light(lights, k, s.position, sobol2(seed, index, sample, 2 * k + 61))
            f = wp.cw_mul(brdf_cos_specular(s, wo, light.direction), light.value)
            if light.pdf > 0.0:
                f *= power_share(light.pdf, vndf_pdf(s, wo, light.direction))
            if wp.max(f[0], wp.max(f[1], f[2])) > faint:
                reach = light.distance * SHADOW_END
                sight = look(geo, spawn_point(s, light.direction), light.direction, reach, real_before, True, True)
                sent.after += f * sight.after
                if real_before:
                    sent.before += f * sight.before
            origin = spawn_point(s, bounce)
            met = light_along_ray(lights, k, origin, bounce)
            if met.pdf > 0.0:
                f = wp.cw_mul(bounce_weight, met.radiance) * power_share(bounce_density, met.pdf)
                if wp.max(f[0], wp.max(f[1], f[2])) > faint:
                    sight = look(geo, origin, bounce, met.distance * SHADOW_END, real_before, True, True)
                    sent.after += f * sight.after
                    if real_before:
                        sent.before += f * sight.before
    return sent


@wp.func
def placed(geo: Geometry, hit: Hit, point: wp.vec3) -> Hit:
    """The hit with barycentric coordinates from where it is: hits that were kept have none."""
    r = corner_position(geo, hit.triangle, 2)
    first = corner_position(geo, hit.triangle, 0) - r
    second = corner_position(geo, hit.triangle, 1) - r
    n = wp.cross(first, second)
    to_point = point - r
    out = hit
    out.u = wp.dot(wp.cross(to_point, second), n) / wp.dot(n, n)
    out.v = wp.dot(wp.cross(first, to_point), n) / wp.dot(n, n)
    return out


@wp.func
def focused(
    hits: GlossyHits,
    geo: Geometry,
    env: Environment,
    hit: Hit,
    origin: wp.vec3,
    direction: wp.vec3,
    solid_angle: float,
    even: Sent,
    with_before: int,
    sample: int,
) -> Sent:
    """``even``, the voxels' radiosity, with the specular share of what lights send put into the lobe.

    A ray stands for a cone of ``solid_angle``. The lobe is widened by as much, so that none is too narrow for the rays
    there are, and the error vanishes as they become more (path space regularisation, Kaplanyan & Dachsbacher 2013).
    Light of further bounces stays even.
    """
    s = surface_at(geo, hits.mats, placed(geo, hit, origin + direction * hit.t), origin, direction)
    if s.f90 <= 0.0 or s.alpha > FOCUSING:
        return even
    wo = -direction
    diffuse = hemispherical_albedo_diffuse(s)
    specular = hemispherical_albedo_specular(s)
    keep = divided(diffuse, diffuse + specular)
    bounced = bounced_irradiance(hits.bounces, s.position, s.normal_g, s.synthetic)
    s.alpha = wp.min(wp.sqrt(s.alpha * s.alpha + solid_angle / PI), 1.0)
    share = divided(specular, hemispherical_albedo_specular(s))  # widening costs energy at grazing angles
    brightest = wp.max(even.after, even.before)
    faint = NEGLIGIBLE / PI * wp.max(brightest[0], wp.max(brightest[1], brightest[2]))
    lit = lights_in_lobe(geo, hits.lights, s, wo, faint, with_before, hits.seed, 0, sample)
    sky = domes_in_lobe(geo, env, s, wo)
    sent = Sent()
    sent.before = (
        wp.cw_mul(keep, even.before)
        + wp.cw_mul(specular, bounced.before)
        + wp.cw_mul(share, lit.before + sky.before) * PI
    )
    sent.after = (
        wp.cw_mul(keep, even.after) + wp.cw_mul(specular, bounced.after) + wp.cw_mul(share, lit.after + sky.after) * PI
    )
    return sent

"""Direct light at shading points: what it is on synthetic surfaces, by how much it changes on real ones."""

import warp as wp

from warp_dvct.kernels.cones import ConeSettings, march_cone
from warp_dvct.kernels.gbuffer import BACKGROUND, SYNTHETIC, Points, load_surface
from warp_dvct.kernels.geometry import Geometry, occluded_by_real, occluded_by_synthetic
from warp_dvct.kernels.lights import ADDED, DISTANT, DOME, Lights, LightSample, sample_light
from warp_dvct.kernels.materials import (
    Surface,
    brdf_cos_diffuse,
    brdf_cos_specular,
    ggx_d,
    ggx_root,
    spawn_point,
)
from warp_dvct.kernels.sampling import PI, sobol2
from warp_dvct.kernels.volume import Volume

wp.set_module_options({"enable_backward": False})

SHADOW_END = wp.constant(0.9999)  # of the way to the light: a surface that the light lies on does not shadow it


@wp.struct
class Direct:
    """Settings of the pass."""

    samples: wp.int32  # per light
    glossy: wp.int32  # rays of the specular pass per point; light samples share the highlights with them
    alpha_max: wp.float32  # roughest GGX alpha that the specular pass treats
    with_before: wp.int32  # 1: also the radiance before, on every real point (it becomes the plate)
    seed: wp.int32
    center: wp.vec3  # bounding sphere of the synthetic objects
    radius: wp.float32


@wp.func
def vndf_pdf(s: Surface, wo: wp.vec3, wi: wp.vec3) -> float:
    """Solid-angle density of a reflected visible normal (Heitz 2018)."""
    co = wp.dot(s.normal, wo)
    h = wp.normalize(wo + wi)
    return ggx_d(s.normal, h, s.alpha) * 0.5 / (co + ggx_root(co, s.alpha))


@wp.func
def highlight_weight(s: Surface, wo: wp.vec3, light: LightSample, direct: Direct) -> float:
    """Power-heuristic share of a light sample in the highlight; the specular pass's rays have the rest."""
    if direct.glossy == 0 or s.alpha > direct.alpha_max or light.pdf <= 0.0:
        return 1.0
    a = float(direct.samples) * light.pdf
    b = float(direct.glossy) * vndf_pdf(s, wo, light.direction)
    return a * a / (a * a + b * b)


@wp.func
def may_shadow(lights: Lights, i: int, position: wp.vec3, direct: Direct) -> bool:
    """Whether the cone from a point to a light's bounding sphere meets the synthetic objects' bounding sphere."""
    toward = direct.center - position
    distance = wp.length(toward)
    if distance <= direct.radius:
        return True
    size = wp.asin(wp.min(direct.radius / distance, 1.0))
    axis = -lights.direction[i]
    spread = wp.acos(wp.clamp(1.0 - lights.cap[i], -1.0, 1.0))
    if lights.kind[i] != DISTANT:
        to_light = lights.position[i] - position
        far = wp.length(to_light)
        bound = lights.radius[i] + wp.length(lights.axis_x[i]) + wp.length(lights.axis_y[i])
        if far <= bound or distance - direct.radius > far + bound:
            return far <= bound
        axis = to_light / far
        spread = wp.asin(bound / far)
    angle = wp.acos(wp.clamp(wp.dot(axis, toward) / distance, -1.0, 1.0))
    return angle <= size + spread + 1.0e-3


@wp.func
def reflected(s: Surface, wo: wp.vec3, light: LightSample, direct: Direct) -> wp.vec3:
    """Radiance that an unshadowed light sample makes the surface send to the viewer."""
    f = brdf_cos_diffuse(s, wo, light.direction)
    if s.f90 > 0.0:
        f += brdf_cos_specular(s, wo, light.direction) * highlight_weight(s, wo, light, direct)
    return wp.cw_mul(light.value, f)


@wp.kernel
def _shade_direct(
    first: int,
    points: Points,
    geo: Geometry,
    lights: Lights,
    direct: Direct,
    light_out: wp.array(dtype=wp.vec3),
    before_out: wp.array(dtype=wp.vec3),
):
    """Franke 2014, eqs. 5 and 7, by exact shadow rays. ``light_out``: after on synthetic points, after - before on
    real ones. ``before_out`` is written where ``with_before`` is set. Domes are left to the gather."""
    i = first + wp.tid()
    role = points.role[i]
    light_out[i] = wp.vec3(0.0, 0.0, 0.0)
    if direct.with_before != 0:
        before_out[i] = wp.vec3(0.0, 0.0, 0.0)
    if role == BACKGROUND:
        return
    s = load_surface(points, i)
    wo = points.view[i]
    total = wp.vec3(0.0, 0.0, 0.0)
    before = wp.vec3(0.0, 0.0, 0.0)
    for k in range(lights.count):
        if lights.kind[k] != DOME:
            added = lights.role[k] == ADDED
            shadowed = may_shadow(lights, k, s.position, direct)
            if role == SYNTHETIC or added or direct.with_before != 0 or shadowed:
                count = int(0)
                part = wp.vec3(0.0, 0.0, 0.0)
                part_before = wp.vec3(0.0, 0.0, 0.0)
                while count < direct.samples:
                    light = sample_light(lights, k, s.position, sobol2(direct.seed, i, count, 2 * k + 3))
                    f = reflected(s, wo, light, direct)
                    if wp.max(f[0], wp.max(f[1], f[2])) > 0.0:
                        origin = spawn_point(s, light.direction)
                        reach = light.distance * SHADOW_END
                        if role == SYNTHETIC or added:
                            if not occluded_by_synthetic(geo, origin, light.direction, reach):
                                if not occluded_by_real(geo, origin, light.direction, reach):
                                    part += f
                        else:
                            blocked = False
                            if shadowed:
                                blocked = occluded_by_synthetic(geo, origin, light.direction, reach)
                            if blocked or direct.with_before != 0:
                                if not occluded_by_real(geo, origin, light.direction, reach):
                                    part_before += f
                                    if blocked:
                                        part -= f
                    count += 1
                    if light.pdf <= 0.0:
                        # A light without extent: every sample is this one.
                        part = part * float(direct.samples)
                        part_before = part_before * float(direct.samples)
                        count = direct.samples
                total += part / float(direct.samples)
                before += part_before / float(direct.samples)
    light_out[i] = total
    if direct.with_before != 0:
        before_out[i] = before


@wp.func
def shadow_cone(
    lights: Lights,
    k: int,
    s: Surface,
    fine: Volume,
    coarse: Volume,
    has_coarse: int,
    cone: ConeSettings,
) -> wp.vec2:
    """Share of a light that real surfaces leave (x) and all surfaces leave (y), by one cone of the light's size."""
    axis = -lights.direction[k]
    aperture = 2.0 * wp.acos(wp.clamp(1.0 - lights.cap[k], -1.0, 1.0))
    shaft = cone
    if lights.kind[k] != DISTANT:
        to_light = lights.position[k] - s.position
        distance = wp.length(to_light)
        axis = to_light / distance
        area = lights.area[k] * wp.abs(wp.dot(axis, lights.direction[k]))
        radius = wp.max(lights.radius[k], wp.sqrt(area / PI))
        aperture = 2.0 * wp.atan2(radius, distance)
        # Interpolation spreads what is behind the light (a ceiling) by one voxel of the last level in front of it.
        slope = 2.0 * wp.tan(0.5 * aperture) * cone.detail
        shaft.reach = (distance - 2.0 * fine.voxel) / (1.0 + 2.0 * slope)
    shaft.aperture = wp.max(aperture, 1.0e-3)
    origin = s.position + s.normal_g * (cone.start * fine.voxel)
    result = march_cone(fine, coarse, has_coarse, origin, axis, shaft)
    return wp.vec2(1.0 - wp.min(result.before[3], 1.0), 1.0 - wp.min(result.after[3], 1.0))


@wp.kernel
def _shade_direct_cones(
    first: int,
    points: Points,
    fine: Volume,
    coarse: Volume,
    has_coarse: int,
    cone: ConeSettings,
    lights: Lights,
    direct: Direct,
    light_out: wp.array(dtype=wp.vec3),
    before_out: wp.array(dtype=wp.vec3),
):
    """Franke 2014, eqs. 5 and 7, with one shadow cone per light (the paper's Cs)."""
    i = first + wp.tid()
    role = points.role[i]
    light_out[i] = wp.vec3(0.0, 0.0, 0.0)
    if direct.with_before != 0:
        before_out[i] = wp.vec3(0.0, 0.0, 0.0)
    if role == BACKGROUND:
        return
    s = load_surface(points, i)
    wo = points.view[i]
    total = wp.vec3(0.0, 0.0, 0.0)
    before = wp.vec3(0.0, 0.0, 0.0)
    for k in range(lights.count):
        if lights.kind[k] != DOME:
            open = wp.vec3(0.0, 0.0, 0.0)
            for j in range(direct.samples):
                light = sample_light(lights, k, s.position, sobol2(direct.seed, i, j, 2 * k + 3))
                open += reflected(s, wo, light, direct) / float(direct.samples)
            if wp.max(open[0], wp.max(open[1], open[2])) > 0.0:
                left = shadow_cone(lights, k, s, fine, coarse, has_coarse, cone)
                if role == SYNTHETIC or lights.role[k] == ADDED:
                    total += open * left[1]
                else:
                    total += open * (left[1] - left[0])
                    before += open * left[0]
    light_out[i] = total
    if direct.with_before != 0:
        before_out[i] = before

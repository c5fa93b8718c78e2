"""Light of VPLs at shading points, once for both solutions; the merge of interleaved points; glossy reflections.

Knecht et al. 2012, eqs. 1-8. r(p) and r(VPL) are roles, ir the flag ``hidden``, s_tr and s_tv the two answers of
``kernels.ism``.
"""

import warp as wp

from warp_dvct.kernels import CPU_FLAGS
from warp_dvct.kernels.environment import Environment, environment_radiance
from warp_dvct.kernels.gather import inverse_distance
from warp_dvct.kernels.gbuffer import BACKGROUND, REAL, SYNTHETIC, Points, load_surface
from warp_dvct.kernels.geometry import FAR, Geometry, trace_real, trace_synthetic
from warp_dvct.kernels.glossy_hits import domes_in_lobe, lights_in_lobe
from warp_dvct.kernels.ism import AFTER, ALL, CHANGE, RAY_END, Sight, map_sight, ray_sight
from warp_dvct.kernels.lights import ADDED, DOME, Lights, sample_light
from warp_dvct.kernels.lobe_smoothing import Reflected
from warp_dvct.kernels.materials import (
    Materials,
    Surface,
    brdf_cos_diffuse,
    brdf_cos_specular,
    hemispherical_albedo,
    hemispherical_albedo_diffuse,
    spawn_point,
    surface_at,
)
from warp_dvct.kernels.radiosity import Incident
from warp_dvct.kernels.sampling import INV_PI, sobol2, uniform1
from warp_dvct.kernels.shading import SHADOW_END, Direct, look, reflect_visible, reflected, vndf_pdf
from warp_dvct.kernels.specular import Glossy, lights_along
from warp_dvct.kernels.vpls import SKY, Vpls

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "cpu_compiler_flags": CPU_FLAGS})

NEAREST = wp.constant(1.0e-12)  # squared distance below which a VPL and a point are one
TOO_FEW = wp.constant(0.7)  # share of the interleaved sets that a point needs from its neighbours
GLOSSY_VPLS = wp.constant(8)  # VPLs that light the surface which a glossy ray meets


@wp.struct
class Pair:
    """A quantity in the two solutions."""

    before: wp.vec3
    after: wp.vec3


@wp.struct
class Toward:
    """A VPL as a point sees it: irradiance at the point per unit of the VPL's flux, before visibility."""

    direction: wp.vec3
    distance: wp.float32
    form: wp.float32


@wp.func
def toward_vpl(vpls: Vpls, k: int, s: Surface, origin: wp.vec3) -> Toward:
    """cos cos / (pi (d² + R²)): what a disc of radius R sends to a point on its axis; 1 / d² where R is 0."""
    out = Toward()
    if vpls.kind[k] == SKY:
        out.direction = vpls.normal[k]
        out.distance = FAR
        if wp.dot(s.normal_g, out.direction) > 0.0:
            out.form = wp.max(wp.dot(s.normal, out.direction), 0.0)
        return out
    d = vpls.position[k] - origin
    d2 = wp.length_sq(d)
    if d2 <= NEAREST:
        return out
    out.distance = wp.sqrt(d2)
    out.direction = d / out.distance
    leaving = -wp.dot(out.direction, vpls.normal[k])
    arriving = wp.dot(out.direction, s.normal)
    if leaving > 0.0 and arriving > 0.0 and wp.dot(out.direction, s.normal_g) > 0.0:
        out.form = leaving * arriving * INV_PI / (d2 + vpls.spread[k] * vpls.spread[k])
    return out


@wp.func
def vpl_irradiance(
    geo: Geometry, vpls: Vpls, k: int, s: Surface, sight: Sight, want_before: int, want_after: int, only_change: int
) -> Pair:
    """Irradiance by one VPL in both solutions (eqs. 6-8).

    ``only_change`` asks for nothing but after - before: where both are equal, both may be 0.
    """
    out = Pair()
    out.before = wp.vec3(0.0, 0.0, 0.0)
    out.after = wp.vec3(0.0, 0.0, 0.0)
    in_before = want_before != 0 and vpls.real[k] != 0
    in_after = want_after != 0 and vpls.hidden[k] == 0
    if not in_before and not in_after:
        return out
    origin = s.position + s.normal_g * (2.0e-6 * s.reach)
    toward = toward_vpl(vpls, k, s, origin)
    if toward.form <= 0.0:
        return out
    light = vpls.flux[k] * toward.form
    need = int(ALL)
    if not in_before:
        need = AFTER
    elif in_after and only_change != 0:
        need = CHANGE
    open = wp.vec2(1.0, 1.0)
    if sight.rays != 0 or vpls.kind[k] == SKY:
        ask_synthetic = wp.where(in_after, 1, 0)
        open = ray_sight(geo, sight, origin, toward.direction, toward.distance * RAY_END, ask_synthetic, need)
    else:
        open = map_sight(vpls, k, sight, origin)
    if need == CHANGE and open[1] == 1.0:
        return out
    if in_before:
        out.before = light * open[0]
    if in_after:
        out.after = light * wp.min(open[0], open[1])
    return out


@wp.kernel
def _shade_vpls(
    first: int,
    points: Points,
    index_in: wp.array(dtype=wp.int32),
    geo: Geometry,
    vpls: Vpls,
    sight: Sight,
    width: int,
    tiles: int,
    stride: int,
    with_before: int,
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
):
    """Irradiance [W m^-2] of a point by every ``stride``-th VPL, times ``stride``.

    With ``width`` the first VPL is that of the pixel's place in its ``tiles`` x ``tiles`` tile (the interleaved split
    of Segovia et al. 2006); else it is hashed.
    """
    i = first + wp.tid()
    j = index_in[i]
    before = wp.vec3(0.0, 0.0, 0.0)
    after = wp.vec3(0.0, 0.0, 0.0)
    if j >= 0:
        role = points.role[j]
        if role != BACKGROUND:
            s = load_surface(points, j)
            k = int(uniform1(11, j, 0, 51) * float(stride))
            if width > 0:
                k = (j / width) % tiles * tiles + (j % width) % tiles
            want_before = wp.where(role == REAL, 1, 0)
            only_change = wp.where(with_before != 0, 0, 1)
            while k < vpls.count:
                light = vpl_irradiance(geo, vpls, k, s, sight, want_before, 1, only_change)
                before += light.before
                after += light.after
                k += stride
    before_out[i] = before * float(stride)
    after_out[i] = after * float(stride)


@wp.kernel
def _merge_tiles(
    first: int,
    points: Points,
    width: int,
    height: int,
    tiles: int,
    plane: float,
    sharpness: float,
    before_in: wp.array(dtype=wp.vec3),
    after_in: wp.array(dtype=wp.vec3),
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
    missing_out: wp.array(dtype=wp.int32),
):
    """Irradiance of every shading point from the pixels around: the mean over the ``tiles``² sets of VPLs.

    Each set comes from the four pixels nearest that have it, by distance, plane and normal, so that every VPL counts
    alike wherever neighbours are left out. ``missing_out`` is 1 where too many sets have no pixel on the same surface.
    """
    i = first + wp.tid()
    role = points.role[i]
    missing = int(0)
    if role != BACKGROUND:
        px = points.pixel[i][0]
        py = points.pixel[i][1]
        position = points.position[i]
        normal_g = points.normal_g[i]
        normal = points.normal[i]
        reach = wp.max(plane * float(tiles) * points.footprint[i], 1.0e-12)
        before = wp.vec3(0.0, 0.0, 0.0)
        after = wp.vec3(0.0, 0.0, 0.0)
        found = float(0.0)
        for set in range(tiles * tiles):
            x0 = px - (px - set % tiles + tiles) % tiles
            y0 = py - (py - set / tiles + tiles) % tiles
            total = float(0.0)
            sum_before = wp.vec3(0.0, 0.0, 0.0)
            sum_after = wp.vec3(0.0, 0.0, 0.0)
            for corner in range(4):
                x = x0 + (corner % 2) * tiles
                y = y0 + (corner / 2) * tiles
                if x >= 0 and x < width and y >= 0 and y < height:
                    j = y * width + x
                    if points.role[j] == role:
                        facing = wp.dot(normal, points.normal[j])
                        if facing > 0.0:
                            offset = points.position[j] - position
                            gap = (
                                wp.max(wp.abs(wp.dot(offset, normal_g)), wp.abs(wp.dot(offset, points.normal_g[j])))
                                / reach
                            )
                            near_x = 1.0 - wp.abs(float(x - px)) / float(tiles)
                            near_y = 1.0 - wp.abs(float(y - py)) / float(tiles)
                            weight = near_x * near_y * wp.pow(facing, sharpness) * wp.exp(-gap * gap)
                            total += weight
                            sum_before += before_in[j] * weight
                            sum_after += after_in[j] * weight
            if total > 1.0e-4:
                before += sum_before / total
                after += sum_after / total
                found += 1.0
        if found >= TOO_FEW * float(tiles * tiles):
            before_out[i] = before / found
            after_out[i] = after / found
        else:
            missing = 1
    missing_out[i] = missing


@wp.kernel
def _shade_direct_single(
    first: int,
    points: Points,
    geo: Geometry,
    lights: Lights,
    direct: Direct,
    sight: Sight,
    far: float,
    light_out: wp.array(dtype=wp.vec3),
    before_out: wp.array(dtype=wp.vec3),
):
    """Direct light as of 2010: one shadow map per light, which knows the surface nearest to the light alone.

    Where that is synthetic, a real blocker behind it goes unseen: the light counts as lost, though the plate never had
    it (double shadows). ``far`` is beyond all surfaces: lights without a place look from there.
    """
    i = first + wp.tid()
    role = points.role[i]
    light_out[i] = wp.vec3(0.0, 0.0, 0.0)
    if direct.with_before != 0:
        before_out[i] = wp.vec3(0.0, 0.0, 0.0)
    if role == BACKGROUND:
        return
    s = load_surface(points, i)
    wo = points.view[i]
    before = wp.vec3(0.0, 0.0, 0.0)
    after = wp.vec3(0.0, 0.0, 0.0)
    for k in range(lights.count):
        if lights.kind[k] != DOME:
            for j in range(direct.samples):
                light = sample_light(lights, k, s.position, sobol2(direct.seed, i, j, 2 * k + 3))
                f = reflected(s, wo, light, direct) / float(direct.samples)
                if wp.max(f[0], wp.max(f[1], f[2])) > 0.0:
                    reach = wp.min(light.distance, far) * RAY_END
                    open = ray_sight(geo, sight, spawn_point(s, light.direction), light.direction, reach, 1, ALL)
                    if role == REAL and lights.role[k] != ADDED:
                        before += f * open[0]
                    after += f * wp.min(open[0], open[1])
    light_out[i] = after - before
    if direct.with_before != 0:
        before_out[i] = before


@wp.func
def lit_surface(
    geo: Geometry,
    lights: Lights,
    env: Environment,
    vpls: Vpls,
    sight: Sight,
    s: Surface,
    wo: wp.vec3,
    want_before: int,
    want_after: int,
    glossy: Glossy,
    index: int,
    sample: int,
) -> Pair:
    """Radiance that a surface met by a glossy ray sends back: one sample of each light, the lights and the sky in its
    own lobe, and a few of the VPLs. What is not wanted may come out as anything."""
    out = Pair()
    out.before = wp.vec3(0.0, 0.0, 0.0)
    out.after = wp.vec3(0.0, 0.0, 0.0)
    for k in range(lights.count):
        if lights.kind[k] != DOME:
            light = sample_light(lights, k, s.position, sobol2(glossy.seed, index, sample, 2 * k + 62))
            f = wp.cw_mul(brdf_cos_diffuse(s, wo, light.direction), light.value)
            if wp.max(f[0], wp.max(f[1], f[2])) > 0.0:
                origin = spawn_point(s, light.direction)
                seen = look(geo, origin, light.direction, light.distance * SHADOW_END, want_before != 0, True, True)
                if lights.role[k] != ADDED:
                    out.before += f * seen.before
                out.after += f * seen.after
    narrow = s.f90 > 0.0 and s.alpha <= glossy.alpha_max
    if s.f90 > 0.0:
        lobe = lights_in_lobe(geo, lights, s, wo, 0.0, want_before, glossy.seed, index, sample)
        out.before += lobe.before
        out.after += lobe.after
    if narrow:
        lobe = domes_in_lobe(geo, env, s, wo)
        out.before += lobe.before
        out.after += lobe.after
    if vpls.count > 0:
        stride = wp.max(vpls.count / GLOSSY_VPLS, 1)
        share = INV_PI * float(stride)
        diffuse = hemispherical_albedo_diffuse(s) * share
        both = hemispherical_albedo(s) * share
        j = int(uniform1(glossy.seed, index, sample, 58) * float(stride))
        while j < vpls.count:
            bounced = vpl_irradiance(geo, vpls, j, s, sight, want_before, want_after, 0)
            # The lobe has seen the sky already.
            reflectance = both
            if narrow and vpls.kind[j] == SKY:
                reflectance = diffuse
            out.before += wp.cw_mul(reflectance, bounced.before)
            out.after += wp.cw_mul(reflectance, bounced.after)
            j += stride
    return out


@wp.func
def seen_along(
    geo: Geometry,
    mats: Materials,
    lights: Lights,
    env: Environment,
    vpls: Vpls,
    sight: Sight,
    origin: wp.vec3,
    direction: wp.vec3,
    density: float,
    glossy: Glossy,
    is_real: int,
    index: int,
    sample: int,
) -> Incident:
    """Radiance along a glossy ray; ``before`` is 0 where the ray starts on a synthetic surface.

    ``density`` is that of all rays together, per solid angle.
    """
    seen = Incident()
    real = trace_real(geo, origin, direction, FAR)
    synthetic = trace_synthetic(geo, origin, direction, real.t)
    seen.distance_before = real.t
    seen.distance_after = synthetic.t
    hits = int(2)  # one call in a loop at run time: two would spill on GPUs
    for n in range(hits):
        hit = real
        want_before = is_real
        want_after = wp.where(synthetic.found != 0, 0, 1)
        if n == 1:
            hit = synthetic
            want_before = 0
            want_after = 1
        if hit.found != 0 and glossy.again != 0 and (want_before != 0 or want_after != 0):
            s = surface_at(geo, mats, hit, origin, direction)
            sent = lit_surface(
                geo, lights, env, vpls, sight, s, -direction, want_before, want_after, glossy, index, 2 * sample + n
            )
            if want_before != 0:
                seen.before = sent.before
            if want_after != 0:
                seen.after = sent.after
    if real.found == 0 and env.levels > 0:
        if is_real != 0:
            seen.before = environment_radiance(env, direction, 1.0 / density, 0)
        if synthetic.found == 0:
            seen.after = environment_radiance(env, direction, 1.0 / density, 1)
    samples = float(glossy.light_samples)
    seen.after += lights_along(lights, origin, direction, synthetic.t, density, samples, 1)
    if is_real != 0:
        seen.before += lights_along(lights, origin, direction, real.t, density, samples, 0)
    return seen


@wp.kernel
def _shade_glossy(
    first: int,
    points: Points,
    index_in: wp.array(dtype=wp.int32),
    geo: Geometry,
    mats: Materials,
    lights: Lights,
    env: Environment,
    vpls: Vpls,
    sight: Sight,
    glossy: Glossy,
    reflected_out: Reflected,
):
    """The GGX lobe's reflections by rays with visible-normal sampling; VPLs would show as spots in it.

    ``vpls`` are those that may light what a ray meets: one bounce less than light diffuse surfaces. ``glossy.again`` is
    0 where surfaces are not to be seen at all: direct light only.
    """
    i = first + wp.tid()
    j = index_in[i]
    s = load_surface(points, j)
    wo = points.view[j]
    before = wp.vec3(0.0, 0.0, 0.0)
    after = wp.vec3(0.0, 0.0, 0.0)
    nearness = float(0.0)
    is_real = wp.where(points.role[j] == SYNTHETIC, 0, 1)
    for k in range(glossy.rays):
        direction = reflect_visible(s, wo, sobol2(glossy.seed, j, k, 17))
        pdf = vndf_pdf(s, wo, direction)
        if wp.dot(direction, s.normal_g) > 0.0 and pdf > 0.0:
            weight = brdf_cos_specular(s, wo, direction) / pdf
            origin = spawn_point(s, direction)
            density = pdf * float(glossy.rays)
            seen = seen_along(geo, mats, lights, env, vpls, sight, origin, direction, density, glossy, is_real, j, k)
            nearness += inverse_distance(seen)
            after += wp.cw_mul(weight, seen.after)
            before += wp.cw_mul(weight, seen.before)
    after = after / float(glossy.rays)
    before = before / float(glossy.rays)
    reflected_out.change[i] = after - before
    reflected_out.before[i] = before
    reflected_out.nearness[i] = nearness / float(glossy.rays)


@wp.kernel
def _put(
    first: int,
    index_in: wp.array(dtype=wp.int32),
    before_in: wp.array(dtype=wp.vec3),
    after_in: wp.array(dtype=wp.vec3),
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
):
    """Write what was found at listed points where they are."""
    i = first + wp.tid()
    before_out[index_in[i]] = before_in[i]
    after_out[index_in[i]] = after_in[i]


@wp.kernel
def _compare_sight(
    first: int,
    points: Points,
    geo: Geometry,
    vpls: Vpls,
    maps: Sight,
    rays: Sight,
    pairs_out: wp.array(dtype=wp.vec4i),
):
    """Pairs of a point and a VPL with maps that face each other: all, those in which maps and rays agree in both
    solutions as far as the pair is in them, those that only maps find blocked in one, and those that only rays do."""
    i = first + wp.tid()
    total = wp.vec4i(0, 0, 0, 0)
    if points.role[i] != BACKGROUND:
        s = load_surface(points, i)
        origin = s.position + s.normal_g * (2.0e-6 * s.reach)
        for k in range(vpls.count):
            toward = toward_vpl(vpls, k, s, origin)
            if toward.form > 0.0 and vpls.kind[k] != SKY:
                a = map_sight(vpls, k, maps, origin)
                b = ray_sight(geo, rays, origin, toward.direction, toward.distance * RAY_END, 1, ALL)
                x = wp.vec2(a[0] * float(vpls.real[k]), wp.min(a[0], a[1]) * float(1 - vpls.hidden[k]))
                y = wp.vec2(b[0] * float(vpls.real[k]), wp.min(b[0], b[1]) * float(1 - vpls.hidden[k]))
                if points.role[i] != REAL:
                    x[0] = 0.0
                    y[0] = 0.0
                total += wp.vec4i(
                    1,
                    wp.where(x == y, 1, 0),
                    wp.where(x[0] < y[0] or x[1] < y[1], 1, 0),
                    wp.where(x[0] > y[0] or x[1] > y[1], 1, 0),
                )
    pairs_out[i] = total

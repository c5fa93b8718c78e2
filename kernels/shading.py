"""Direct light at shading points: what it is on synthetic surfaces, by how much it changes on real ones."""

import warp as wp

from warp_dvct.kernels import CPU_FLAGS
from warp_dvct.kernels.cones import ConeSettings, march_cone
from warp_dvct.kernels.gbuffer import (
    BACKGROUND,
    REAL,
    SYNTHETIC,
    UNSEEN,
    Points,
    first_sample,
    load_surface,
    share_of,
)
from warp_dvct.kernels.geometry import Geometry, blocked_by_real, occluded_by_synthetic
from warp_dvct.kernels.hull import body_left, clear_of_objects
from warp_dvct.kernels.lights import ADDED, DISK, DISTANT, DOME, RECT, Lights, LightSample, sample_light
from warp_dvct.kernels.materials import (
    Surface,
    brdf_cos_diffuse,
    brdf_cos_specular,
    ggx_d,
    ggx_root,
    ggx_sample_half,
    spawn_point,
)
from warp_dvct.kernels.sampling import PI, sobol2, tangent_of
from warp_dvct.kernels.volume import Volume

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "cpu_compiler_flags": CPU_FLAGS})

UNLIT_MARGIN = wp.constant(1.0e-4)  # of a distance or cosine: keeps rounding from culling a light at the horizon
ON_AXIS = wp.constant(1.0e-4)  # squared sine of an angle whose rounding is far below BOX_MARGIN
BOX_MARGIN = wp.constant(1.0e-5)  # of the lengths compared: keeps rounding from culling what a box barely meets
SHADOW_END = wp.constant(0.9999)  # of the way to the light: a surface that the light lies on does not shadow it


@wp.struct
class Direct:
    """Settings of the pass."""

    samples: wp.int32  # per light and pixel
    edge_samples: wp.int32  # points of an edge pixel, which share its samples out
    probes: wp.int32  # of these, traced before deciding whether the others have to be
    glossy: wp.int32  # rays of the specular pass per pixel; light samples share the highlights with them
    alpha_max: wp.float32  # roughest GGX alpha that the specular pass treats
    with_before: wp.int32  # 1: also the radiance before, on every real point (it becomes the plate)
    seed: wp.int32


@wp.func
def vndf_pdf(s: Surface, wo: wp.vec3, wi: wp.vec3) -> float:
    """Solid-angle density of a reflected visible normal (Heitz 2018)."""
    co = wp.dot(s.normal, wo)
    h = wp.normalize(wo + wi)
    return ggx_d(s.normal, h, s.alpha) * 0.5 / (co + ggx_root(co, s.alpha))


@wp.func
def reflect_visible(s: Surface, wo: wp.vec3, xi: wp.vec2) -> wp.vec3:
    """The mirror direction of a visible microfacet."""
    t = tangent_of(s.normal)
    b = wp.cross(s.normal, t)
    h = ggx_sample_half(wp.vec3(wp.dot(wo, t), wp.dot(wo, b), wp.dot(wo, s.normal)), s.alpha, xi)
    half = t * h[0] + b * h[1] + s.normal * h[2]
    return wp.normalize(half * (2.0 * wp.dot(wo, half)) - wo)


@wp.func
def power_share(a: float, b: float) -> float:
    """Power heuristic: the share of the sampler of density ``a`` beside one of density ``b``."""
    return a * a / (a * a + b * b)


@wp.func
def highlight_weight(s: Surface, wo: wp.vec3, light: LightSample, direct: Direct) -> float:
    """Power-heuristic share of a light sample in the highlight; the specular pass's rays have the rest."""
    if direct.glossy == 0 or s.alpha > direct.alpha_max or light.pdf <= 0.0:
        return 1.0
    return power_share(float(direct.samples) * light.pdf, float(direct.glossy) * vndf_pdf(s, wo, light.direction))


@wp.func
def beyond(normal: wp.vec3, toward: wp.vec3, extent: wp.vec3) -> bool:
    """Whether a box is wholly on the positive side of a plane through a point; ``toward`` leads to its middle."""
    across = wp.abs(normal)
    size = wp.abs(toward) + extent
    # Sums of components instead of lengths: never less, and no roots.
    margin = (across[0] + across[1] + across[2]) * (size[0] + size[1] + size[2]) * BOX_MARGIN
    return wp.dot(toward, normal) - wp.dot(extent, across) > margin


@wp.func
def beyond_sides(lights: Lights, i: int, to_light: wp.vec3, toward: wp.vec3, extent: wp.vec3) -> bool:
    """Whether a box is outside a side of the pyramid that the parallelogram of a RECT or DISK spans with a point."""
    ax = lights.axis_x[i]
    ay = lights.axis_y[i]
    turn = wp.sign(wp.dot(wp.cross(ax, ay), to_light))
    return (
        beyond(wp.cross(to_light + ay, ax) * turn, toward, extent)
        or beyond(wp.cross(to_light - ay, ax) * -turn, toward, extent)
        or beyond(wp.cross(to_light + ax, ay) * -turn, toward, extent)
        or beyond(wp.cross(to_light - ax, ay) * turn, toward, extent)
    )


@wp.func
def box_may_shadow(center: wp.vec3, extent: wp.vec3, lights: Lights, i: int, position: wp.vec3) -> bool:
    """Whether a box may meet a segment from a point to a light.

    False only where a plane parts the box from the hull of point and light: one across the way to the box, a side of
    the pyramid over a planar light, or a face of the box.
    """
    toward = center - position
    axis = -lights.direction[i]
    sine2 = lights.cap[i] * (2.0 - lights.cap[i])
    if lights.kind[i] != DISTANT:
        to_light = lights.position[i] - position
        far2 = wp.length_sq(to_light)
        size = wp.abs(lights.axis_x[i]) + wp.abs(lights.axis_y[i])
        bound = lights.bound[i]
        if far2 <= bound * bound:
            return True
        size = size + wp.vec3(lights.radius[i], lights.radius[i], lights.radius[i])
        gap = wp.max(wp.vec3(0.0, 0.0, 0.0), to_light + size)
        room = extent + BOX_MARGIN * (wp.abs(toward) + wp.abs(to_light) + size + extent)
        if toward[0] - room[0] > gap[0] or toward[1] - room[1] > gap[1] or toward[2] - room[2] > gap[2]:
            return False
        gap = wp.min(wp.vec3(0.0, 0.0, 0.0), to_light - size)
        if toward[0] + room[0] < gap[0] or toward[1] + room[1] < gap[1] or toward[2] + room[2] < gap[2]:
            return False
        if lights.kind[i] == RECT or lights.kind[i] == DISK:
            if beyond_sides(lights, i, to_light, toward, extent):
                return False
        axis = to_light / wp.sqrt(far2)
        sine2 = bound * bound / far2
    elif lights.cap[i] >= 1.0:
        return True
    # All ways to the light are within a cone; this plane touches it on the side of the box. Where the box lies on the
    # cone's axis no side is its own: what is left of the difference is rounding, and may point anywhere.
    across = toward - axis * wp.dot(toward, axis)
    if wp.length_sq(across) <= ON_AXIS * wp.length_sq(toward):
        return True
    across = wp.normalize(across)
    return not beyond(across * wp.sqrt(1.0 - sine2) - axis * wp.sqrt(sine2), toward, extent)


@wp.func
def may_shadow(geo: Geometry, lights: Lights, i: int, position: wp.vec3) -> bool:
    """Whether synthetic objects may lie between a point and a light, by the box around them."""
    return box_may_shadow(geo.center, geo.extent, lights, i, position)


@wp.func
def may_be_hidden(geo: Geometry, lights: Lights, i: int, position: wp.vec3) -> bool:
    """Whether real surfaces may lie between a point on a surface and a light, by the box around the blockers."""
    if geo.has_blockers == 0:
        return False
    return box_may_shadow(geo.blockers_center, geo.blockers_extent, lights, i, position)


@wp.func
def reflected(s: Surface, wo: wp.vec3, light: LightSample, direct: Direct) -> wp.vec3:
    """Radiance that an unshadowed light sample makes the surface send to the viewer."""
    f = brdf_cos_diffuse(s, wo, light.direction)
    if s.f90 > 0.0:
        f += brdf_cos_specular(s, wo, light.direction) * highlight_weight(s, wo, light, direct)
    return wp.cw_mul(light.value, f)


@wp.struct
class Part:
    """One light at one point: after, or after - before and before."""

    light: wp.vec3
    before: wp.vec3


@wp.struct
class Sight:
    """What a shadow ray says: the light is seen in the real scene, and in the whole one (1 or 0)."""

    before: wp.float32
    after: wp.float32


@wp.func
def look(
    geo: Geometry, origin: wp.vec3, direction: wp.vec3, reach: float, before: bool, shadowed: bool, hides: bool
) -> Sight:
    """Trace a shadow ray to a light. ``before`` is as ``after`` unless asked for: what objects hide then needs no
    second ray. ``shadowed``, ``hides``: Whether objects, and real surfaces, may be in the way."""
    blocked = bool(False)
    if shadowed:
        blocked = occluded_by_synthetic(geo, origin, direction, reach)
    hidden = bool(False)
    if hides and (before or not blocked):
        hidden = blocked_by_real(geo, origin, direction, reach)
    sight = Sight()
    sight.after = wp.where(blocked or hidden, 0.0, 1.0)
    sight.before = sight.after
    if before:
        sight.before = wp.where(hidden, 0.0, 1.0)
    return sight


@wp.func
def unlit(lights: Lights, k: int, position: wp.vec3, normal: wp.vec3) -> bool:
    """Whether a light lies wholly behind a surface or emits away from it, and so sends nothing, whatever is between."""
    if lights.kind[k] == DISTANT:
        # The sine of the half angle follows from its cap: the square is cap times (2 - cap).
        cap = lights.cap[k]
        return -wp.dot(lights.direction[k], normal) < -wp.sqrt(wp.max(cap * (2.0 - cap), 0.0)) - UNLIT_MARGIN
    to_light = lights.position[k] - position
    bound = lights.bound[k]
    away = wp.abs(to_light)
    margin = UNLIT_MARGIN * (bound + away[0] + away[1] + away[2])
    if wp.dot(to_light, normal) < -bound - margin:
        return True
    planar = lights.kind[k] == RECT or lights.kind[k] == DISK
    return planar and wp.dot(to_light, lights.direction[k]) > margin


@wp.struct
class Draw:
    """Which light samples a point takes: numbers ``first`` to ``first + samples`` of the picture's sequence."""

    first: wp.int32
    samples: wp.int32
    probes: wp.int32


@wp.func
def draw_of(points: Points, i: int, direct: Direct) -> Draw:
    draw = Draw()
    draw.samples = share_of(direct.samples, points, i, direct.edge_samples)
    draw.first = first_sample(direct.samples, draw.samples, 1, points, i)
    draw.probes = wp.min(direct.probes, draw.samples)
    return draw


@wp.func
def drawn_light(lights: Lights, k: int, s: Surface, draw: Draw, count: int, direct: Direct) -> LightSample:
    return sample_light(lights, k, s.position, sobol2(direct.seed, 0, draw.first + count, 2 * k + 3))


@wp.func
def light_taken(s: Surface, wo: wp.vec3, draw: Draw, geo: Geometry, lights: Lights, k: int, direct: Direct) -> wp.vec3:
    """The light of one lamp that synthetic objects take from a real surface.

    Samples that no object blocks take nothing, so neither their light nor what is behind them is asked for. The first
    few decide, as in ``light_part``: where none is blocked, or all are and real surfaces treat them alike, the others
    are not traced.
    """
    taken = wp.vec3(0.0, 0.0, 0.0)
    hides = may_be_hidden(geo, lights, k, s.position)
    lit = bool(False)
    passed = int(0)
    blocked = int(0)
    seen = int(0)
    samples = int(draw.samples)
    tracing = bool(True)
    count = int(0)
    while count < samples:
        light = drawn_light(lights, k, s, draw, count, direct)
        origin = spawn_point(s, light.direction)
        reach = light.distance * SHADOW_END
        meets = bool(True)
        if tracing:
            meets = occluded_by_synthetic(geo, origin, light.direction, reach)
        if not meets:
            passed += 1
        if meets or not lit:
            f = reflected(s, wo, light, direct)
            if wp.max(f[0], wp.max(f[1], f[2])) > 0.0:
                lit = True
                if meets:
                    blocked += 1
                    hidden = bool(False)
                    if tracing and hides:
                        hidden = blocked_by_real(geo, origin, light.direction, reach)
                    if not hidden:
                        seen += 1
                        taken += f
        count += 1
        if light.pdf <= 0.0:
            samples = 1  # a light without extent: every sample is this one
        elif count == draw.probes and lit:
            if blocked == 0 or (passed == 0 and seen == 0):
                return wp.vec3(0.0, 0.0, 0.0)
            tracing = passed > 0 or seen < blocked
    return taken / float(samples)


@wp.func
def light_part(
    draw: Draw,
    s: Surface,
    wo: wp.vec3,
    geo: Geometry,
    lights: Lights,
    k: int,
    direct: Direct,
    both: bool,
    shadowed: bool,
) -> Part:
    """One light by shadow rays: after, or (``both``) before and what is between them. The first few decide: where they
    agree the light is wholly seen or hidden, and the rest of the samples only integrate the unshadowed light; where
    they do not, all samples are traced."""
    open = wp.vec3(0.0, 0.0, 0.0)
    sum_before = wp.vec3(0.0, 0.0, 0.0)
    sum_after = wp.vec3(0.0, 0.0, 0.0)
    seen_before = float(0.0)
    seen_after = float(0.0)
    traced = int(0)
    body = body_left(geo, s)
    hides = may_be_hidden(geo, lights, k, s.position)
    samples = int(draw.samples)
    tracing = bool(True)
    count = int(0)
    while count < samples:
        light = drawn_light(lights, k, s, draw, count, direct)
        f = reflected(s, wo, light, direct)
        open += f
        if tracing and wp.max(f[0], wp.max(f[1], f[2])) > 0.0:
            origin = spawn_point(s, light.direction)
            reach = light.distance * SHADOW_END
            meets = shadowed and not clear_of_objects(geo, body, s.normal_g, origin, light.direction, reach)
            sight = look(geo, origin, light.direction, reach, both, meets, hides)
            sum_before += f * sight.before
            sum_after += f * sight.after
            seen_before += sight.before
            seen_after += sight.after
            traced += 1
        count += 1
        if light.pdf <= 0.0:
            samples = 1  # a light without extent: every sample is this one
        elif tracing and count == draw.probes and traced > 0:
            n = float(traced)
            tracing = (seen_before > 0.0 and seen_before < n) or (seen_after > 0.0 and seen_after < n)
    if not tracing:
        # The probes agree: they stand for the samples that were not traced.
        n = float(traced)
        sum_before = open * (seen_before / n)
        sum_after = open * (seen_after / n)
    part = Part()
    scale = 1.0 / float(samples)
    part.light = sum_after * scale
    if both:
        part.before = sum_before * scale
        part.light = (sum_after - sum_before) * scale
    return part


@wp.func
def may_change(geo: Geometry, lights: Lights, position: wp.vec3, normal: wp.vec3) -> bool:
    """Whether any light but domes may differ between before and after at a real surface."""
    for k in range(lights.count):
        if lights.kind[k] != DOME and not unlit(lights, k, position, normal):
            if lights.role[k] == ADDED or may_shadow(geo, lights, k, position):
                return True
    return False


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
    if role == BACKGROUND or points.slot[i] == UNSEEN:
        return
    # Asked before the rest of the surface is loaded: at most points of a picture the answer is no.
    if role == REAL and direct.with_before == 0:
        if not may_change(geo, lights, points.position[i], points.normal_g[i]):
            return
    s = load_surface(points, i)
    wo = points.view[i]
    draw = draw_of(points, i, direct)
    total = wp.vec3(0.0, 0.0, 0.0)
    before = wp.vec3(0.0, 0.0, 0.0)
    for k in range(lights.count):
        if lights.kind[k] != DOME and not unlit(lights, k, s.position, s.normal_g):
            added = lights.role[k] == ADDED
            shadowed = role == SYNTHETIC or may_shadow(geo, lights, k, s.position)
            whole = role == SYNTHETIC or added
            if whole or direct.with_before != 0:
                part = light_part(draw, s, wo, geo, lights, k, direct, not whole, shadowed)
                total += part.light
                before += part.before
            elif shadowed:
                total -= light_taken(s, wo, draw, geo, lights, k, direct)
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
    result = march_cone(fine, coarse, has_coarse, origin, axis, wp.vec4(0.0, 0.0, 0.0, 0.0), shaft)
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
    if role == BACKGROUND or points.slot[i] == UNSEEN:
        return
    s = load_surface(points, i)
    wo = points.view[i]
    draw = draw_of(points, i, direct)
    total = wp.vec3(0.0, 0.0, 0.0)
    before = wp.vec3(0.0, 0.0, 0.0)
    for k in range(lights.count):
        if lights.kind[k] != DOME:
            open = wp.vec3(0.0, 0.0, 0.0)
            for j in range(draw.samples):
                light = drawn_light(lights, k, s, draw, j, direct)
                open += reflected(s, wo, light, direct) / float(draw.samples)
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

"""Further bounces: points of the cloud compete for the slots of the next set of VPLs (Knecht et al. 2012, 3.6, 3.7)."""

import warp as wp

from warp_dvct.kernels.geometry import OFFSET_RELATIVE, Geometry, occluded_by_real, occluded_by_synthetic
from warp_dvct.kernels.ism import ALL, RAY_END, Cloud, Sight, map_sight, ray_sight
from warp_dvct.kernels.sampling import INV_PI, luminance, sobol1, uniform1
from warp_dvct.kernels.vpls import SURFACE, Vpls

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NEAREST = wp.constant(1.0e-12)
ONE_PLANE = wp.constant(0.1)  # of the offset of rays: what a distance within it may be by rounding


@wp.struct
class Sources:
    """The VPLs that shine, and how they are asked."""

    start: wp.int32
    count: wp.int32
    draws: wp.int32  # that each candidate tries
    seed: wp.int32
    reach: wp.float32
    cdf: wp.array(dtype=wp.float32)  # count + 1, of their flux


@wp.struct
class Candidates:
    """What the points of a cloud send on of one class of light; the flags are those of a path drawn by flux."""

    flux: wp.array(dtype=wp.vec3)
    real: wp.array(dtype=wp.int32)
    hidden: wp.array(dtype=wp.int32)
    flipped: wp.array(dtype=wp.int32)


@wp.struct
class Candidate:
    """Flux that a point would send on, and the flags of its path (9, 10)."""

    flux: wp.vec3
    real: wp.int32
    hidden: wp.int32
    flipped: wp.int32


@wp.func
def find_source(cdf: wp.array(dtype=wp.float32), count: int, u: float) -> int:
    low = int(0)
    high = int(count)
    while high - low > 1:
        middle = (low + high) / 2
        if cdf[middle] <= u:
            low = middle
        else:
            high = middle
    return low


@wp.func
def covered(geo: Geometry, position: wp.vec3, normal: wp.vec3, synthetic: int, reach: float) -> bool:
    """Whether a surface of the other role lies on a point, or in front of it by less than where its rays begin.

    Those rays do not meet it, and the light of one place would be counted on both. Of faces in one plane the real one
    has the light, as it is the one that the camera sees.
    """
    off = OFFSET_RELATIVE * reach
    origin = position + normal * off
    if synthetic != 0:
        return occluded_by_real(geo, origin, -normal, off * (1.0 + ONE_PLANE))
    return occluded_by_synthetic(geo, origin, -normal, off * (1.0 - ONE_PLANE))


@wp.func
def light_point(
    geo: Geometry, vpls: Vpls, sight: Sight, k: int, position: wp.vec3, normal_in: wp.vec3, synthetic: int, reach: float
) -> Candidate:
    """Irradiance at a point by VPL k as ``flux``, and the path's flags: x' = x r(p), ir is handed on (9, 10)."""
    out = Candidate()
    normal = normal_in
    d = vpls.position[k] - position
    if wp.dot(d, normal) < 0.0:
        normal = -normal
        out.flipped = 1
    origin = position + normal * (OFFSET_RELATIVE * reach)
    d = vpls.position[k] - origin
    d2 = wp.length_sq(d)
    if d2 <= NEAREST or (vpls.hidden[k] != 0 and synthetic != 0):
        return out
    distance = wp.sqrt(d2)
    direction = d / distance
    form = -wp.dot(direction, vpls.normal[k]) * wp.dot(direction, normal)
    if form <= 0.0 or wp.dot(direction, normal) <= 0.0:
        return out
    open = wp.vec2(1.0, 1.0)
    if sight.rays != 0:
        open = ray_sight(geo, sight, origin, direction, distance * RAY_END, 1, ALL)
    else:
        open = map_sight(vpls, k, sight, origin)
    if open[0] == 0.0:
        return out
    if covered(geo, position, normal, synthetic, reach):
        if synthetic != 0:
            return out
        open[1] = 0.0
    light = vpls.flux[k] * (form * INV_PI / (d2 + vpls.spread[k] * vpls.spread[k]))
    if vpls.hidden[k] != 0:
        out.real = 1
        out.hidden = 1
        out.flux = light
    elif open[1] > 0.0:
        out.real = wp.where(synthetic == 0, vpls.real[k], 0)
        out.flux = light
    elif vpls.real[k] != 0 and synthetic == 0:
        # A synthetic blocker: in the picture before, the light goes on.
        out.real = 1
        out.hidden = 1
        out.flux = light
    return out


@wp.kernel
def _light_candidates(
    first: int,
    geo: Geometry,
    cloud: Cloud,
    sight: Sight,
    sources: Sources,
    vpls: Vpls,
    common_out: Candidates,
    changed_out: Candidates,
):
    """Every point of the cloud draws VPLs of the bounce before by their flux: the light of both solutions that it
    sends on, and that of one alone."""
    p = first + wp.tid()
    common = wp.vec3(0.0, 0.0, 0.0)
    changed = wp.vec3(0.0, 0.0, 0.0)
    common_flipped = int(0)
    changed_flipped = int(0)
    real = int(0)
    hidden = int(0)
    for draw in range(sources.draws):
        j = find_source(sources.cdf, sources.count, sobol1(sources.seed, p, draw, 45))
        chance = sources.cdf[j + 1] - sources.cdf[j]
        lit = light_point(
            geo,
            vpls,
            sight,
            sources.start + j,
            cloud.position[p],
            cloud.normal[p],
            cloud.synthetic[p],
            sources.reach,
        )
        leaving = wp.cw_mul(lit.flux, cloud.albedo[p]) * (
            cloud.area[p] / (wp.max(chance, 1.0e-20) * float(sources.draws))
        )
        if luminance(leaving) > 0.0:
            u = uniform1(sources.seed, p, draw, 46)
            if lit.real != 0 and lit.hidden == 0:
                common += leaving
                if u * luminance(common) < luminance(leaving):
                    common_flipped = lit.flipped
            else:
                changed += leaving
                if u * luminance(changed) < luminance(leaving):
                    changed_flipped = lit.flipped
                    real = lit.real
                    hidden = lit.hidden
    common_out.flux[p] = common
    common_out.real[p] = 1
    common_out.hidden[p] = 0
    common_out.flipped[p] = common_flipped
    changed_out.flux[p] = changed
    changed_out.real[p] = real
    changed_out.hidden[p] = hidden
    changed_out.flipped[p] = changed_flipped


@wp.kernel
def _fill_slots(
    first: int,
    cloud: Cloud,
    candidates: Candidates,
    chosen_in: wp.array(dtype=wp.int32),
    gain_in: wp.array(dtype=wp.float32),
    strongest: int,
    start: int,
    reach: float,
    vpls: Vpls,
):
    """Slot i gets the place and the flags of its candidate, and the flux of all that it stands for."""
    i = first + wp.tid()
    at = start + i
    p = chosen_in[i]
    normal = wp.where(candidates.flipped[p] != 0, -cloud.normal[p], cloud.normal[p])
    vpls.kind[at] = SURFACE
    vpls.position[at] = cloud.position[p] + normal * (OFFSET_RELATIVE * reach)
    vpls.normal[at] = normal
    vpls.flux[at] = candidates.flux[p] * gain_in[i]
    vpls.real[at] = candidates.real[p]
    vpls.hidden[at] = candidates.hidden[p]
    vpls.spread[at] = 0.0
    if strongest != 0:
        # Its neighbours do not tell its share of the surface, as they lie where light is strong. Its flux over the
        # radiosity of its place does.
        vpls.spread[at] = wp.sqrt(gain_in[i] * cloud.area[p] * INV_PI)

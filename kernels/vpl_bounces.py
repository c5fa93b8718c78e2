"""Further bounces: points of the cloud compete for the slots of the next set of VPLs (Knecht et al. 2012, 3.6, 3.7)."""

import warp as wp

from warp_dvct.kernels.geometry import OFFSET_RELATIVE, Geometry
from warp_dvct.kernels.ism import ALL, RAY_END, Cloud, Sight, map_sight, ray_sight
from warp_dvct.kernels.sampling import INV_PI, luminance, sobol1, uniform1
from warp_dvct.kernels.vpls import SURFACE, Vpls

wp.set_module_options({"enable_backward": False})

NEAREST = wp.constant(1.0e-12)


@wp.struct
class Slots:
    """Which VPLs shine, which are made, and how candidates compete."""

    source_first: wp.int32
    source_count: wp.int32
    start: wp.int32  # first slot
    count: wp.int32
    sources: wp.int32  # VPLs that each candidate tries
    strongest: wp.int32  # 1: the strongest candidate's place stands for all; 0: one drawn in proportion to its flux
    seed: wp.int32
    reach: wp.float32


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
def _bounce_vpls(
    first: int, geo: Geometry, cloud: Cloud, sight: Sight, slots: Slots, cdf_in: wp.array(dtype=wp.float32), vpls: Vpls
):
    """Slot i: every ``count``-th point of the cloud is a candidate and draws VPLs of the bounce before by their flux.

    One candidate gets the slot and the flux of all of them, so the light that bounces on is kept.
    """
    i = first + wp.tid()
    at = slots.start + i
    total = float(0.0)
    best = float(0.0)
    flux = wp.vec3(0.0, 0.0, 0.0)
    position = wp.vec3(0.0, 0.0, 0.0)
    normal = wp.vec3(0.0, 0.0, 1.0)
    real = int(0)
    hidden = int(0)
    p = i
    draw = int(0)
    while p < cloud.count:
        for _n in range(slots.sources):
            u = sobol1(slots.seed, at, draw, 45)
            j = find_source(cdf_in, slots.source_count, u)
            chance = cdf_in[j + 1] - cdf_in[j]
            lit = light_point(
                geo,
                vpls,
                sight,
                slots.source_first + j,
                cloud.position[p],
                cloud.normal[p],
                cloud.synthetic[p],
                slots.reach,
            )
            share = cloud.area[p] / (wp.max(chance, 1.0e-20) * float(slots.sources))
            leaving = wp.cw_mul(lit.flux, cloud.albedo[p]) * share
            weight = luminance(leaving)
            if weight > 0.0:
                total += weight
                take = uniform1(slots.seed, at, draw, 46) * total < weight
                if slots.strongest != 0:
                    take = weight > best
                if take:
                    best = weight
                    flux = leaving
                    normal = wp.where(lit.flipped != 0, -cloud.normal[p], cloud.normal[p])
                    position = cloud.position[p]
                    real = lit.real
                    hidden = lit.hidden
            draw += 1
        p += slots.count
    vpls.kind[at] = SURFACE
    vpls.position[at] = position + normal * (OFFSET_RELATIVE * slots.reach)
    vpls.normal[at] = normal
    vpls.flux[at] = flux * (total / wp.max(best, 1.0e-30))
    vpls.real[at] = real
    vpls.hidden[at] = hidden
    vpls.spread[at] = 0.0

"""Imperfect shadow maps: per VPL a parabolic depth map of real and one of synthetic points.

Ritschel et al. 2008, "Imperfect Shadow Maps for Efficient Computation of Indirect Illumination", with the splats
aligned to their surfaces and the pair per VPL of Knecht et al. 2012. Maps hold inverse depth, 0 where nothing is: it is
nearly linear over a plane's image, so it can be interpolated and averaged. VPLs on the sky have no maps: through a hole
in one the sky would come into a closed room, and exact rays towards them cost no more than drawing the maps.
"""

import warp as wp

from warp_dvct.kernels.geometry import (
    Geometry,
    Hit,
    corner_position,
    occluded_by_real,
    occluded_by_synthetic,
    trace_real,
    trace_synthetic,
)
from warp_dvct.kernels.materials import (
    ALPHA_FLOOR,
    GRAZING_GAIN,
    Materials,
    Surface,
    hemispherical_albedo,
    surface_at,
)
from warp_dvct.kernels.sampling import sobol2, tangent_of
from warp_dvct.kernels.vpls import Vpls

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

RAY_END = wp.constant(0.9999)  # of the way to a VPL, whose own surface is not in its way
STEEPEST = wp.constant(1.0e-3)  # cosine at which a splat is seen edge-on and left out
WIDEST = wp.constant(3.0)  # largest angle from the map's axis that a splat's outline is followed to [rad]
OVERHANG = wp.constant(3.0)  # distance in radii up to which the back of a splat is taken for an overhang
FILLED = wp.constant(0.7)  # share of covered texels from which a coarse texel fills the holes inside of it
# Which answers of a visibility test are needed.
ALL = wp.constant(0)
CHANGE = wp.constant(1)
AFTER = wp.constant(2)
SAME_SURFACE = wp.constant(0.85)  # ratio of the depths of neighbouring texels up to which they are interpolated


@wp.struct
class Cloud:
    """Points on surfaces, structure of arrays; ``block`` of them belong to a VPL, a block after the other."""

    count: wp.int32
    block: wp.int32
    position: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    radius: wp.array(dtype=wp.float32)  # of the disc that a point of a block stands for
    area: wp.array(dtype=wp.float32)  # that a point of the whole cloud stands for
    albedo: wp.array(dtype=wp.vec3)
    synthetic: wp.array(dtype=wp.int32)


@wp.struct
class Dots:
    """Points that a scan gives, structure of arrays."""

    position: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    radius: wp.array(dtype=wp.float32)
    material: wp.array(dtype=wp.int32)
    color: wp.array(dtype=wp.vec3)


@wp.struct
class Pieces:
    """What points are drawn from: parts of triangles, as weights of the triangle's first two corners, and dots."""

    count: wp.int32
    triangle: wp.array(dtype=wp.int32)  # or -1 - the index of a dot
    a: wp.array(dtype=wp.vec2)
    b: wp.array(dtype=wp.vec2)
    c: wp.array(dtype=wp.vec2)
    cdf: wp.array(dtype=wp.float64)  # count + 1
    area: wp.array(dtype=wp.float32)


@wp.struct
class Ism:
    """Maps of the VPLs from ``first`` on, two each, that of real points before that of synthetic ones; coarse levels
    follow the finest."""

    first: wp.int32
    size: wp.int32
    levels: wp.int32  # that pull-push uses, the finest included
    stride: wp.int32
    bias: wp.float32  # relative depth by which a blocker must be nearer than the receiver
    inverse: wp.array(dtype=wp.float32)


@wp.struct
class Sight:
    """How visibility is found."""

    rays: wp.int32  # 1: exact rays, 0: imperfect shadow maps, but rays towards the sky
    single: wp.int32  # 1: one map of the nearest surface of either role, as in 2010
    ism: Ism


@wp.struct
class Place:
    """Where a point falls in a VPL's map, and the inverse depth of a blocker that is near enough to hide it; 0 where
    the map does not show it."""

    x: wp.float32
    y: wp.float32
    limit: wp.float32


@wp.func
def local_to(v: wp.vec3, axis: wp.vec3) -> wp.vec3:
    t = tangent_of(axis)
    return wp.vec3(wp.dot(v, t), wp.dot(v, wp.cross(axis, t)), wp.dot(v, axis))


@wp.func
def place_in_map(vpls: Vpls, k: int, ism: Ism, position: wp.vec3) -> Place:
    """Continuous texel coordinates, and what a blocker's inverse depth there has to exceed."""
    out = Place()
    half = 0.5 * float(ism.size)
    v = local_to(position - vpls.position[k], vpls.normal[k])
    d = wp.length(v)
    if v[2] > 0.0:
        scale = 1.0 / (d + v[2])
        out.x = (v[0] * scale + 1.0) * half
        out.y = (v[1] * scale + 1.0) * half
        out.limit = (1.0 + ism.bias) / d
    return out


@wp.func
def dot_albedo(mats: Materials, material: int, color: wp.vec3) -> wp.vec3:
    """Reflectance of a point, which has no texture coordinates."""
    s = Surface()
    base = wp.cw_mul(mats.base_color[material], color)
    s.diffuse = base * (1.0 - mats.metallic[material])
    s.f0 = wp.lerp(mats.f0[material], base, mats.metallic[material])
    s.f90 = wp.min(GRAZING_GAIN * wp.max(s.f0[0], wp.max(s.f0[1], s.f0[2])), 1.0)
    s.alpha = wp.max(mats.roughness[material] * mats.roughness[material], ALPHA_FLOOR)
    return hemispherical_albedo(s)


@wp.kernel
def _sample_surface(
    first: int,
    pieces: Pieces,
    dots: Dots,
    geo: Geometry,
    mats: Materials,
    synthetic: int,
    block: int,
    seed: int,
    cloud_out: Cloud,
):
    """Point i of a scrambled sequence over all pieces: each aligned block of 2^k points is stratified by itself.

    Dots are taken as they are, and only grow where a block has room for fewer than there are.
    """
    i = first + wp.tid()
    u = sobol2(seed, synthetic, i, 41)
    x = wp.float64(u[0])
    low = int(0)
    high = int(pieces.count)
    while high - low > 1:
        middle = (low + high) // 2
        if pieces.cdf[middle] <= x:
            low = middle
        else:
            high = middle
    chance = pieces.cdf[low + 1] - pieces.cdf[low]
    share = pieces.area[low] / float(chance)
    radius = wp.sqrt(share / (3.14159265 * float(block)))
    cloud_out.area[i] = share / float(cloud_out.count)
    cloud_out.radius[i] = radius
    cloud_out.synthetic[i] = synthetic
    if pieces.triangle[low] < 0:
        dot = -1 - pieces.triangle[low]
        cloud_out.position[i] = dots.position[dot]
        cloud_out.normal[i] = dots.normal[dot]
        cloud_out.radius[i] = wp.max(radius, dots.radius[dot])
        cloud_out.albedo[i] = dot_albedo(mats, dots.material[dot], dots.color[dot])
        return
    # The square root makes it uniform over the triangle; the number that chose the piece serves again inside of it.
    r = wp.sqrt(float((x - pieces.cdf[low]) / chance))
    weights = pieces.a[low] * (1.0 - r) + pieces.b[low] * (r * (1.0 - u[1])) + pieces.c[low] * (r * u[1])
    hit = Hit()
    hit.found = 1
    hit.triangle = pieces.triangle[low]
    hit.u = weights[0]
    hit.v = weights[1]
    hit.synthetic = synthetic
    p = corner_position(geo, hit.triangle, 0)
    normal = wp.normalize(
        wp.cross(corner_position(geo, hit.triangle, 1) - p, corner_position(geo, hit.triangle, 2) - p)
    )
    s = surface_at(geo, mats, hit, p, -normal)
    cloud_out.position[i] = s.position
    cloud_out.normal[i] = s.normal_g
    cloud_out.albedo[i] = hemispherical_albedo(s)


@wp.func
def splat(ism: Ism, start: int, v: wp.vec3, m: wp.vec3, radius: float):
    """Draw a disc into a parabolic map; ``v`` and ``m`` are its centre and normal in the map's frame."""
    distance = wp.length(v)
    if distance <= 0.0:
        return
    theta = wp.acos(wp.clamp(v[2] / distance, -1.0, 1.0))
    angle = wp.asin(wp.min(radius / distance, 1.0))
    # The parabolic map is stereographic: the outline of the disc's bounding sphere is a circle in it.
    near = wp.tan(0.5 * wp.max(theta - angle, -WIDEST))
    far = wp.tan(0.5 * wp.min(theta + angle, WIDEST))
    along = wp.vec2(v[0], v[1])
    flat = wp.length(along)
    if flat > 0.0:
        along = along / flat
    half = 0.5 * float(ism.size)
    r = 0.5 * (far - near) * half
    cx = (along[0] * 0.5 * (near + far) + 1.0) * half
    cy = (along[1] * 0.5 * (near + far) + 1.0) * half
    plane = wp.dot(v, m)
    x0 = wp.max(int(wp.floor(cx - r)), 0)
    x1 = wp.min(int(wp.floor(cx + r)), ism.size - 1)
    y0 = wp.max(int(wp.floor(cy - r)), 0)
    y1 = wp.min(int(wp.floor(cy + r)), ism.size - 1)
    radius2 = radius * radius
    for y in range(y0, y1 + 1):
        t = (float(y) + 0.5) / half - 1.0
        for x in range(x0, x1 + 1):
            s = (float(x) + 0.5) / half - 1.0
            rho = s * s + t * t
            if rho < 1.0:
                direction = wp.vec3(2.0 * s, 2.0 * t, 1.0 - rho) / (1.0 + rho)
                facing = wp.dot(direction, m)
                if wp.abs(facing) > STEEPEST:
                    depth = plane / facing
                    if depth > 0.0 and wp.length_sq(direction * depth - v) <= radius2:
                        # Of the parts of a map's points, whichever comes first: the nearest stays.
                        wp.atomic_max(ism.inverse, start + y * ism.size + x, 1.0 / depth)


@wp.kernel
def _splat_points(
    first: int, map_first: int, parts: int, vpls: Vpls, real: Cloud, synthetic: Cloud, grow: float, ism: Ism
):
    """One of ``parts`` parts of the points of a VPL's block, as discs grown by ``grow``. On the CPU there is one, whose
    thread has the map to itself: atomic functions are not atomic there."""
    part = (first + wp.tid()) % parts
    i = map_first + (first + wp.tid()) / parts
    k = ism.first + i / 2
    cloud = real
    if i % 2 == 1:
        cloud = synthetic
    if cloud.count == 0 or wp.length_sq(vpls.flux[k]) == 0.0:
        return
    start = i * ism.stride
    axis = vpls.normal[k]
    offset = (k % (cloud.count / cloud.block)) * cloud.block
    for j in range(offset + cloud.block * part / parts, offset + cloud.block * (part + 1) / parts):
        radius = cloud.radius[j] * grow
        m = local_to(cloud.normal[j], axis)
        v = local_to(cloud.position[j] - vpls.position[k], axis)
        # A disc reaches beyond a convex edge. Where it hangs over the VPL its back shows, and it would hide all.
        overhangs = wp.dot(v, m) > 0.0 and wp.length_sq(v) < OVERHANG * OVERHANG * radius * radius
        if v[2] > -radius and not overhangs:
            splat(ism, start, v, m, radius)


@wp.func
def level_start(size: int, level: int) -> int:
    """Texels of the levels before ``level``."""
    start = int(0)
    for k in range(level):
        start += (size >> k) * (size >> k)
    return start


@wp.kernel
def _pull(first: int, map_first: int, ism: Ism, level: int, inverse_out: wp.array(dtype=wp.float32)):
    """A coarse texel: the mean of the filled ones of its four, or 0 where fewer than half are."""
    i = first + wp.tid()
    size = ism.size >> level
    per_map = size * size
    base = (map_first + i / per_map) * ism.stride
    x = 2 * ((i % per_map) % size)
    y = 2 * ((i % per_map) / size)
    fine = base + level_start(ism.size, level - 1)
    total = float(0.0)
    filled = float(0.0)
    for k in range(4):
        value = ism.inverse[fine + (y + k / 2) * 2 * size + x + k % 2]
        if value > 0.0:
            total += value
            filled += 0.25
    value = float(0.0)
    if filled > FILLED:
        value = 0.25 * total / filled
    inverse_out[base + level_start(ism.size, level) + i % per_map] = value


@wp.kernel
def _push(first: int, map_first: int, ism: Ism, level: int, inverse_out: wp.array(dtype=wp.float32)):
    """A hole in ``level`` takes the value of its texel in the coarser one."""
    i = first + wp.tid()
    size = ism.size >> level
    per_map = size * size
    base = (map_first + i / per_map) * ism.stride
    x = (i % per_map) % size
    y = (i % per_map) / size
    at = base + level_start(ism.size, level) + i % per_map
    if ism.inverse[at] == 0.0:
        inverse_out[at] = ism.inverse[base + level_start(ism.size, level + 1) + (y / 2) * (size / 2) + x / 2]


@wp.func
def map_texel(ism: Ism, start: int, x: int, y: int) -> float:
    return ism.inverse[start + wp.clamp(y, 0, ism.size - 1) * ism.size + wp.clamp(x, 0, ism.size - 1)]


@wp.func
def inverse_at(ism: Ism, start: int, place: Place) -> float:
    """Inverse depth in a map: interpolated over one surface, the farthest of four texels across its edge.

    Where a surface is seen at a grazing angle its depth falls from infinity to near within a texel; the farthest keeps
    it from hiding itself.
    """
    x = place.x - 0.5
    y = place.y - 0.5
    x0 = int(wp.floor(x))
    y0 = int(wp.floor(y))
    fx = x - float(x0)
    fy = y - float(y0)
    a = map_texel(ism, start, x0, y0)
    b = map_texel(ism, start, x0 + 1, y0)
    c = map_texel(ism, start, x0, y0 + 1)
    d = map_texel(ism, start, x0 + 1, y0 + 1)
    low = wp.min(wp.min(a, b), wp.min(c, d))
    high = wp.max(wp.max(a, b), wp.max(c, d))
    if low >= high * SAME_SURFACE:
        return wp.lerp(wp.lerp(a, b, fx), wp.lerp(c, d, fx), fy)
    return low


@wp.func
def map_sight(vpls: Vpls, k: int, sight: Sight, position: wp.vec3) -> wp.vec2:
    """Whether VPL k sees a point past real surfaces (x), and past synthetic ones (y), by its two maps: 1 or 0."""
    ism = sight.ism
    place = place_in_map(vpls, k, ism, position)
    if place.limit <= 0.0:
        return wp.vec2(1.0, 1.0)
    start = 2 * (k - ism.first) * ism.stride
    real = inverse_at(ism, start, place)
    synthetic = inverse_at(ism, start + ism.stride, place)
    s_real = wp.where(real > place.limit, 0.0, 1.0)
    s_synthetic = wp.where(synthetic > place.limit, 0.0, 1.0)
    if sight.single != 0 and s_synthetic == 0.0 and synthetic > real:
        s_real = 1.0  # one map shows the nearest blocker alone
    return wp.vec2(s_real, s_synthetic)


@wp.func
def ray_sight(
    geo: Geometry, sight: Sight, origin: wp.vec3, direction: wp.vec3, t_max: float, ask_synthetic: int, need: int
) -> wp.vec2:
    """As :func:`map_sight` by exact rays.

    Args:
        ask_synthetic: 0 where synthetic blockers do not matter; their answer is then 1.
        need: ALL; CHANGE where the answers only matter if synthetic surfaces block; AFTER where they only matter if
            they do not. What does not matter is not traced.
    """
    if sight.single != 0:
        end = origin + direction * t_max
        real = trace_real(geo, end, -direction, t_max)
        synthetic = trace_synthetic(geo, end, -direction, t_max)
        if synthetic.found != 0 and synthetic.t < real.t:
            return wp.vec2(1.0, 0.0)
        return wp.vec2(wp.where(real.found != 0, 0.0, 1.0), wp.where(synthetic.found != 0, 0.0, 1.0))
    s_synthetic = float(1.0)
    if ask_synthetic != 0 and occluded_by_synthetic(geo, origin, direction, t_max):
        s_synthetic = 0.0
    if (need == CHANGE and s_synthetic == 1.0) or (need == AFTER and s_synthetic == 0.0):
        return wp.vec2(1.0, s_synthetic)
    return wp.vec2(wp.where(occluded_by_real(geo, origin, direction, t_max), 0.0, 1.0), s_synthetic)

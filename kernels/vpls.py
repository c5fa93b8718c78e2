"""Virtual point lights from reflective shadow maps and from environment images.

Knecht et al. 2012, sections 3.3 and 3.7. A VPL carries the flux of all that it stands for; its two flags are the
paper's r(x) of the whole path up to it, and ir: it lights real objects in the picture before only (VPL3).
"""

import warp as wp

from warp_dvct.kernels.environment import Environment
from warp_dvct.kernels.geometry import OFFSET_RELATIVE
from warp_dvct.kernels.sampling import PI, TWO_PI, luminance, sobol2, uniform1
from warp_dvct.kernels.warping import Chain, warp_point

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SURFACE = wp.constant(0)
SKY = wp.constant(1)

NEIGHBOURS = wp.constant(4)  # nearest VPLs that say how much surface one stands for
SAME_SIDE = wp.constant(0.7)  # cosine between normals of VPLs that count as neighbours


@wp.struct
class Vpls:
    """Virtual point lights, structure of arrays of at least ``count`` entries."""

    count: wp.int32
    kind: wp.array(dtype=wp.int32)
    position: wp.array(dtype=wp.vec3)  # off its surface by the rounding error; SKY: unused
    normal: wp.array(dtype=wp.vec3)  # of the lit side; SKY: the direction to the light
    flux: wp.array(dtype=wp.vec3)  # [W]; SKY: irradiance on a plane that faces it
    real: wp.array(dtype=wp.int32)  # 1 where the light and all surfaces up to here are real (9)
    hidden: wp.array(dtype=wp.int32)  # ir: 1 where something synthetic cuts the path: before only (6)
    spread: wp.array(dtype=wp.float32)  # radius of the disc that it stands for; 0 for a point


@wp.struct
class Maps:
    """A light's pair of reflective shadow maps."""

    size: wp.int32
    added: wp.int32  # 1: an added light, whose maps all hold light that is not there before
    single: wp.int32  # 1: the 2010 method: the front-most surface alone
    position_after: wp.array(dtype=wp.vec3)
    normal_after: wp.array(dtype=wp.vec3)
    flux_after: wp.array(dtype=wp.vec3)
    role_after: wp.array(dtype=wp.int32)
    position_before: wp.array(dtype=wp.vec3)
    normal_before: wp.array(dtype=wp.vec3)
    flux_before: wp.array(dtype=wp.vec3)
    role_before: wp.array(dtype=wp.int32)


@wp.struct
class Focus:
    """Where VPLs matter most: a sphere around the synthetic objects; weights of all places alike, and of near ones."""

    center: wp.vec3
    radius: wp.float32
    everywhere: wp.float32
    near: wp.float32


@wp.func
def importance_of(flux: wp.vec3, position: wp.vec3, normal: wp.vec3, focus: Focus) -> float:
    """Flux x facing x distance: how much of a texel's light can reach the focus; and a part for all else."""
    toward = focus.center - position
    distance2 = wp.length_sq(toward)
    radius2 = focus.radius * focus.radius
    facing = wp.clamp(0.5 + 0.5 * wp.dot(toward, normal) / wp.max(wp.sqrt(distance2), 1.0e-12), 0.0, 1.0)
    if distance2 <= radius2:
        facing = 1.0
    near = facing * radius2 / wp.max(radius2 + distance2, 1.0e-24)
    return luminance(flux) * (focus.everywhere + focus.near * near)


@wp.kernel
def _rsm_importance(
    first: int,
    maps: Maps,
    focus: Focus,
    hidden_gain: float,
    real_out: wp.array(dtype=wp.float32),
    synthetic_out: wp.array(dtype=wp.float32),
    hidden_out: wp.array(dtype=wp.int32),
):
    """Importance of the map of real surfaces and of that of synthetic ones (or, for an added light, of all).

    ``hidden_out`` is 1 where the real surface lies behind a synthetic one: there VPL3 are made, unless one map is all.
    """
    i = first + wp.tid()
    real = float(0.0)
    synthetic = float(0.0)
    hidden = int(0)
    if maps.role_after[i] == 1 or (maps.added != 0 and maps.role_after[i] == 0):
        synthetic = importance_of(maps.flux_after[i], maps.position_after[i], maps.normal_after[i], focus)
    if maps.role_before[i] == 0 and maps.added == 0:
        real = importance_of(maps.flux_before[i], maps.position_before[i], maps.normal_before[i], focus)
        if maps.role_after[i] == 1:
            hidden = 1
            real = wp.where(maps.single != 0, 0.0, real * hidden_gain)
    real_out[i] = real
    synthetic_out[i] = synthetic
    hidden_out[i] = hidden


@wp.func
def radical_inverse5(k: int) -> float:
    """Halton's sequence in base 5."""
    value = float(0.0)
    digit = float(0.2)
    while k > 0:
        value += digit * float(k % 5)
        digit *= 0.2
        k = k / 5
    return value


@wp.kernel
def _choose_vpls(
    first: int,
    maps: Maps,
    real: Chain,
    synthetic: Chain,
    synthetic_share: float,
    light: int,
    count: int,
    seed: int,
    reach: float,
    start: int,
    vpls: Vpls,
):
    """VPL ``start + i`` of a light's ``count``: a Halton number chooses the map, hierarchical warping the texel."""
    i = first + wp.tid()
    at = start + i
    vpls.kind[at] = SURFACE
    vpls.flux[at] = wp.vec3(0.0, 0.0, 0.0)
    vpls.real[at] = 0
    vpls.hidden[at] = 0
    vpls.spread[at] = 0.0
    turn = radical_inverse5(i + 1) + uniform1(seed, light, 0, 31)
    from_synthetic = turn - wp.floor(turn) < synthetic_share
    u = sobol2(seed, light, i, 32)
    uv = wp.vec2d(wp.float64(u[0]), wp.float64(u[1]))
    normal = wp.vec3(0.0, 0.0, 1.0)
    position = wp.vec3(0.0, 0.0, 0.0)
    if from_synthetic:
        w = warp_point(synthetic, uv)
        if w.probability > 0.0:
            j = w.y * maps.size + w.x
            position = maps.position_after[j]
            normal = maps.normal_after[j]
            vpls.flux[at] = maps.flux_after[j] / (w.probability * synthetic_share * float(count))
    else:
        w = warp_point(real, uv)
        if w.probability > 0.0:
            j = w.y * maps.size + w.x
            position = maps.position_before[j]
            normal = maps.normal_before[j]
            vpls.flux[at] = maps.flux_before[j] / (w.probability * (1.0 - synthetic_share) * float(count))
            vpls.real[at] = 1
            vpls.hidden[at] = wp.where(maps.role_after[j] == 1, 1, 0)
    vpls.position[at] = position + normal * (OFFSET_RELATIVE * reach)
    vpls.normal[at] = normal


@wp.func
def sky_texel(env: Environment, i: int, added: int) -> wp.vec3:
    """Radiance of a texel of the plate's domes, or of the added ones."""
    if added != 0:
        return env.after[i] - env.before[i]
    return env.before[i]


@wp.func
def band_top(env: Environment, row: int) -> float:
    """Height on the unit sphere of the upper edge of a row."""
    return wp.cos(float(row) * PI / float(env.height))


@wp.kernel
def _sky_importance(first: int, env: Environment, added: int, importance_out: wp.array(dtype=wp.float32)):
    """Radiance x solid angle of a texel of the environment image."""
    i = first + wp.tid()
    row = i / env.width
    importance_out[i] = luminance(sky_texel(env, i, added)) * (band_top(env, row) - band_top(env, row + 1))


@wp.kernel
def _choose_sky(first: int, env: Environment, chain: Chain, added: int, count: int, seed: int, start: int, vpls: Vpls):
    """A VPL on the sphere of the environment: uniform in solid angle inside the texel that warping finds."""
    i = first + wp.tid()
    at = start + i
    u = sobol2(seed, 1 + added, i, 33)
    w = warp_point(chain, wp.vec2d(wp.float64(u[0]), wp.float64(u[1])))
    top = band_top(env, w.y)
    band = top - band_top(env, w.y + 1)
    height = top - w.fy * band
    sine = wp.sqrt(wp.max(0.0, 1.0 - height * height))
    azimuth = (0.5 - (float(w.x) + w.fx) / float(env.width)) * TWO_PI
    solid_angle = band * TWO_PI / float(env.width)
    flux = wp.vec3(0.0, 0.0, 0.0)
    if w.probability > 0.0:
        flux = sky_texel(env, w.y * env.width + w.x, added) * (solid_angle / (w.probability * float(count)))
    vpls.kind[at] = SKY
    vpls.position[at] = wp.vec3(0.0, 0.0, 0.0)
    vpls.normal[at] = wp.vec3(sine * wp.sin(azimuth), height, sine * wp.cos(azimuth))
    vpls.flux[at] = flux
    vpls.real[at] = 1 - added
    vpls.hidden[at] = 0
    vpls.spread[at] = 0.0


@wp.kernel
def _spread_vpls(first: int, vpls: Vpls, start: int, count: int, scale: float, limit: float):
    """Radius of the disc that a VPL stands for, from the distance of its fourth neighbour on a like surface.

    As many VPLs as lie within that distance share its disc's area, so it falls as they grow in number. What a VPL has
    for a radius, where it has one, is the largest: one that stands alone among its class may be small all the same.
    """
    i = start + first + wp.tid()
    if vpls.spread[i] > 0.0:
        limit = wp.min(limit, vpls.spread[i] * wp.sqrt(float(NEIGHBOURS)))
    near = wp.vec4(limit, limit, limit, limit)
    for j in range(start, start + count):
        if j != i and vpls.real[j] == vpls.real[i] and wp.dot(vpls.normal[i], vpls.normal[j]) > SAME_SIDE:
            d = wp.length(vpls.position[j] - vpls.position[i])
            if d < near[3]:
                near[3] = d
                for k in range(3):
                    if near[3 - k] < near[2 - k]:
                        swap = near[2 - k]
                        near[2 - k] = near[3 - k]
                        near[3 - k] = swap
    vpls.spread[i] = scale * near[3] / wp.sqrt(float(NEIGHBOURS))


@wp.kernel
def _scale_vpls(first: int, start: int, visible: float, hidden: float, synthetic: float, vpls: Vpls):
    """Multiply the flux of each class: seen real surfaces, real ones behind synthetic ones, and all else."""
    i = start + first + wp.tid()
    factor = synthetic
    if vpls.real[i] != 0:
        factor = wp.where(vpls.hidden[i] != 0, hidden, visible)
    vpls.flux[i] = vpls.flux[i] * factor

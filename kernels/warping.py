"""Hierarchical sample warping: points of the unit square follow any 2-D importance, with their exact probability.

Clarberg et al. 2005, "Wavelet Importance Sampling", section 4.1, as Knecht et al. 2012 use it for reflective shadow
maps and environment images. Level k + 1 of the chain holds the sums of 2 x 2 entries of level k, so every size works:
an odd row or column has empty neighbours. Splits are decided by the children's sums alone, so the probabilities of
each split add up to one whatever the parents were rounded to.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BELOW_ONE = wp.constant(wp.float64(0.9999999999999999))


@wp.struct
class Chain:
    """Importance and its sums, level after level in one array."""

    width: wp.int32
    height: wp.int32
    levels: wp.int32
    level_first: wp.array(dtype=wp.int32)
    value: wp.array(dtype=wp.float32)


@wp.struct
class Warped:
    """A texel, the place inside of it in [0, 1)^2, and the probability of the texel; that is 0 where nothing is."""

    x: wp.int32
    y: wp.int32
    fx: wp.float32
    fy: wp.float32
    probability: wp.float32


@wp.func
def chain_value(chain: Chain, level: int, x: int, y: int) -> wp.float64:
    """An entry of a level; 0 outside."""
    width = (chain.width + (1 << level) - 1) >> level
    height = (chain.height + (1 << level) - 1) >> level
    if x >= width or y >= height:
        return wp.float64(0.0)
    return wp.float64(chain.value[chain.level_first[level] + y * width + x])


@wp.func
def first_share(a: wp.float64, b: wp.float64) -> wp.float64:
    """Probability of the first of two parts; -1 where both are empty."""
    total = a + b
    if total <= wp.float64(0.0):
        return wp.float64(-1.0)
    return a / total


@wp.func
def warp_point(chain: Chain, u: wp.vec2d) -> Warped:
    """Warp a point of [0, 1)^2: rows first, then columns, from the coarsest level down."""
    out = Warped()
    x = int(0)
    y = int(0)
    ux = u[0]
    uy = u[1]
    one = wp.float64(1.0)
    chance = one
    level = chain.levels - 1
    if chain_value(chain, level, 0, 0) <= wp.float64(0.0):
        return out
    while level > 0:
        level -= 1
        x = 2 * x
        y = 2 * y
        a = chain_value(chain, level, x, y)
        b = chain_value(chain, level, x + 1, y)
        c = chain_value(chain, level, x, y + 1)
        d = chain_value(chain, level, x + 1, y + 1)
        top = first_share(a + b, c + d)
        left = first_share(a, b)
        if uy < top:
            uy = uy / top
            chance *= top
        else:
            uy = (uy - top) / (one - top)
            chance *= one - top
            y += 1
            left = first_share(c, d)
        if ux < left:
            ux = ux / left
            chance *= left
        else:
            ux = (ux - left) / (one - left)
            chance *= one - left
            x += 1
        # Rounding up to 1 would walk into a part of probability 0.
        ux = wp.min(ux, BELOW_ONE)
        uy = wp.min(uy, BELOW_ONE)
    out.x = x
    out.y = y
    out.fx = wp.min(float(ux), 0.99999994)
    out.fy = wp.min(float(uy), 0.99999994)
    out.probability = float(chance)
    return out


@wp.func
def texel_probability(chain: Chain, x: int, y: int) -> float:
    """The probability with which :func:`warp_point` picks a texel."""
    chance = wp.float64(1.0)
    for level in range(chain.levels - 1):
        px = x >> level
        py = y >> level
        row = py & -2
        column = px & -2
        a = chain_value(chain, level, column, row)
        b = chain_value(chain, level, column + 1, row)
        c = chain_value(chain, level, column, row + 1)
        d = chain_value(chain, level, column + 1, row + 1)
        top = first_share(a + b, c + d)
        if top < wp.float64(0.0):
            return 0.0
        left = first_share(a, b)
        if py > row:
            top = wp.float64(1.0) - top
            left = first_share(c, d)
        if left < wp.float64(0.0):
            return 0.0
        chance *= top * wp.where(px > column, wp.float64(1.0) - left, left)
    if chain.levels == 1 and chain_value(chain, 0, 0, 0) <= wp.float64(0.0):
        return 0.0
    return float(chance)


@wp.kernel
def _clean_importance(first: int, value_in: wp.array(dtype=wp.float32), value_out: wp.array(dtype=wp.float32)):
    """Level 0: what is NaN, infinite or not above 0 is never picked."""
    i = first + wp.tid()
    value = value_in[i]
    value_out[i] = wp.where(wp.isfinite(value) and value > 0.0, value, 0.0)


@wp.kernel
def _sum_level(first: int, level: int, chain: Chain, value_out: wp.array(dtype=wp.float32)):
    """An entry of ``level`` from four of the level below."""
    i = first + wp.tid()
    width = (chain.width + (1 << level) - 1) >> level
    x = 2 * (i % width)
    y = 2 * (i / width)
    top = chain_value(chain, level - 1, x, y) + chain_value(chain, level - 1, x + 1, y)
    bottom = chain_value(chain, level - 1, x, y + 1) + chain_value(chain, level - 1, x + 1, y + 1)
    value_out[chain.level_first[level] + i] = float(top + bottom)


@wp.kernel
def _warp_points(
    first: int,
    chain: Chain,
    u_in: wp.array(dtype=wp.vec2d),
    place_out: wp.array(dtype=wp.vec2),
    texel_out: wp.array(dtype=wp.int32),
    probability_out: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    w = warp_point(chain, u_in[i])
    place_out[i] = wp.vec2((float(w.x) + w.fx) / float(chain.width), (float(w.y) + w.fy) / float(chain.height))
    texel_out[i] = w.y * chain.width + w.x
    probability_out[i] = w.probability


@wp.kernel
def _texel_probabilities(first: int, chain: Chain, probability_out: wp.array(dtype=wp.float32)):
    i = first + wp.tid()
    probability_out[i] = texel_probability(chain, i % chain.width, i / chain.width)

"""Random numbers, low-discrepancy points and the usual warps of the unit square.

Numbers depend on (seed, index, sample, dimension) alone, never on launch order. ``sobol2`` pads two-dimensional Sobol'
points: each (seed, index, dimension) gets its own Owen scrambling and its own Owen shuffling of the sample order
(Burley 2020, "Practical Hash-based Owen Scrambling"), so every prefix of 2**k samples is a (0, k, 2)-net in every
dimension, and dimensions and pixels are independent of each other.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

PI = wp.constant(3.14159265358979)
TWO_PI = wp.constant(6.28318530717959)
INV_PI = wp.constant(0.318309886183791)

# A literal of 2**31 or more needs its type before it reaches the compiler, which would warn of a negative int.
PCG_INCREMENT = wp.constant(wp.uint32(2891336453))
GOLDEN = wp.constant(wp.uint32(0x9E3779B9))
OWEN_B = wp.constant(wp.uint32(0xB82F1E52))
OWEN_C = wp.constant(wp.uint32(0xC7AFE638))
OWEN_D = wp.constant(wp.uint32(0x8D22F6E6))
MASK_1 = wp.constant(wp.uint32(0xAAAAAAAA))
MASK_2 = wp.constant(wp.uint32(0xCCCCCCCC))
MASK_4 = wp.constant(wp.uint32(0xF0F0F0F0))
MASK_8 = wp.constant(wp.uint32(0xFF00FF00))
MASK_16 = wp.constant(wp.uint32(0xFFFF0000))
FIRST_SALT = wp.constant(wp.uint32(0xA511E9B3))


@wp.func
def hash1(x: wp.uint32) -> wp.uint32:
    """PCG output permutation of one LCG step (Jarzynski & Olano 2020, "Hash Functions for GPU Rendering")."""
    state = x * wp.uint32(747796405) + PCG_INCREMENT
    word = ((state >> ((state >> wp.uint32(28)) + wp.uint32(4))) ^ state) * wp.uint32(277803737)
    return (word >> wp.uint32(22)) ^ word


@wp.func
def hash2(a: wp.uint32, b: wp.uint32) -> wp.uint32:
    """Hash of a pair."""
    return hash1(a ^ (hash1(b) + GOLDEN))


@wp.func
def unit_float(bits: wp.uint32) -> float:
    """The upper 24 bits as a float in [0, 1)."""
    return float(bits >> wp.uint32(8)) * 5.9604644775390625e-8


@wp.func
def key4(seed: int, index: int, sample: int, dimension: int) -> wp.uint32:
    """Hash of all that a random number may depend on."""
    return hash2(hash2(hash2(wp.uint32(seed), wp.uint32(index)), wp.uint32(sample)), wp.uint32(dimension))


@wp.func
def uniform1(seed: int, index: int, sample: int, dimension: int) -> float:
    """An independent uniform number in [0, 1)."""
    return unit_float(key4(seed, index, sample, dimension))


@wp.func
def uniform2(seed: int, index: int, sample: int, dimension: int) -> wp.vec2:
    """Two independent uniform numbers in [0, 1)."""
    key = key4(seed, index, sample, dimension)
    return wp.vec2(unit_float(key), unit_float(hash1(key ^ wp.uint32(0x68BC21EB))))


@wp.func
def reverse_bits(x: wp.uint32) -> wp.uint32:
    """The 32 bits in opposite order."""
    y = ((x >> wp.uint32(1)) & wp.uint32(0x55555555)) | ((x & wp.uint32(0x55555555)) << wp.uint32(1))
    y = ((y >> wp.uint32(2)) & wp.uint32(0x33333333)) | ((y & wp.uint32(0x33333333)) << wp.uint32(2))
    y = ((y >> wp.uint32(4)) & wp.uint32(0x0F0F0F0F)) | ((y & wp.uint32(0x0F0F0F0F)) << wp.uint32(4))
    y = ((y >> wp.uint32(8)) & wp.uint32(0x00FF00FF)) | ((y & wp.uint32(0x00FF00FF)) << wp.uint32(8))
    return (y >> wp.uint32(16)) | (y << wp.uint32(16))


@wp.func
def owen_reversed(x: wp.uint32, seed: wp.uint32) -> wp.uint32:
    """Laine-Karras permutation: an Owen scrambling of the bit-reversed integer ``x``."""
    y = x + seed
    y = y ^ (y * wp.uint32(0x6C50B47C))
    y = y ^ (y * OWEN_B)
    y = y ^ (y * OWEN_C)
    return y ^ (y * OWEN_D)


@wp.func
def sobol_second_reversed(index: wp.uint32) -> wp.uint32:
    """Bit-reversed second Sobol' coordinate: the Pascal matrix modulo 2 applied to the index bits, in five steps."""
    x = index ^ ((index & MASK_1) >> wp.uint32(1))
    x = x ^ ((x & MASK_2) >> wp.uint32(2))
    x = x ^ ((x & MASK_4) >> wp.uint32(4))
    x = x ^ ((x & MASK_8) >> wp.uint32(8))
    return x ^ ((x & MASK_16) >> wp.uint32(16))


@wp.func
def sobol2(seed: int, index: int, sample: int, dimension: int) -> wp.vec2:
    """Owen-scrambled Sobol' point number ``sample`` of the sequence that belongs to (seed, index, dimension)."""
    key = hash2(hash2(wp.uint32(seed), wp.uint32(index)), wp.uint32(dimension))
    i = reverse_bits(owen_reversed(reverse_bits(wp.uint32(sample)), key))
    # The first coordinate is the bit-reversed index, so its reversed form is the index itself.
    x = reverse_bits(owen_reversed(i, hash1(key ^ FIRST_SALT)))
    y = reverse_bits(owen_reversed(sobol_second_reversed(i), hash1(key ^ wp.uint32(0x63D83595))))
    return wp.vec2(unit_float(x), unit_float(y))


@wp.func
def sobol1(seed: int, index: int, sample: int, dimension: int) -> float:
    """First coordinate of :func:`sobol2`: a stratified number where one dimension is enough."""
    key = hash2(hash2(wp.uint32(seed), wp.uint32(index)), wp.uint32(dimension))
    i = reverse_bits(owen_reversed(reverse_bits(wp.uint32(sample)), key))
    return unit_float(reverse_bits(owen_reversed(i, hash1(key ^ FIRST_SALT))))


@wp.func
def concentric_disk(xi: wp.vec2) -> wp.vec2:
    """Area-preserving map of the unit square to the unit disk (Shirley & Chiu 1997)."""
    a = 2.0 * xi[0] - 1.0
    b = 2.0 * xi[1] - 1.0
    if a == 0.0 and b == 0.0:
        return wp.vec2(0.0, 0.0)
    r = a
    phi = 0.25 * PI * (b / wp.where(a == 0.0, 1.0, a))
    if wp.abs(b) >= wp.abs(a):
        r = b
        phi = 0.5 * PI - 0.25 * PI * (a / wp.where(b == 0.0, 1.0, b))
    return wp.vec2(r * wp.cos(phi), r * wp.sin(phi))


@wp.func
def cosine_hemisphere(xi: wp.vec2) -> wp.vec3:
    """Direction about +z with density cos / pi."""
    d = concentric_disk(xi)
    return wp.vec3(d[0], d[1], wp.sqrt(wp.max(0.0, 1.0 - d[0] * d[0] - d[1] * d[1])))


@wp.func
def uniform_cone(xi: wp.vec2, one_minus_cos: float) -> wp.vec3:
    """Direction about +z, uniform over the cap of height ``1 - cos(half angle)``; density 1 / (2 pi height)."""
    z1 = xi[0] * one_minus_cos
    r = wp.sqrt(wp.max(0.0, z1 * (2.0 - z1)))
    phi = TWO_PI * xi[1]
    return wp.vec3(r * wp.cos(phi), r * wp.sin(phi), 1.0 - z1)


@wp.func
def tangent_of(n: wp.vec3) -> wp.vec3:
    """First tangent of an orthonormal basis without branches on the pole (Duff et al. 2017)."""
    sign = wp.where(n[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + n[2])
    return wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * n[0] * n[1] * a, -sign * n[0])


@wp.func
def from_frame(local: wp.vec3, n: wp.vec3) -> wp.vec3:
    """A vector given about +z, turned so that +z becomes ``n``."""
    t = tangent_of(n)
    return t * local[0] + wp.cross(n, t) * local[1] + n * local[2]


@wp.func
def luminance(c: wp.vec3) -> float:
    """Rec.709 luminance of linear RGB."""
    return 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2]

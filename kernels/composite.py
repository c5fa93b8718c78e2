"""Split a pixel's change into the layers that a compositor recombines; one thread, one pixel."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

HALF_MAX = wp.constant(65504.0)
FLOAT_LARGE = wp.constant(1.0e38)
# Below the smallest normal half number a ratio to the plate is rounding noise: there the shadow is left at 1.
HALF_TINY = wp.constant(6.103515625e-05)


@wp.func
def round_half(value: float) -> float:
    """The nearest half number, ties to even, of a value within them; by its bits, as processors convert slowly."""
    bits = wp.cast(value, wp.uint32)
    sign = bits & wp.uint32(0x80000000)
    size = bits ^ sign
    # 13 bits fewer: half of the last one that stays is added, less one where that one is 0.
    rounded = (size + wp.uint32(0xFFF) + ((size >> wp.uint32(13)) & wp.uint32(1))) & wp.uint32(0xFFFFE000)
    if size < wp.uint32(0x38800000):
        # Below HALF_TINY steps are of one size, 2**-24, which is that of floats from 0.5 to 1.
        rounded = wp.cast((wp.cast(size, wp.float32) + 0.5) - 0.5, wp.uint32)
    return wp.cast(rounded | sign, wp.float32)


@wp.func
def storable(value: float) -> float:
    """``value`` inside of what half precision holds; NaN becomes 0."""
    if wp.isnan(value):
        return 0.0
    return wp.clamp(value, -HALF_MAX, HALF_MAX)


@wp.func
def finite(value: float) -> float:
    """``value`` inside of what single precision computes with; NaN becomes 0."""
    if wp.isnan(value):
        return 0.0
    return wp.clamp(value, -FLOAT_LARGE, FLOAT_LARGE)


@wp.func
def count_outside(value: float) -> int:
    """1 where half precision cannot hold ``value``."""
    return wp.where(wp.abs(value) > HALF_MAX, 1, 0)


@wp.func
def count_nan(value: float) -> int:
    return wp.where(wp.isnan(value), 1, 0)


@wp.func
def shadow_ratio(plate: float, delta: float) -> float:
    """With / without the synthetic objects, in [0, 1]; 1 where nothing darkens or the plate is black."""
    if delta >= 0.0 or plate < HALF_TINY:
        return 1.0
    return wp.clamp((plate + delta) / plate, 0.0, 1.0)


@wp.kernel
def _composite_pixels(
    first: int,
    plate_in: wp.array(dtype=wp.vec3),
    delta_in: wp.array(dtype=wp.vec3),
    synthetic_in: wp.array(dtype=wp.vec4),
    rgba_out: wp.array(dtype=wp.vec4),
    comp_out: wp.array(dtype=wp.vec3),
    plate_out: wp.array(dtype=wp.vec3),
    shadow_out: wp.array(dtype=wp.vec3),
    added_out: wp.array(dtype=wp.vec3),
    delta_out: wp.array(dtype=wp.vec3),
    clamped_out: wp.array(dtype=wp.int32),
    invalid_out: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    raw_plate = plate_in[i]
    raw_delta = delta_in[i]
    raw_synthetic = synthetic_in[i]
    covered = wp.clamp(storable(raw_synthetic[3]), 0.0, 1.0)
    coverage = round_half(covered)
    clamped = int(0)
    invalid = count_nan(raw_synthetic[3])
    rgba = wp.vec4(0.0, 0.0, 0.0, coverage)
    comp = wp.vec3()
    plate = wp.vec3()
    shadow = wp.vec3()
    added = wp.vec3()
    delta = wp.vec3()
    for c in range(3):
        invalid += count_nan(raw_plate[c]) + count_nan(raw_delta[c]) + count_nan(raw_synthetic[c])
        mean = float(0.0)
        if coverage < 1.0:
            # From the sum over the pixel's real part to the mean over that part.
            mean = raw_delta[c] / (1.0 - covered)
        change = storable(mean)
        # The ratio is taken before rounding, so that a full shadow is exactly black, and before clamping, so that a
        # slight shadow on something too bright to store is not.
        ratio = round_half(shadow_ratio(finite(raw_plate[c]), finite(mean)))
        base = round_half(storable(raw_plate[c]))
        light = round_half(wp.max(change, 0.0))
        own = round_half(storable(raw_synthetic[c]))
        total = own + (1.0 - coverage) * (base * ratio + light)
        outside = count_outside(raw_plate[c]) + count_outside(raw_synthetic[c]) + count_outside(mean)
        # One value counts once, however many of its layers were clamped.
        clamped += wp.min(outside + count_outside(total), 1)
        result = round_half(wp.clamp(total, -HALF_MAX, HALF_MAX))
        if coverage == 0.0 and own == 0.0 and ratio == 1.0 and light == 0.0:
            result = base  # the same bits, the sign of a zero included
        rgba[c] = own
        comp[c] = result
        plate[c] = base
        shadow[c] = ratio
        added[c] = light
        delta[c] = round_half(change)
    rgba_out[i] = rgba
    comp_out[i] = comp
    plate_out[i] = plate
    shadow_out[i] = shadow
    added_out[i] = added
    delta_out[i] = delta
    clamped_out[i] = clamped
    invalid_out[i] = invalid

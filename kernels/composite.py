"""Split a pixel's change into the layers that a compositor recombines; one thread, one pixel."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

HALF_MAX = wp.constant(65504.0)
FLOAT_LARGE = wp.constant(1.0e38)
PLAIN = wp.constant(32768.0)  # sums of a pixel's numbers up to this are far from what half precision cannot hold
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
        mean = float(0.0)
        if coverage < 1.0:
            mean = raw_delta[c]
            if covered > 0.0:
                # From the sum over the pixel's real part to the mean over that part.
                mean = mean / (1.0 - covered)
        photo = raw_plate[c]
        object = raw_synthetic[c]
        change = mean
        outside = int(0)
        # False for NaN as well: nearly all pixels are spared the rest.
        plain = wp.abs(photo) + wp.abs(raw_delta[c]) + wp.abs(mean) + wp.abs(object) <= PLAIN
        if not plain:
            invalid += count_nan(photo) + count_nan(raw_delta[c]) + count_nan(object)
            outside = count_outside(photo) + count_outside(object) + count_outside(mean)
            photo = finite(photo)
            mean = finite(mean)
            object = storable(object)
            change = storable(mean)
        ratio = float(1.0)
        if mean < 0.0 and photo >= HALF_TINY:
            # Before rounding, so that a full shadow is exactly black, and before clamping, so that a slight shadow on
            # something too bright to store is not.
            ratio = round_half(wp.clamp((photo + mean) / photo, 0.0, 1.0))
        if not plain:
            photo = storable(photo)
        base = round_half(photo)
        own = round_half(object)
        changed = round_half(change)
        light = wp.max(changed, 0.0)
        total = own + (1.0 - coverage) * (base * ratio + light)
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
        delta[c] = changed
    rgba_out[i] = rgba
    comp_out[i] = comp
    plate_out[i] = plate
    shadow_out[i] = shadow
    added_out[i] = added
    delta_out[i] = delta
    clamped_out[i] = clamped
    invalid_out[i] = invalid

"""Scene-linear radiance to 8-bit display codes."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CURVE_SRGB = wp.constant(0)
CURVE_FILMIC = wp.constant(1)


@wp.func
def encode_srgb(value: float) -> float:
    """IEC 61966-2-1 transfer function, [0, 1] to [0, 1]."""
    if value <= 0.0031308:
        return 12.92 * value
    return 1.055 * wp.pow(value, 1.0 / 2.4) - 0.055


@wp.func
def fade_highlights(color: wp.vec3) -> wp.vec3:
    """Leave colours inside the display's gamut alone; fade brighter ones to white, keeping their hue."""
    peak = wp.max(wp.max(color[0], color[1]), color[2])
    if peak <= 1.0:
        return color
    white = wp.vec3(1.0, 1.0, 1.0)
    return white - (white - color / peak) / peak


@wp.func
def filmic(value: float) -> float:
    """Narkowicz 2015, "ACES Filmic Tone Mapping Curve"."""
    return value * (2.51 * value + 0.03) / (value * (2.43 * value + 0.59) + 0.14)


@wp.kernel
def _tonemap_pixels(
    first: int,
    linear_in: wp.array(dtype=wp.vec3),
    scale: float,
    curve: int,
    display_out: wp.array(dtype=wp.uint8, ndim=2),
):
    i = first + wp.tid()
    color = wp.vec3()
    for c in range(3):
        # Negative and NaN radiance has no display value; the upper bound keeps the curves' squares finite.
        color[c] = wp.clamp(wp.where(wp.isnan(linear_in[i][c]), 0.0, linear_in[i][c]) * scale, 0.0, 1.0e6)
    if curve == CURVE_FILMIC:
        color = wp.vec3(filmic(color[0]), filmic(color[1]), filmic(color[2]))
    else:
        color = fade_highlights(color)
    for c in range(3):
        code = encode_srgb(wp.clamp(color[c], 0.0, 1.0)) * 255.0 + 0.5
        display_out[i, c] = wp.uint8(wp.int32(code))

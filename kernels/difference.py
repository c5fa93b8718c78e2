"""The difference of the two solutions as a display shows it, for plates that hold display values."""

import warp as wp

from warp_dvct.kernels.tonemap import encode_srgb, fade_highlights

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def shown(color: wp.vec3) -> wp.vec3:
    """TM: what a display shows of a radiance, encoded (IEC 61966-2-1), highlights faded to white."""
    faded = fade_highlights(wp.max(color, wp.vec3(0.0, 0.0, 0.0)))
    return wp.vec3(encode_srgb(faded[0]), encode_srgb(faded[1]), encode_srgb(faded[2]))


@wp.func
def decode_srgb(value: float) -> float:
    """Inverse of the transfer function; codes outside of [0, 1] are clipped."""
    v = wp.clamp(value, 0.0, 1.0)
    if v <= 0.04045:
        return v / 12.92
    return wp.pow((v + 0.055) / 1.055, 2.4)


@wp.kernel
def _tonemap_difference(
    first: int,
    plate_in: wp.array(dtype=wp.vec3),
    before_in: wp.array(dtype=wp.vec3),
    delta_in: wp.array(dtype=wp.vec3),
    synthetic_in: wp.array(dtype=wp.vec4),
    delta_out: wp.array(dtype=wp.vec3),
):
    """The linear change that makes the plate plate + TM(L_rho) - TM(L_mu) on the display (Knecht et al. 2012, 3.1).

    Weighted by the pixel's real part, as ``layers.Radiance`` documents; 0 stays 0.
    """
    i = first + wp.tid()
    real = 1.0 - synthetic_in[i][3]
    delta = delta_in[i]
    out = wp.vec3(0.0, 0.0, 0.0)
    if real > 1.0e-6 and wp.length_sq(delta) > 0.0:
        before = before_in[i]
        plate = plate_in[i]
        change = shown(before + delta / real) - shown(before)
        for c in range(3):
            code = encode_srgb(wp.clamp(plate[c], 0.0, 1.0)) + change[c]
            if change[c] != 0.0:
                out[c] = (decode_srgb(code) - plate[c]) * real
    delta_out[i] = out

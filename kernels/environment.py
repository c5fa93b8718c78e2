"""All domes in one prefiltered lat-long map, in world axes: what escaped rays and cones read."""

import warp as wp

from warp_dvct.kernels.sampling import PI, TWO_PI

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Environment:
    levels: wp.int32  # 0 where there is no dome
    width: wp.int32  # of level 0; every level halves both sizes
    height: wp.int32
    level_first: wp.array(dtype=wp.int32)
    before: wp.array(dtype=wp.vec3)  # domes that light the plate
    after: wp.array(dtype=wp.vec3)  # and the added ones


@wp.func
def environment_radiance(env: Environment, direction: wp.vec3, solid_angle: float, solution: int) -> wp.vec3:
    """Mean radiance over about ``solid_angle`` around a direction: bilinear in the level with texels that large."""
    if env.levels == 0:
        return wp.vec3(0.0, 0.0, 0.0)
    texel = 4.0 * PI / float(env.width * env.height)
    level = wp.clamp(int(0.5 * wp.log2(wp.max(solid_angle / texel, 1.0)) + 0.5), 0, env.levels - 1)
    width = wp.max(env.width >> level, 1)
    height = wp.max(env.height >> level, 1)
    x = (0.5 - wp.atan2(direction[0], direction[2]) / TWO_PI) * float(width) - 0.5
    y = wp.acos(wp.clamp(direction[1], -1.0, 1.0)) / PI * float(height) - 0.5
    x0 = int(wp.floor(x))
    y0 = int(wp.floor(y))
    left = (x0 + width) % width
    right = (x0 + 1) % width
    first = env.level_first[level]
    top = first + wp.clamp(y0, 0, height - 1) * width
    bottom = first + wp.clamp(y0 + 1, 0, height - 1) * width
    fx = x - float(x0)
    fy = y - float(y0)
    if solution == 0:
        return wp.lerp(
            wp.lerp(env.before[top + left], env.before[top + right], fx),
            wp.lerp(env.before[bottom + left], env.before[bottom + right], fx),
            fy,
        )
    return wp.lerp(
        wp.lerp(env.after[top + left], env.after[top + right], fx),
        wp.lerp(env.after[bottom + left], env.after[bottom + right], fx),
        fy,
    )

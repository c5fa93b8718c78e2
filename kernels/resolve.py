"""From shading points to pixels."""

import warp as wp

from warp_dvct.kernels.environment import Environment, environment_radiance
from warp_dvct.kernels.gbuffer import BACKGROUND, REAL, SYNTHETIC, Points
from warp_dvct.kernels.geometry import CameraFrame

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def _resolve(
    first: int,
    points: Points,
    edge_rank_in: wp.array(dtype=wp.int32),
    light_in: wp.array(dtype=wp.vec3),
    before_in: wp.array(dtype=wp.vec3),
    behind: Points,
    behind_rank_in: wp.array(dtype=wp.int32),
    behind_before_in: wp.array(dtype=wp.vec3),
    env: Environment,
    pixels: int,
    samples: int,
    with_before: int,
    before_out: wp.array(dtype=wp.vec3),
    delta_out: wp.array(dtype=wp.vec3),
    synthetic_out: wp.array(dtype=wp.vec4),
    mask_real_out: wp.array(dtype=wp.float32),
):
    """Box filter: a pixel is its centre, or the mean of its edge points."""
    i = first + wp.tid()
    start = i
    count = int(1)
    if edge_rank_in[i] >= 0:
        start = pixels + edge_rank_in[i] * samples
        count = samples
    delta = wp.vec3(0.0, 0.0, 0.0)
    before = wp.vec3(0.0, 0.0, 0.0)
    synthetic = wp.vec4(0.0, 0.0, 0.0, 0.0)
    real = float(0.0)
    for k in range(count):
        j = start + k
        role = points.role[j]
        light = light_in[j]
        if role == SYNTHETIC:
            synthetic += wp.vec4(light[0], light[1], light[2], 1.0)
        elif role == REAL:
            delta += light
            real += 1.0
        if with_before != 0:
            if role == REAL:
                before += before_in[j]
            elif role == BACKGROUND:
                before += environment_radiance(env, -points.view[j], 0.0, 0)
            else:
                hidden = behind_rank_in[j]
                if behind.role[hidden] == REAL:
                    before += behind_before_in[hidden]
                else:
                    before += environment_radiance(env, -points.view[j], 0.0, 0)
    share = 1.0 / float(count)
    delta_out[i] = delta * share
    synthetic_out[i] = synthetic * share
    mask_real_out[i] = real * share
    if with_before != 0:
        before_out[i] = before * share


@wp.kernel
def _write_surfaces(
    first: int,
    points: Points,
    cam: CameraFrame,
    origin: wp.vec3,
    metres: float,
    albedo_out: wp.array(dtype=wp.vec3),
    normal_out: wp.array(dtype=wp.vec3),
    position_out: wp.array(dtype=wp.vec3),
    depth_out: wp.array(dtype=wp.float32),
):
    """Surface layers of a pixel's centre, in world space and metres."""
    i = first + wp.tid()
    if points.role[i] == BACKGROUND:
        albedo_out[i] = wp.vec3(0.0, 0.0, 0.0)
        normal_out[i] = wp.vec3(0.0, 0.0, 0.0)
        position_out[i] = wp.vec3(0.0, 0.0, 0.0)
        depth_out[i] = wp.inf
    else:
        albedo_out[i] = points.base_color[i]
        normal_out[i] = points.normal[i]
        position_out[i] = points.position[i] * metres + origin
        depth_out[i] = wp.dot(points.position[i] - cam.origin, cam.forward) * metres

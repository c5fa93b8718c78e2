"""Which single-sided surfaces does light meet from behind?"""

import warp as wp

from warp_dvct.kernels.geometry import FAR, Geometry, Hit, trace_all
from warp_dvct.kernels.lights import Lights
from warp_dvct.kernels.materials import Materials, spawn_point, surface_at
from warp_dvct.kernels.rsm import Target, emit_beam
from warp_dvct.kernels.sampling import cosine_hemisphere, from_frame, sobol2

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def _meet_backs(
    first: int,
    geo: Geometry,
    mats: Materials,
    lights: Lights,
    target: Target,
    light: int,
    size: int,
    bounces: int,
    back_out: wp.array(dtype=wp.int32),
):
    """Follow a light's beams over a few diffuse bounces; write the triangles that they meet from behind, or -1.

    A back counts where what it reflects meets another surface: nothing sees the others by reflected light, as the
    outside of a closed room, or the underside of a ground.
    """
    i = first + wp.tid()
    beam = emit_beam(lights, light, target, i % size, i / size, size, 0)
    origin = beam.origin
    direction = beam.direction
    going = bool(True)
    back = int(-1)
    for k in range(bounces + 1):
        hit = Hit()
        if going:
            hit = trace_all(geo, origin, direction, FAR)
            going = hit.found != 0
        if k > 0:
            back_out[i * bounces + k - 1] = wp.where(going, back, -1)
        back = int(-1)
        if going:
            s = surface_at(geo, mats, hit, origin, direction)
            if s.front == 0:
                back = hit.triangle
            direction = from_frame(cosine_hemisphere(sobol2(0, i, k, 41)), s.normal_g)
            origin = spawn_point(s, direction)

"""What the rays that gather light at a picture's points meet: how many meet anything, and how far away."""

import warp as wp

from warp_dvct.kernels.aim import Targets, aim_at
from warp_dvct.kernels.gbuffer import BACKGROUND, Points, load_surface
from warp_dvct.kernels.geometry import FAR, Geometry, trace_real, trace_synthetic
from warp_dvct.kernels.materials import spawn_point
from warp_dvct.kernels.sampling import cosine_hemisphere, from_frame, sobol2

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

EVEN = wp.constant(64)  # rays, to tell how many are aimed for each


@wp.func
def enters(low: wp.vec3, high: wp.vec3, origin: wp.vec3, direction: wp.vec3, reach: float) -> bool:
    """Whether a segment passes a box (slab test)."""
    near = float(0.0)
    far = reach
    for axis in range(3):
        inverse = 1.0 / wp.where(wp.abs(direction[axis]) > 1.0e-12, direction[axis], 1.0e-12)
        a = (low[axis] - origin[axis]) * inverse
        b = (high[axis] - origin[axis]) * inverse
        near = wp.max(near, wp.min(a, b))
        far = wp.min(far, wp.max(a, b))
    return near <= far


@wp.kernel
def _look_around(
    first: int,
    points: Points,
    index_in: wp.array(dtype=wp.int32),
    geo: Geometry,
    targets: Targets,
    low: wp.vec3,
    high: wp.vec3,
    rays: int,
    seed: int,
    met_out: wp.array(dtype=wp.int32),
    entered_out: wp.array(dtype=wp.int32),
    nearness_out: wp.array(dtype=wp.float32),
    toward_out: wp.array(dtype=wp.float32),
):
    """Of a point's cosine-distributed rays, how many meet anything (-1 where there is no surface), how many pass the
    synthetic objects' box before they meet something real, and the mean inverse distance of what they meet; and
    how many rays are aimed at the objects for each even one (0 where they take up too much of its view)."""
    i = first + wp.tid()
    j = index_in[i]
    entered_out[i] = 0
    nearness_out[i] = 0.0
    toward_out[i] = 0.0
    if points.role[j] == BACKGROUND:
        met_out[i] = -1
        return
    s = load_surface(points, j)
    met = int(0)
    entered = int(0)
    nearness = float(0.0)
    for k in range(rays):
        direction = from_frame(cosine_hemisphere(sobol2(seed, j, k, 0)), s.normal)
        origin = spawn_point(s, direction)
        real = trace_real(geo, origin, direction, FAR)
        synthetic = trace_synthetic(geo, origin, direction, real.t)
        if real.found != 0 or synthetic.found != 0:
            met += 1
        if enters(low, high, origin, direction, real.t):
            entered += 1
        nearness += 1.0 / wp.max(synthetic.t, 1.0e-6)
    met_out[i] = met
    entered_out[i] = entered
    nearness_out[i] = nearness / float(rays)
    toward_out[i] = float(aim_at(targets, s, EVEN).rays) / float(EVEN)

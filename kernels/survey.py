"""How closed a scene is: of the rays that would gather light, how many meet a surface."""

import warp as wp

from warp_dvct.kernels.gbuffer import BACKGROUND, Points, load_surface
from warp_dvct.kernels.geometry import FAR, Geometry, trace_all
from warp_dvct.kernels.materials import spawn_point
from warp_dvct.kernels.sampling import cosine_hemisphere, from_frame, sobol2

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _count_met(first: int, points: Points, geo: Geometry, rays: int, seed: int, met_out: wp.array(dtype=wp.int32)):
    """Cosine-distributed rays of a point that meet anything; -1 where there is no surface."""
    i = first + wp.tid()
    if points.role[i] == BACKGROUND:
        met_out[i] = -1
        return
    s = load_surface(points, i)
    met = int(0)
    for k in range(rays):
        direction = from_frame(cosine_hemisphere(sobol2(seed, i, k, 0)), s.normal)
        hit = trace_all(geo, spawn_point(s, direction), direction, FAR)
        if hit.triangle >= 0:
            met += 1
    met_out[i] = met

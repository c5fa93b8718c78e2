"""Irradiance as a function of the lights, to be differentiated: the renderer's own sampling, cosines and visibility.

The derivative of visibility is left out: a shadow's edge that moves changes few points, and the fit looks anew.
"""

import warp as wp

from warp_dvct.kernels.geometry import FAR, Geometry, occluded_by_real
from warp_dvct.kernels.lights import Lights, sample_light
from warp_dvct.kernels.sampling import PI, cosine_hemisphere, from_frame, sobol2

wp.set_module_options({"enable_backward": True, "fuse_fp": False})

HARMONICS = wp.constant(9)  # real spherical harmonics of degree 0 to 2
DOME_DIMENSION = wp.constant(0)
LIGHT_DIMENSION = wp.constant(1)


@wp.func
def harmonic(k: int, d: wp.vec3) -> float:
    """Real spherical harmonic k = l (l + 1) + m of a unit direction, orthonormal over the sphere."""
    if k == 0:
        return 0.28209479
    if k == 1:
        return 0.48860251 * d[1]
    if k == 2:
        return 0.48860251 * d[2]
    if k == 3:
        return 0.48860251 * d[0]
    if k == 4:
        return 1.09254843 * d[0] * d[1]
    if k == 5:
        return 1.09254843 * d[1] * d[2]
    if k == 6:
        return 0.31539157 * (3.0 * d[2] * d[2] - 1.0)
    if k == 7:
        return 1.09254843 * d[0] * d[2]
    return 0.54627421 * (d[0] * d[0] - d[1] * d[1])


@wp.kernel
def _light_points(
    first: int,
    geo: Geometry,
    lights: Lights,
    position_in: wp.array(dtype=wp.vec3),
    normal_in: wp.array(dtype=wp.vec3),
    harmonics_in: wp.array(dtype=wp.vec3),
    rays: int,
    samples: int,
    seed: int,
    dome_out: wp.array(dtype=wp.vec3),
    light_out: wp.array(dtype=wp.vec3),
    open_out: wp.array(dtype=float),
):
    """Irradiance of a dome of harmonics, and of each point's own light.

    Point i has its own coefficients (``harmonics_in[9 i]`` on) and its own light i, all equal: their adjoints then are
    the rows of the Jacobian.
    """
    i = first + wp.tid()
    normal = normal_in[i]
    origin = position_in[i]
    dome = wp.vec3(0.0, 0.0, 0.0)
    seen = float(0.0)
    for j in range(rays):
        d = from_frame(cosine_hemisphere(sobol2(seed, i, j, DOME_DIMENSION)), normal)
        if not occluded_by_real(geo, origin, d, FAR):
            seen += 1.0 / float(rays)
            for k in range(HARMONICS):
                dome += harmonics_in[HARMONICS * i + k] * (harmonic(k, d) * PI / float(rays))
    dome_out[i] = dome
    open_out[i] = seen
    lit = wp.vec3(0.0, 0.0, 0.0)
    for j in range(samples):
        light = sample_light(lights, i, origin, sobol2(seed, i, j, LIGHT_DIMENSION))
        cosine = wp.dot(light.direction, normal)
        if cosine > 0.0:
            if not occluded_by_real(geo, origin, light.direction, light.distance):
                lit += light.value * (cosine / float(samples))
    light_out[i] = lit


@wp.kernel
def _try_directions(
    first: int,
    geo: Geometry,
    position_in: wp.array(dtype=wp.vec3),
    normal_in: wp.array(dtype=wp.vec3),
    direction_in: wp.array(dtype=wp.vec3),
    cosine_out: wp.array(dtype=float),
):
    """Visibility times cosine of every direction at every point: entry ``point * directions + direction``."""
    i = first + wp.tid()
    directions = direction_in.shape[0]
    point = i / directions
    d = direction_in[i % directions]
    cosine = wp.dot(d, normal_in[point])
    if cosine > 0.0:
        if occluded_by_real(geo, position_in[point], d, FAR):
            cosine = float(0.0)
    cosine_out[i] = wp.max(cosine, 0.0)

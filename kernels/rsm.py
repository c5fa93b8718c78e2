"""Reflective shadow maps: every texel is a beam of known flux, followed to the first real surface and the first of all.

The map's parametrisation follows the light: a cap or the whole sphere of directions (POINT, SPHERE, spots), a cap or
the cosine-weighted hemisphere with origins spread over the area (RECT, DISK), parallel beams over a disc (DISTANT), and
for a DOME parallel beams whose direction is drawn by radiance. Beams cover a target sphere, and each carries its exact
flux, so the flux that arrives does not depend on the number of texels.
"""

import warp as wp

from warp_dvct.kernels.geometry import FAR, Geometry, offset_point, trace_real, trace_synthetic
from warp_dvct.kernels.lights import DISK, DISTANT, DOME, POINT, SPHERE, Lights, sample_dome, spot_factor
from warp_dvct.kernels.materials import Materials, hemispherical_albedo, surface_at
from warp_dvct.kernels.sampling import (
    PI,
    TWO_PI,
    concentric_disk,
    cosine_hemisphere,
    from_frame,
    sobol2,
    uniform2,
    uniform_cone,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Target:
    """The sphere that a map has to cover, and how far out parallel beams start."""

    center: wp.vec3
    radius: float
    start: float


@wp.struct
class Beam:
    origin: wp.vec3
    direction: wp.vec3
    flux: wp.vec3


@wp.func
def cap_height(distance: float, radius: float) -> float:
    """1 - cos of the half angle under which a sphere is seen; 2, all directions, from inside."""
    if distance <= radius:
        return 2.0
    sine2 = (radius / distance) * (radius / distance)
    return sine2 / (1.0 + wp.sqrt(1.0 - sine2))


@wp.func
def emit_round(lights: Lights, i: int, target: Target, texel: wp.vec2, xi: wp.vec2) -> Beam:
    """POINT and SPHERE: uniform over the smaller of the target's cap and the spot's cone."""
    beam = Beam()
    toward = target.center - lights.position[i]
    distance = wp.length(toward)
    cap = cap_height(distance, target.radius + lights.radius[i])
    axis = lights.direction[i]
    if distance > 0.0:
        axis = toward / distance
    spot = 2.0
    if lights.cone_angle[i] < PI:
        spot = 1.0 - wp.cos(lights.cone_angle[i])
    if spot < cap:
        cap = spot
        axis = lights.direction[i]
    beam.direction = from_frame(uniform_cone(texel, cap), axis)
    emitted = spot_factor(lights, i, beam.direction) * TWO_PI * cap
    radius = lights.radius[i]
    if lights.kind[i] == SPHERE:
        disc = concentric_disk(xi)
        height = wp.sqrt(wp.max(0.0, 1.0 - disc[0] * disc[0] - disc[1] * disc[1]))
        beam.origin = lights.position[i] + from_frame(wp.vec3(disc[0], disc[1], height) * radius, beam.direction)
        emitted *= PI * radius * radius
    else:
        beam.origin = lights.position[i]
    beam.flux = lights.radiance[i] * emitted
    return beam


@wp.func
def emit_planar(lights: Lights, i: int, target: Target, texel: wp.vec2, xi: wp.vec2) -> Beam:
    """RECT and DISK: the cosine-weighted hemisphere, or the target's cap where that is narrower.

    Beams start just off the light's plane: a ceiling in that plane must not stop them, as it stops no shadow ray.
    """
    beam = Beam()
    st = wp.vec2(2.0 * xi[0] - 1.0, 2.0 * xi[1] - 1.0)
    if lights.kind[i] == DISK:
        st = concentric_disk(xi)
    place = lights.position[i] + lights.axis_x[i] * st[0] + lights.axis_y[i] * st[1]
    beam.origin = offset_point(place, lights.direction[i])
    toward = target.center - lights.position[i]
    distance = wp.length(toward)
    extent = wp.length(lights.axis_x[i]) + wp.length(lights.axis_y[i])
    cap = cap_height(distance, target.radius + extent)
    if cap < 0.5:
        beam.direction = from_frame(uniform_cone(texel, cap), toward / distance)
        cos = wp.max(0.0, wp.dot(beam.direction, lights.direction[i]))
        beam.flux = lights.radiance[i] * (lights.area[i] * cos * TWO_PI * cap)
    else:
        beam.direction = from_frame(cosine_hemisphere(texel), lights.direction[i])
        beam.flux = lights.radiance[i] * (lights.area[i] * PI)
    beam.flux = beam.flux * spot_factor(lights, i, beam.direction)
    return beam


@wp.func
def emit_parallel(lights: Lights, i: int, target: Target, texel: wp.vec2, xi: wp.vec2) -> Beam:
    """DISTANT and DOME: over the disc of the target that faces the beam."""
    beam = Beam()
    if lights.kind[i] == DOME:
        light = sample_dome(lights, i, xi)
        beam.direction = -light.direction
        beam.flux = light.value
    else:
        beam.direction = lights.direction[i]
        beam.flux = lights.radiance[i]
        cap = lights.cap[i]
        if cap > 0.0:
            beam.direction = from_frame(uniform_cone(xi, cap), lights.direction[i])
            beam.flux = lights.radiance[i] * (TWO_PI * cap)
    disc = concentric_disk(texel) * target.radius
    beam.flux = beam.flux * (PI * target.radius * target.radius)
    beam.origin = (
        target.center + from_frame(wp.vec3(disc[0], disc[1], 0.0), beam.direction) - beam.direction * target.start
    )
    return beam


@wp.func
def emit_beam(lights: Lights, i: int, target: Target, x: int, y: int, size: int, seed: int) -> Beam:
    """Texel (x, y) of a ``size`` x ``size`` map: stratified in direction (or place), low discrepancy in the rest."""
    index = y * size + x
    jitter = uniform2(seed, index, i, 0)
    texel = wp.vec2((float(x) + jitter[0]) / float(size), (float(y) + jitter[1]) / float(size))
    xi = sobol2(seed, i, index, 1)
    beam = Beam()
    kind = lights.kind[i]
    if kind == POINT or kind == SPHERE:
        beam = emit_round(lights, i, target, texel, xi)
    elif kind == DISTANT or kind == DOME:
        beam = emit_parallel(lights, i, target, texel, xi)
    else:
        beam = emit_planar(lights, i, target, texel, xi)
    beam.flux = beam.flux / float(size * size)
    return beam


@wp.kernel
def _render_real(
    first: int,
    geo: Geometry,
    mats: Materials,
    lights: Lights,
    target: Target,
    light: int,
    size: int,
    seed: int,
    origin_out: wp.array(dtype=wp.vec3),
    direction_out: wp.array(dtype=wp.vec3),
    reach_out: wp.array(dtype=wp.float32),
    position_out: wp.array(dtype=wp.vec3),
    normal_out: wp.array(dtype=wp.vec3),
    flux_out: wp.array(dtype=wp.vec3),
    role_out: wp.array(dtype=wp.int32),
):
    """One texel: reflected flux where the beam first meets anything real; role 0, or -1 where it meets nothing.

    ``origin_out``, ``direction_out`` and ``reach_out`` are the beam and its length.
    """
    i = first + wp.tid()
    beam = emit_beam(lights, light, target, i % size, i / size, size, seed)
    hit = trace_real(geo, beam.origin, beam.direction, FAR)
    origin_out[i] = beam.origin
    direction_out[i] = beam.direction
    reach_out[i] = hit.t
    role_out[i] = -1
    if hit.found != 0:
        s = surface_at(geo, mats, hit, beam.origin, beam.direction)
        role_out[i] = 0
        position_out[i] = s.position
        normal_out[i] = s.normal_g
        flux_out[i] = wp.cw_mul(hemispherical_albedo(s), beam.flux)


@wp.kernel
def _render_after(
    first: int,
    geo: Geometry,
    mats: Materials,
    lights: Lights,
    target: Target,
    light: int,
    size: int,
    seed: int,
    origin_in: wp.array(dtype=wp.vec3),
    direction_in: wp.array(dtype=wp.vec3),
    reach_in: wp.array(dtype=wp.float32),
    position_in: wp.array(dtype=wp.vec3),
    normal_in: wp.array(dtype=wp.vec3),
    flux_in: wp.array(dtype=wp.vec3),
    role_in: wp.array(dtype=wp.int32),
    position_out: wp.array(dtype=wp.vec3),
    normal_out: wp.array(dtype=wp.vec3),
    flux_out: wp.array(dtype=wp.vec3),
    role_out: wp.array(dtype=wp.int32),
):
    """One texel: reflected flux where the beam first meets anything; role 1 where that is synthetic."""
    i = first + wp.tid()
    hit = trace_synthetic(geo, origin_in[i], direction_in[i], reach_in[i])
    role = role_in[i]
    if hit.found != 0:
        beam = emit_beam(lights, light, target, i % size, i / size, size, seed)
        s = surface_at(geo, mats, hit, beam.origin, beam.direction)
        role = 1
        position_out[i] = s.position
        normal_out[i] = s.normal_g
        flux_out[i] = wp.cw_mul(hemispherical_albedo(s), beam.flux)
    elif role >= 0:
        position_out[i] = position_in[i]
        normal_out[i] = normal_in[i]
        flux_out[i] = flux_in[i]
    role_out[i] = role

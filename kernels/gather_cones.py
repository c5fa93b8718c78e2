"""Indirect light at shading points by cones into the radiosity volume (Franke 2014, section 3.3)."""

import warp as wp

from warp_dvct.kernels.cones import DUAL, OPAQUE, ConeSettings, march_cone
from warp_dvct.kernels.environment import environment_radiance
from warp_dvct.kernels.gbuffer import BACKGROUND, Points, first_sample, load_surface
from warp_dvct.kernels.geometry import FAR, Geometry, occluded_by_real, occluded_by_synthetic
from warp_dvct.kernels.materials import Surface, spawn_point
from warp_dvct.kernels.radiosity import Incident, World
from warp_dvct.kernels.sampling import PI, from_frame, uniform1

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def escaped(world: World, direction: wp.vec3, aperture: float, solution: int) -> wp.vec3:
    """The environment as a cone reads it, times pi."""
    return environment_radiance(world.env, direction, 2.0 * PI * (1.0 - wp.cos(0.5 * aperture)), solution) * PI


@wp.func
def rgb(value: wp.vec4) -> wp.vec3:
    return wp.vec3(value[0], value[1], value[2])


@wp.func
def close_cone(march: wp.vec4, open: int, sky: wp.vec3) -> wp.vec3:
    """Radiosity of a whole cone from what its march covered.

    Interpolation lets a cone's rim slip past the ends of walls. Where the cone's axis is blocked, the rest is taken to
    look like the covered part; where it is open (or nobody asked), the rest is sky.
    """
    covered = wp.min(march[3], 1.0)
    if open != 0:
        return rgb(march) + sky * (1.0 - covered)
    return rgb(march) / wp.max(covered, 1.0e-4)


@wp.func
def cone_incident(
    world: World, geo: Geometry, s: Surface, direction: wp.vec3, cone: ConeSettings, with_before: int
) -> Incident:
    """Light along a cone, before and after.

    In the paper's form (``cone.split``), ``after - before`` at a real surface is the march through the delta field
    alone; ``before`` is then 0 unless ``with_before`` asks for it by a second march.
    """
    origin = s.position + s.normal_g * (cone.start * world.fine.voxel)
    plane = wp.vec4(0.0, 0.0, 0.0, 0.0)
    # The paper's form knows no sides, and a surface that shows one side has no lining.
    if cone.additive != 0 and geo.double_sided[s.triangle] != 0:
        n = s.normal_g
        plane = wp.vec4(n[0], n[1], n[2], wp.dot(n, s.position))
    march = march_cone(world.fine, world.coarse, world.has_coarse, origin, direction, plane, cone)
    sky_before = escaped(world, direction, cone.aperture, 0)
    sky_after = escaped(world, direction, cone.aperture, 1)
    open_before = int(1)
    open_after = int(1)
    if cone.escape != 0 and (march.before[3] < OPAQUE or march.after[3] < OPAQUE):
        start = spawn_point(s, direction)
        if occluded_by_real(geo, start, direction, FAR):
            open_before = 0
            open_after = 0
        elif occluded_by_synthetic(geo, start, direction, FAR):
            open_after = 0
    result = Incident()
    if cone.split == DUAL or s.synthetic != 0:
        result.before = close_cone(march.before, open_before, sky_before)
        result.after = close_cone(march.after, open_after, sky_after)
    else:
        result.before = wp.vec3(0.0, 0.0, 0.0)
        if with_before != 0:
            shaft = cone
            shaft.split = DUAL
            alone = march_cone(world.fine, world.coarse, world.has_coarse, origin, direction, plane, shaft)
            result.before = close_cone(alone.before, open_before, sky_before)
        delta = close_cone(march.before, open_after, sky_after - sky_before)
        result.after = result.before + delta
    return result


@wp.kernel
def _gather_cones(
    first: int,
    points: Points,
    index_in: wp.array(dtype=wp.int32),
    geo: Geometry,
    world: World,
    cones: int,
    cone: ConeSettings,
    with_before: int,
    seed: int,
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
):
    """Irradiance [W m^-2] by ``cones`` cones of equal cosine-weighted solid angle (eq. 6's first sum).

    Directions follow a cosine-weighted spiral turned by a random angle per point; each cone's aperture is that of its
    solid angle, pi / (cones * cos), unless ``cone.aperture`` sets it.
    """
    i = first + wp.tid()
    j = index_in[i]
    before = wp.vec3(0.0, 0.0, 0.0)
    after = wp.vec3(0.0, 0.0, 0.0)
    if j >= 0:
        if points.role[j] != BACKGROUND:
            s = load_surface(points, j)
            turn = 2.0 * PI * uniform1(seed, 0, first_sample(16, 1, 1, points, j), 13)
            for k in range(cones):
                sine2 = (float(k) + 0.5) / float(cones)
                phi = 2.399963 * float(k) + turn
                cos = wp.sqrt(1.0 - sine2)
                sine = wp.sqrt(sine2)
                direction = from_frame(wp.vec3(sine * wp.cos(phi), sine * wp.sin(phi), cos), s.normal)
                shaft = cone
                if cone.aperture <= 0.0:
                    height = wp.min(0.5 / (float(cones) * wp.max(cos, 0.1)), 1.0)
                    shaft.aperture = 2.0 * wp.acos(1.0 - height)
                light = cone_incident(world, geo, s, direction, shaft, with_before)
                before += light.before
                after += light.after
    before_out[i] = before / float(cones)
    after_out[i] = after / float(cones)

"""Triangles on the device: ray queries against real and synthetic surfaces, and camera rays. All in volume space."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Stands for infinity as a ray length: squares of it still fit into a float32.
FAR = wp.constant(1.0e18)

# Keeps a new ray off the surface that it starts on. A hit point is interpolated from float32 corners, so its error is a
# few units in the last place (2**-24 of the largest coordinate); 32 of them leave room for the ray test's own rounding.
OFFSET_RELATIVE = wp.constant(2.0e-6)

# A shadow ray ends this fraction before its light, so that a light lying in a surface's plane is not hidden by it.
SHADOW_SHORTENING = wp.constant(1.0e-4)


@wp.struct
class Geometry:
    """Every triangle of the scene; per-triangle arrays hold the real ones first, then from ``synthetic_first`` on."""

    real: wp.uint64
    synthetic: wp.uint64
    has_real: int
    has_synthetic: int
    synthetic_first: int
    center: wp.vec3  # middle of a box that holds the synthetic triangles
    extent: wp.vec3  # half its edges
    bodies: int  # synthetic objects, or 1 that stands for all of them where they are many
    body_center: wp.array(dtype=wp.vec3)  # middle of the box around each
    body_extent: wp.array(dtype=wp.vec3)  # half its edges
    body_middle: wp.array(dtype=wp.vec3)  # mean of its vertices
    blockers: wp.uint64  # real triangles that can lie between a surface and a light
    has_blockers: int
    blockers_center: wp.vec3  # middle of a box that holds them
    blockers_extent: wp.vec3  # half its edges
    hull: wp.array(dtype=int)  # [synthetic triangles], the body on whose convex hull a triangle lies, or -1
    corner_normals: wp.array(dtype=wp.vec3)  # zero where the triangle is faceted
    corner_uvs: wp.array(dtype=wp.vec2)
    corner_colors: wp.array(dtype=wp.vec3)
    material: wp.array(dtype=int)
    double_sided: wp.array(dtype=int)


@wp.struct
class Hit:
    """Nearest surface along a ray; ``u`` and ``v`` are the weights of the triangle's first and second corner."""

    found: int
    t: float
    triangle: int
    u: float
    v: float
    synthetic: int


@wp.struct
class CameraFrame:
    """A pinhole camera in volume space; ``tan_*`` are the image's edges on the plane at distance 1."""

    origin: wp.vec3
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3
    tan_left: float
    tan_right: float
    tan_bottom: float
    tan_top: float
    near: float
    far: float


@wp.struct
class CameraRay:
    """A camera ray that starts on the near plane and ends on the far plane."""

    origin: wp.vec3
    direction: wp.vec3
    t_max: float


@wp.func
def camera_ray(cam: CameraFrame, px: float, py: float, width: int, height: int) -> CameraRay:
    """The ray through continuous pixel coordinates; (0, 0) is the top left corner of the image."""
    x = cam.tan_left + (cam.tan_right - cam.tan_left) * px / float(width)
    y = cam.tan_top + (cam.tan_bottom - cam.tan_top) * py / float(height)
    through = cam.forward + cam.right * x + cam.up * y
    stretch = wp.length(through)
    ray = CameraRay()
    ray.origin = cam.origin + through * cam.near
    ray.direction = through / stretch
    ray.t_max = wp.min((cam.far - cam.near) * stretch, FAR)
    return ray


@wp.func
def camera_depth(cam: CameraFrame, position: wp.vec3) -> float:
    """Distance along the view axis."""
    return wp.dot(position - cam.origin, cam.forward)


@wp.func
def camera_project(cam: CameraFrame, position: wp.vec3, width: int, height: int) -> wp.vec3:
    """Continuous pixel coordinates and the distance along the view axis; behind the camera that is negative."""
    d = position - cam.origin
    z = wp.dot(d, cam.forward)
    x = (wp.dot(d, cam.right) / z - cam.tan_left) / (cam.tan_right - cam.tan_left)
    y = (wp.dot(d, cam.up) / z - cam.tan_top) / (cam.tan_bottom - cam.tan_top)
    return wp.vec3(x * float(width), y * float(height), z)


@wp.func
def no_hit(t_max: float) -> Hit:
    """A ray that met nothing up to ``t_max``."""
    hit = Hit()
    hit.found = 0
    hit.t = t_max
    hit.triangle = -1
    return hit


@wp.func
def trace_real(geo: Geometry, origin: wp.vec3, direction: wp.vec3, t_max: float) -> Hit:
    """Nearest real surface closer than ``t_max``; ``direction`` is a unit vector."""
    hit = no_hit(t_max)
    if geo.has_real != 0:
        query = wp.mesh_query_ray(geo.real, origin, direction, t_max)
        if query.result:
            hit.found = 1
            hit.t = query.t
            hit.triangle = query.face
            hit.u = query.u
            hit.v = query.v
            hit.synthetic = 0
    return hit


@wp.func
def meets_box(center: wp.vec3, extent: wp.vec3, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:
    """Whether a ray passes a box, given by its middle and half its edges, closer than ``t_max``."""
    toward = center - origin
    enter = float(0.0)
    leave = float(t_max)
    for axis in range(3):
        # No component is 0: the slab of an axis across the ray then holds all of it, or none.
        inverse = 1.0 / (direction[axis] + wp.where(direction[axis] < 0.0, -1.0e-12, 1.0e-12))
        middle = toward[axis] * inverse
        half = extent[axis] * wp.abs(inverse)
        enter = wp.max(enter, middle - half)
        leave = wp.min(leave, middle + half)
    return enter <= leave


@wp.func
def may_meet_synthetic(geo: Geometry, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:
    """Whether a ray passes the box around the synthetic triangles; most do not, and asking their tree costs more."""
    if geo.has_synthetic == 0:
        return False
    return meets_box(geo.center, geo.extent, origin, direction, t_max)


@wp.func
def trace_synthetic(geo: Geometry, origin: wp.vec3, direction: wp.vec3, t_max: float) -> Hit:
    """Nearest synthetic surface closer than ``t_max``."""
    hit = no_hit(t_max)
    if may_meet_synthetic(geo, origin, direction, t_max):
        query = wp.mesh_query_ray(geo.synthetic, origin, direction, t_max)
        if query.result:
            hit.found = 1
            hit.t = query.t
            hit.triangle = query.face + geo.synthetic_first
            hit.u = query.u
            hit.v = query.v
            hit.synthetic = 1
    return hit


@wp.func
def trace_all(geo: Geometry, origin: wp.vec3, direction: wp.vec3, t_max: float) -> Hit:
    """Nearest surface of either kind; where both lie at one distance, the real one."""
    real = trace_real(geo, origin, direction, t_max)
    synthetic = trace_synthetic(geo, origin, direction, real.t)
    if synthetic.found != 0:
        return synthetic
    return real


@wp.func
def occluded_by_real(geo: Geometry, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:
    """Whether a real surface lies closer than ``t_max``."""
    if geo.has_real == 0:
        return False
    return wp.mesh_query_ray_anyhit(geo.real, origin, direction, t_max)


@wp.func
def blocked_by_real(geo: Geometry, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:
    """As ``occluded_by_real`` for a ray from a surface that ends at a light, or goes on to a parallel one."""
    if geo.has_blockers == 0:
        return False
    if not meets_box(geo.blockers_center, geo.blockers_extent, origin, direction, t_max):
        return False
    return wp.mesh_query_ray_anyhit(geo.blockers, origin, direction, t_max)


@wp.func
def occluded_by_synthetic(geo: Geometry, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:
    """Whether a synthetic surface lies closer than ``t_max``."""
    if not may_meet_synthetic(geo, origin, direction, t_max):
        return False
    return wp.mesh_query_ray_anyhit(geo.synthetic, origin, direction, t_max)


@wp.func
def largest_coordinate(p: wp.vec3) -> float:
    """The greatest absolute coordinate."""
    return wp.max(wp.abs(p[0]), wp.max(wp.abs(p[1]), wp.abs(p[2])))


@wp.func
def offset_point(position: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """``position`` moved off its surface towards ``normal``, for points whose triangle is about as near as they are.

    The fine volume's edge is 1 in volume space, so the step never falls below that of coordinate 1. Where the triangle
    is known, ``materials.spawn_point`` also covers triangles that reach much farther out than the point.
    """
    return position + normal * (OFFSET_RELATIVE * wp.max(largest_coordinate(position), 1.0))


@wp.func
def corner_position(geo: Geometry, triangle: int, corner: int) -> wp.vec3:
    """Position of corner 0, 1 or 2 of a triangle given by its global index."""
    if triangle >= geo.synthetic_first:
        return wp.mesh_get_point(geo.synthetic, 3 * (triangle - geo.synthetic_first) + corner)
    return wp.mesh_get_point(geo.real, 3 * triangle + corner)

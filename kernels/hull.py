"""Triangles on the convex hull of their object, which no ray that leaves them outwards meets again.

Half of the rays against synthetic surfaces start on such surfaces, where asking the tree costs most: they begin inside
of all the boxes that hold their own triangle.
"""

import warp as wp

from warp_dvct.kernels.geometry import OFFSET_RELATIVE, Geometry, largest_coordinate, meets_box
from warp_dvct.kernels.materials import Surface

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NO_BODY = wp.constant(-1)
SMALL = wp.constant(8)  # vertices in a small box
IN_LARGE = wp.constant(8)  # small boxes in a large one


@wp.struct
class Bodies:
    """The vertices of objects, in boxes of boxes of neighbours; a body's follow one another."""

    of_triangle: wp.array(dtype=wp.int32)  # [triangles], NO_BODY where not to ask
    middle: wp.array(dtype=wp.vec3)  # [bodies], mean of its vertices
    first: wp.array(dtype=wp.int32)  # [bodies + 1], large boxes
    center: wp.array(dtype=wp.vec3)  # [small boxes], their middles
    extent: wp.array(dtype=wp.vec3)  # [small boxes], half their edges
    large_center: wp.array(dtype=wp.vec3)  # [large boxes]
    large_extent: wp.array(dtype=wp.vec3)
    vertex: wp.array(dtype=wp.vec3)  # [small boxes * SMALL]


@wp.kernel
def _mark_hull(
    first: int,
    corner_in: wp.array(dtype=wp.vec3),
    bodies: Bodies,
    facing: int,
    eye: wp.vec3,
    hull_out: wp.array(dtype=wp.int32),
):
    """The body of each triangle that lies on its convex hull, else NO_BODY; where ``facing`` is set, of those alone
    that show ``eye`` their outer side.

    Its plane is that of ``materials.surface_at``, and vertices count as below where they are by half of the step that
    ``materials.spawn_point`` takes: a ray that begins there and goes outwards stays above all of them.
    """
    i = first + wp.tid()
    body = bodies.of_triangle[i]
    hull_out[i] = NO_BODY
    if body == NO_BODY:
        return
    p = corner_in[3 * i]
    q = corner_in[3 * i + 1]
    r = corner_in[3 * i + 2]
    normal = wp.normalize(wp.cross(q - p, r - p))
    if wp.length_sq(normal) == 0.0:
        return
    if wp.dot(normal, bodies.middle[body] - p) > 0.0:
        normal = -normal
    if facing != 0 and wp.dot(normal, eye - p) <= 0.0:
        return
    reach = wp.max(largest_coordinate(p), wp.max(largest_coordinate(q), largest_coordinate(r)))
    lowest = wp.min(0.0, wp.min(wp.dot(normal, q - p), wp.dot(normal, r - p)))
    limit = lowest + 0.5 * OFFSET_RELATIVE * reach
    across = wp.abs(normal)
    for large in range(bodies.first[body], bodies.first[body + 1]):
        if wp.dot(normal, bodies.large_center[large] - p) + wp.dot(across, bodies.large_extent[large]) > limit:
            for small in range(large * IN_LARGE, (large + 1) * IN_LARGE):
                if wp.dot(normal, bodies.center[small] - p) + wp.dot(across, bodies.extent[small]) > limit:
                    for k in range(small * SMALL, (small + 1) * SMALL):
                        if wp.dot(normal, bodies.vertex[k] - p) > limit:
                            return
    hull_out[i] = body


@wp.func
def body_left(geo: Geometry, s: Surface) -> int:
    """The object that no ray can meet which leaves ``s`` on the side of ``s.normal_g``, or NO_BODY."""
    if s.triangle < geo.synthetic_first:
        return NO_BODY
    body = geo.hull[s.triangle - geo.synthetic_first]
    if body != NO_BODY:
        # Seen from inside.
        if wp.dot(s.normal_g, geo.body_middle[body] - s.position) > 0.0:
            return NO_BODY
    return body


@wp.func
def clear_of_objects(
    geo: Geometry, body: int, normal: wp.vec3, origin: wp.vec3, direction: wp.vec3, t_max: float
) -> bool:
    """Whether a ray that leaves a surface of ``body`` (see ``body_left``) and of geometric ``normal`` certainly meets
    nothing synthetic: it goes outwards, and past the boxes of the other objects."""
    if body == NO_BODY or wp.dot(direction, normal) < 0.0:
        return False
    for k in range(geo.bodies):
        if k != body:
            if meets_box(geo.body_center[k], geo.body_extent[k], origin, direction, t_max):
                return False
    return True

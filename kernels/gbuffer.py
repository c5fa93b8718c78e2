"""Shading points: one at every pixel's centre, and more where the picture has an edge."""

import warp as wp

from warp_dvct.kernels import CPU_FLAGS
from warp_dvct.kernels.geometry import (
    FAR,
    CameraFrame,
    Geometry,
    Hit,
    camera_ray,
    trace_all,
    trace_real,
    trace_synthetic,
)
from warp_dvct.kernels.materials import Materials, Surface, surface_at
from warp_dvct.kernels.sampling import sobol2

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "cpu_compiler_flags": CPU_FLAGS})

BACKGROUND = wp.constant(-1)
REAL = wp.constant(0)
SYNTHETIC = wp.constant(1)

# ``Points.slot`` of a pixel's centre: the pixel's only point, or one that only guides because edge points replace it.
WHOLE = wp.constant(-1)
UNSEEN = wp.constant(-2)

# An edge: a neighbour farther off the tangent plane than this many pixel footprints, or turned by more than 18 degrees.
PLANE_GAP = wp.constant(1.5)
NORMAL_GAP = wp.constant(0.95)


@wp.struct
class Points:
    """Surfaces to be shaded, structure of arrays; ``role`` is BACKGROUND where there is none.

    Random numbers go by ``pixel`` and ``slot`` (:func:`first_sample`), so that a point keeps its own wherever else the
    picture has edges.
    """

    role: wp.array(dtype=wp.int32)
    pixel: wp.array(dtype=wp.vec2i)  # column and row
    slot: wp.array(dtype=wp.int32)  # which of an edge pixel's points, from 0; or WHOLE, UNSEEN
    triangle: wp.array(dtype=wp.int32)
    position: wp.array(dtype=wp.vec3)
    normal_g: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    view: wp.array(dtype=wp.vec3)  # unit vector to the camera
    base_color: wp.array(dtype=wp.vec3)
    diffuse: wp.array(dtype=wp.vec3)
    f0: wp.array(dtype=wp.vec3)
    lobe: wp.array(dtype=wp.vec2)  # f90 and GGX alpha
    reach: wp.array(dtype=wp.float32)
    footprint: wp.array(dtype=wp.float32)  # size of a pixel at the surface, in volume space


@wp.func
def load_surface(points: Points, i: int) -> Surface:
    s = Surface()
    s.position = points.position[i]
    s.normal_g = points.normal_g[i]
    s.normal = points.normal[i]
    s.base_color = points.base_color[i]
    s.diffuse = points.diffuse[i]
    s.f0 = points.f0[i]
    s.f90 = points.lobe[i][0]
    s.alpha = points.lobe[i][1]
    s.reach = points.reach[i]
    s.synthetic = wp.where(points.role[i] == SYNTHETIC, 1, 0)
    s.triangle = points.triangle[i]
    s.front = 1
    return s


@wp.func
def share_of(samples: int, points: Points, i: int, edge_samples: int) -> int:
    """How many of a pixel's samples a point takes: all, or an edge point's part of them."""
    if points.slot[i] >= 0:
        return (samples + edge_samples - 1) / edge_samples
    return samples


@wp.func
def pixel_points(points: Points, i: int, edge_samples: int) -> int:
    """How many points share the samples of a point's pixel."""
    return wp.where(points.slot[i] >= 0, edge_samples, 1)


@wp.func
def spread_bits(x: wp.uint32) -> wp.uint32:
    """The lower 16 bits, a zero between any two."""
    y = x & wp.uint32(0x0000FFFF)
    y = (y | (y << wp.uint32(8))) & wp.uint32(0x00FF00FF)
    y = (y | (y << wp.uint32(4))) & wp.uint32(0x0F0F0F0F)
    y = (y | (y << wp.uint32(2))) & wp.uint32(0x33333333)
    return (y | (y << wp.uint32(1))) & wp.uint32(0x55555555)


@wp.func
def first_sample(samples: int, share: int, stride: int, points: Points, i: int) -> int:
    """Where a point's samples start in the one Sobol' sequence of the picture.

    Blocks of ``stride`` x ``stride`` pixels take ``samples`` each along a Z curve, and a pixel's edge points ``share``
    each. Neighbours so have parts of the sequence that complement each other: their errors differ in sign, and average
    out under the eye's and under the reconstruction's filter (Ahmed & Wonka 2020).
    """
    pixel = points.pixel[i]
    x = spread_bits(wp.uint32(pixel[0] / stride))
    y = spread_bits(wp.uint32(pixel[1] / stride))
    return int(x | (y << wp.uint32(1))) * samples + wp.max(points.slot[i], 0) * share


@wp.func
def store_hit(
    geo: Geometry, mats: Materials, hit: Hit, origin: wp.vec3, direction: wp.vec3, spread: float, i: int, points: Points
):
    """Write all of a point but where it is in the picture. ``spread`` is the size of a pixel at distance 1."""
    s = Surface()
    role = BACKGROUND
    triangle = int(-1)
    footprint = float(0.0)
    if hit.found != 0:
        s = surface_at(geo, mats, hit, origin, direction)
        role = wp.where(hit.synthetic != 0, SYNTHETIC, REAL)
        triangle = hit.triangle
        footprint = hit.t * spread
    points.role[i] = role
    points.triangle[i] = triangle
    points.view[i] = -direction
    points.position[i] = s.position
    points.normal_g[i] = s.normal_g
    points.normal[i] = s.normal
    points.base_color[i] = s.base_color
    points.diffuse[i] = s.diffuse
    points.f0[i] = s.f0
    points.lobe[i] = wp.vec2(s.f90, s.alpha)
    points.reach[i] = s.reach
    points.footprint[i] = footprint


@wp.func
def see(
    geo: Geometry,
    mats: Materials,
    cam: CameraFrame,
    px: float,
    py: float,
    width: int,
    height: int,
    i: int,
    points: Points,
):
    ray = camera_ray(cam, px, py, width, height)
    hit = trace_all(geo, ray.origin, ray.direction, ray.t_max)
    spread = (cam.tan_right - cam.tan_left) / float(width)
    store_hit(geo, mats, hit, ray.origin, ray.direction, spread, i, points)


@wp.kernel
def _see_real(
    first: int,
    geo: Geometry,
    mats: Materials,
    cam: CameraFrame,
    width: int,
    height: int,
    points_out: Points,
    reach_out: wp.array(dtype=wp.float32),
):
    """The real scene alone at the pixels' centres, and where each ray ends."""
    i = first + wp.tid()
    ray = camera_ray(cam, float(i % width) + 0.5, float(i / width) + 0.5, width, height)
    hit = trace_real(geo, ray.origin, ray.direction, ray.t_max)
    spread = (cam.tan_right - cam.tan_left) / float(width)
    store_hit(geo, mats, hit, ray.origin, ray.direction, spread, i, points_out)
    points_out.pixel[i] = wp.vec2i(i % width, i / width)
    points_out.slot[i] = WHOLE
    reach_out[i] = hit.t


@wp.kernel
def _copy_points(first: int, source: Points, points_out: Points):
    i = first + wp.tid()
    points_out.role[i] = source.role[i]
    points_out.pixel[i] = source.pixel[i]
    points_out.slot[i] = source.slot[i]
    points_out.triangle[i] = source.triangle[i]
    points_out.position[i] = source.position[i]
    points_out.normal_g[i] = source.normal_g[i]
    points_out.normal[i] = source.normal[i]
    points_out.view[i] = source.view[i]
    points_out.base_color[i] = source.base_color[i]
    points_out.diffuse[i] = source.diffuse[i]
    points_out.f0[i] = source.f0[i]
    points_out.lobe[i] = source.lobe[i]
    points_out.reach[i] = source.reach[i]
    points_out.footprint[i] = source.footprint[i]


@wp.kernel
def _see_synthetic(
    first: int,
    geo: Geometry,
    mats: Materials,
    cam: CameraFrame,
    reach_in: wp.array(dtype=wp.float32),
    window: wp.vec4i,
    width: int,
    height: int,
    first_pixel: int,
    points_out: Points,
):
    """Put synthetic surfaces in front of what ``points_out`` holds of the real scene, once those of the frame before
    are taken out; for pixels from ``first_pixel`` on. None is seen outside of ``window``: its first and last column,
    first and last row."""
    i = first + wp.tid() + first_pixel
    points_out.slot[i] = WHOLE
    x = i % width
    y = i / width
    if x < window[0] or x > window[1] or y < window[2] or y > window[3]:
        if points_out.role[i] != SYNTHETIC:
            return
    ray = camera_ray(cam, float(x) + 0.5, float(y) + 0.5, width, height)
    spread = (cam.tan_right - cam.tan_left) / float(width)
    hit = trace_synthetic(geo, ray.origin, ray.direction, reach_in[i])
    if hit.found == 0 and points_out.role[i] == SYNTHETIC:
        hit = trace_real(geo, ray.origin, ray.direction, ray.t_max)
        store_hit(geo, mats, hit, ray.origin, ray.direction, spread, i, points_out)
    elif hit.found != 0:
        store_hit(geo, mats, hit, ray.origin, ray.direction, spread, i, points_out)


@wp.func
def differs(points: Points, i: int, j: int, paint: int) -> bool:
    """Whether an edge parts two points of different triangles."""
    role = points.role[i]
    if role != points.role[j]:
        return True
    if wp.dot(points.normal[i], points.normal[j]) < NORMAL_GAP:
        return True
    offset = points.position[j] - points.position[i]
    reach = PLANE_GAP * wp.max(points.footprint[i], points.footprint[j])
    gap = wp.max(wp.abs(wp.dot(offset, points.normal_g[i])), wp.abs(wp.dot(offset, points.normal_g[j])))
    if gap > reach:
        return True
    if role == REAL and paint == 0:
        return False
    change = wp.length(points.base_color[i] - points.base_color[j])
    return change > 0.1


@wp.kernel
def _mark_edges(
    first: int,
    points: Points,
    width: int,
    height: int,
    paint: int,
    first_pixel: int,
    mark_out: wp.array(dtype=wp.int32),
):
    """1 where any of the eight neighbours shows another surface, or another colour (of real ones if ``paint``); for
    pixels from ``first_pixel`` on."""
    i = first + wp.tid() + first_pixel
    x = i % width
    y = i / width
    left = wp.max(x - 1, 0)
    right = wp.min(x + 1, width - 1)
    triangle = points.triangle[i]
    mark = int(0)
    for row in range(wp.max(y - 1, 0), wp.min(y + 2, height)):
        for j in range(row * width + left, row * width + right + 1):
            # Most neighbours show the same triangle.
            if points.triangle[j] != triangle and mark == 0 and differs(points, i, j, paint):
                mark = 1
    mark_out[i] = mark


@wp.kernel
def _list_edges(
    first: int,
    mark_in: wp.array(dtype=wp.int32),
    end_in: wp.array(dtype=wp.int32),
    rank_out: wp.array(dtype=wp.int32),
    pixel_out: wp.array(dtype=wp.int32),
):
    """Rank of each marked element (-1 elsewhere), and the marked elements in order."""
    i = first + wp.tid()
    rank_out[i] = -1
    if mark_in[i] != 0:
        rank_out[i] = end_in[i] - 1
        pixel_out[end_in[i] - 1] = i


@wp.kernel
def _see_edges(
    first: int,
    geo: Geometry,
    mats: Materials,
    cam: CameraFrame,
    pixel_in: wp.array(dtype=wp.int32),
    kept: int,
    width: int,
    height: int,
    samples: int,
    seed: int,
    points_out: Points,
):
    """Sub-pixel points of the edge pixels, spread over the pixel's area; they follow the centres in ``points_out``,
    which holds those of the first ``kept`` edge pixels."""
    i = first + wp.tid() + kept * samples
    pixel = pixel_in[i / samples]
    xi = sobol2(seed, pixel, i % samples, 0)
    px = float(pixel % width) + xi[0]
    py = float(pixel / width) + xi[1]
    at = width * height + i
    see(geo, mats, cam, px, py, width, height, at, points_out)
    points_out.pixel[at] = wp.vec2i(pixel % width, pixel / width)
    points_out.slot[at] = i % samples
    if i % samples == 0:
        points_out.slot[pixel] = UNSEEN


@wp.kernel
def _mark_synthetic(first: int, points: Points, mark_out: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    mark_out[i] = wp.where(points.role[i] == SYNTHETIC, 1, 0)


@wp.kernel
def _see_behind(
    first: int,
    geo: Geometry,
    mats: Materials,
    cam: CameraFrame,
    visible: Points,
    index_in: wp.array(dtype=wp.int32),
    width: int,
    points_out: Points,
):
    """Real surfaces behind synthetic points: the real scene alone where the two G-buffers differ."""
    i = first + wp.tid()
    j = index_in[i]
    direction = -visible.view[j]
    spread = (cam.tan_right - cam.tan_left) / float(width)
    start = visible.position[j]
    travelled = wp.dot(start - cam.origin, direction)
    reach = wp.min(cam.far / wp.dot(direction, cam.forward), FAR) - travelled
    hit = trace_real(geo, start, direction, reach)
    hit.t += travelled
    store_hit(geo, mats, hit, cam.origin, direction, spread, i, points_out)
    points_out.pixel[i] = visible.pixel[j]
    points_out.slot[i] = visible.slot[j]

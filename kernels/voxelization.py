"""Sparse voxelization: triangles are cut by the voxel grid into fragments of exact area.

A closed surface is watertight in the grid by construction: the fragments of a column of voxels sum to the area of the
surface in it, with no conservative thickening and no gaps.
"""

import warp as wp

from warp_dvct.kernels.sorting import EMPTY_KEY
from warp_dvct.kernels.volume import BRICK, brick_extent, cell_key, face_weight, key_cell

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SLIVER = wp.constant(1.0e-7)  # voxel faces; smaller cuts are rounding where a triangle only touches a voxel,
SLIVER_SHARE = wp.constant(1.0e-3)  # unless they are more than this share of a triangle that is itself so small
MAX_CORNERS = wp.constant(10)  # a triangle cut by six planes has at most nine corners

Corners = wp.types.matrix(shape=(10, 3), dtype=wp.float32)


@wp.struct
class Polygon:
    corners: Corners
    count: wp.int32


@wp.struct
class Triangle:
    """A triangle in voxel units of the grid, with the bounds that overlap tests need."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    low: wp.vec3
    high: wp.vec3
    normal: wp.vec3


@wp.func
def load_triangle(corners_in: wp.array(dtype=wp.vec3), index: int, low: wp.vec3, voxel: float) -> Triangle:
    triangle = Triangle()
    triangle.a = (corners_in[3 * index] - low) / voxel
    triangle.b = (corners_in[3 * index + 1] - low) / voxel
    triangle.c = (corners_in[3 * index + 2] - low) / voxel
    triangle.low = wp.min(wp.min(triangle.a, triangle.b), triangle.c)
    triangle.high = wp.max(wp.max(triangle.a, triangle.b), triangle.c)
    triangle.normal = wp.cross(triangle.b - triangle.a, triangle.c - triangle.a)
    return triangle


@wp.func
def edge_reaches(p: wp.vec2, q: wp.vec2, side: float, low: wp.vec2, size: float) -> bool:
    """Whether the square at ``low`` is not wholly outside of the edge p -> q of a triangle wound by ``side``."""
    normal = wp.vec2(p[1] - q[1], q[0] - p[0]) * side
    farthest = wp.vec2(
        wp.where(normal[0] > 0.0, low[0] + size, low[0]), wp.where(normal[1] > 0.0, low[1] + size, low[1])
    )
    return wp.dot(normal, farthest - p) >= 0.0


@wp.func
def projection_overlaps(a: wp.vec2, b: wp.vec2, c: wp.vec2, area: float, low: wp.vec2, size: float) -> bool:
    side = wp.where(area >= 0.0, 1.0, -1.0)
    return (
        edge_reaches(a, b, side, low, size)
        and edge_reaches(b, c, side, low, size)
        and edge_reaches(c, a, side, low, size)
    )


@wp.func
def overlaps(triangle: Triangle, low: wp.vec3, size: float) -> bool:
    """Separating-axis test of a triangle and the cube at ``low``, closed on all sides (Schwarz and Seidel 2010)."""
    for axis in range(3):
        if triangle.high[axis] < low[axis] or triangle.low[axis] > low[axis] + size:
            return False
    n = triangle.normal
    middle = low + wp.vec3(0.5 * size, 0.5 * size, 0.5 * size)
    reach = 0.5 * size * (wp.abs(n[0]) + wp.abs(n[1]) + wp.abs(n[2]))
    if wp.abs(wp.dot(n, middle - triangle.a)) > reach * 1.00001:
        return False
    a = triangle.a
    b = triangle.b
    c = triangle.c
    if not projection_overlaps(
        wp.vec2(a[1], a[2]), wp.vec2(b[1], b[2]), wp.vec2(c[1], c[2]), n[0], wp.vec2(low[1], low[2]), size
    ):
        return False
    if not projection_overlaps(
        wp.vec2(a[2], a[0]), wp.vec2(b[2], b[0]), wp.vec2(c[2], c[0]), n[1], wp.vec2(low[2], low[0]), size
    ):
        return False
    return projection_overlaps(
        wp.vec2(a[0], a[1]), wp.vec2(b[0], b[1]), wp.vec2(c[0], c[1]), n[2], wp.vec2(low[0], low[1]), size
    )


@wp.func
def clip_side(polygon: Polygon, axis: int, bound: float, sign: float) -> Polygon:
    """Keep the part of a convex polygon where ``sign * (bound - p[axis]) >= 0`` (Sutherland and Hodgman 1974)."""
    result = Polygon()
    result.count = 0
    for i in range(polygon.count):
        j = wp.where(i + 1 == polygon.count, 0, i + 1)
        p = wp.vec3(polygon.corners[i, 0], polygon.corners[i, 1], polygon.corners[i, 2])
        q = wp.vec3(polygon.corners[j, 0], polygon.corners[j, 1], polygon.corners[j, 2])
        dp = sign * (bound - p[axis])
        dq = sign * (bound - q[axis])
        if dp >= 0.0 and result.count < MAX_CORNERS:
            result.corners[result.count, 0] = p[0]
            result.corners[result.count, 1] = p[1]
            result.corners[result.count, 2] = p[2]
            result.count += 1
        if ((dp > 0.0 and dq < 0.0) or (dp < 0.0 and dq > 0.0)) and result.count < MAX_CORNERS:
            cut = p + (q - p) * (dp / (dp - dq))
            cut[axis] = bound
            result.corners[result.count, 0] = cut[0]
            result.corners[result.count, 1] = cut[1]
            result.corners[result.count, 2] = cut[2]
            result.count += 1
    return result


@wp.func
def cut_triangle(triangle: Triangle, low: wp.vec3) -> Polygon:
    """The part of a triangle in the unit cube at ``low``, in the cube's own coordinates."""
    polygon = Polygon()
    polygon.count = 3
    a = triangle.a - low
    b = triangle.b - low
    c = triangle.c - low
    for k in range(3):
        polygon.corners[0, k] = a[k]
        polygon.corners[1, k] = b[k]
        polygon.corners[2, k] = c[k]
    for axis in range(3):
        if triangle.low[axis] < low[axis]:
            polygon = clip_side(polygon, axis, 0.0, -1.0)
        if triangle.high[axis] > low[axis] + 1.0:
            polygon = clip_side(polygon, axis, 1.0, 1.0)
    return polygon


@wp.func
def polygon_moments(polygon: Polygon) -> wp.vec4:
    """Centroid and area of a planar convex polygon."""
    origin = wp.vec3(polygon.corners[0, 0], polygon.corners[0, 1], polygon.corners[0, 2])
    moment = wp.vec3(0.0, 0.0, 0.0)
    area = float(0.0)
    for i in range(1, polygon.count - 1):
        p = wp.vec3(polygon.corners[i, 0], polygon.corners[i, 1], polygon.corners[i, 2])
        q = wp.vec3(polygon.corners[i + 1, 0], polygon.corners[i + 1, 1], polygon.corners[i + 1, 2])
        part = 0.5 * wp.length(wp.cross(p - origin, q - origin))
        area += part
        moment += (part / 3.0) * (origin + p + q)
    if area > 0.0:
        moment = moment / area
    return wp.vec4(moment[0], moment[1], moment[2], area)


@wp.struct
class Span:
    """Cells to visit, both ends included."""

    low: wp.vec3i
    high: wp.vec3i


@wp.func
def first_index(low: float, size: int) -> int:
    return wp.clamp(int(wp.floor(low)), 0, size - 1)


@wp.func
def tile_span(triangle: Triangle, tiles: int) -> Span:
    """Tiles that a triangle's bounds touch."""
    span = Span()
    for axis in range(3):
        span.low[axis] = first_index(triangle.low[axis] / 8.0, tiles)
        span.high[axis] = first_index(triangle.high[axis] / 8.0, tiles)
    return span


@wp.func
def voxel_span(triangle: Triangle, start: wp.vec3i, n: int) -> Span:
    """Voxels of the tile at ``start`` that a triangle's bounds touch."""
    span = Span()
    for axis in range(3):
        span.low[axis] = wp.max(start[axis], first_index(triangle.low[axis], n))
        span.high[axis] = wp.min(start[axis] + 7, first_index(triangle.high[axis], n))
    return span


@wp.kernel
def _count_tiles(
    first: int,
    corners_in: wp.array(dtype=wp.vec3),
    low: wp.vec3,
    voxel: float,
    n: int,
    count_out: wp.array(dtype=wp.int32),
):
    """Tiles (cubes of 8^3 voxels) that a triangle overlaps."""
    i = first + wp.tid()
    triangle = load_triangle(corners_in, i, low, voxel)
    tiles = brick_extent(n, 0)
    count = int(0)
    edge = float(n)
    outside = False
    for axis in range(3):
        if triangle.high[axis] < 0.0 or triangle.low[axis] > edge:
            outside = True
    if not outside:
        span = tile_span(triangle, tiles)
        for z in range(span.low[2], span.high[2] + 1):
            for y in range(span.low[1], span.high[1] + 1):
                for x in range(span.low[0], span.high[0] + 1):
                    if overlaps(triangle, wp.vec3(float(x), float(y), float(z)) * 8.0, 8.0):
                        count += 1
    count_out[i] = count


@wp.kernel
def _list_tiles(
    first: int,
    corners_in: wp.array(dtype=wp.vec3),
    end_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    low: wp.vec3,
    voxel: float,
    n: int,
    tile_triangle_out: wp.array(dtype=wp.int32),
    tile_out: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    count = count_in[i]
    if count == 0:
        return
    at = end_in[i] - count
    triangle = load_triangle(corners_in, i, low, voxel)
    tiles = brick_extent(n, 0)
    span = tile_span(triangle, tiles)
    for z in range(span.low[2], span.high[2] + 1):
        for y in range(span.low[1], span.high[1] + 1):
            for x in range(span.low[0], span.high[0] + 1):
                if overlaps(triangle, wp.vec3(float(x), float(y), float(z)) * 8.0, 8.0):
                    tile_triangle_out[at] = i
                    tile_out[at] = (z * tiles + y) * tiles + x
                    at += 1


@wp.func
def tile_cell(tile: int, tiles: int) -> wp.vec3i:
    """First voxel of a tile."""
    return wp.vec3i((tile % tiles) * BRICK, ((tile / tiles) % tiles) * BRICK, (tile / (tiles * tiles)) * BRICK)


@wp.kernel
def _count_fragments(
    first: int,
    corners_in: wp.array(dtype=wp.vec3),
    tile_triangle_in: wp.array(dtype=wp.int32),
    tile_in: wp.array(dtype=wp.int32),
    low: wp.vec3,
    voxel: float,
    n: int,
    count_out: wp.array(dtype=wp.int32),
):
    """Voxels of a tile that a triangle may overlap."""
    i = first + wp.tid()
    triangle = load_triangle(corners_in, tile_triangle_in[i], low, voxel)
    start = tile_cell(tile_in[i], brick_extent(n, 0))
    count = int(0)
    span = voxel_span(triangle, start, n)
    for z in range(span.low[2], span.high[2] + 1):
        for y in range(span.low[1], span.high[1] + 1):
            for x in range(span.low[0], span.high[0] + 1):
                if overlaps(triangle, wp.vec3(float(x), float(y), float(z)), 1.0):
                    count += 1
    count_out[i] = count


@wp.kernel
def _list_fragments(
    first: int,
    corners_in: wp.array(dtype=wp.vec3),
    tile_triangle_in: wp.array(dtype=wp.int32),
    tile_in: wp.array(dtype=wp.int32),
    end_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    low: wp.vec3,
    voxel: float,
    n: int,
    key_out: wp.array(dtype=wp.int32),
    triangle_out: wp.array(dtype=wp.int32),
):
    """The voxels that ``_count_fragments`` counts."""
    i = first + wp.tid()
    at = end_in[i] - count_in[i]
    index = tile_triangle_in[i]
    triangle = load_triangle(corners_in, index, low, voxel)
    bricks = brick_extent(n, 0)
    span = voxel_span(triangle, tile_cell(tile_in[i], bricks), n)
    for z in range(span.low[2], span.high[2] + 1):
        for y in range(span.low[1], span.high[1] + 1):
            for x in range(span.low[0], span.high[0] + 1):
                if overlaps(triangle, wp.vec3(float(x), float(y), float(z)), 1.0):
                    key_out[at] = cell_key(x, y, z, bricks)
                    triangle_out[at] = index
                    at += 1


@wp.kernel
def _cut_fragments(
    first: int,
    corners_in: wp.array(dtype=wp.vec3),
    triangle_in: wp.array(dtype=wp.int32),
    low: wp.vec3,
    voxel: float,
    n: int,
    key_out: wp.array(dtype=wp.int32),
    fragment_out: wp.array(dtype=wp.vec4),
):
    """A triangle's fragment in a listed voxel: centroid in volume space and area in voxel faces.

    A triangle in the plane between two voxels is met by both; it belongs to the upper one, as cubes are half open. What
    was listed and not cut gets ``EMPTY_KEY``.
    """
    i = first + wp.tid()
    triangle = load_triangle(corners_in, triangle_in[i], low, voxel)
    cell = key_cell(key_out[i], brick_extent(n, 0))
    corner = wp.vec3(float(cell[0]), float(cell[1]), float(cell[2]))
    moments = polygon_moments(cut_triangle(triangle, corner))
    mine = moments[3] > wp.min(SLIVER, 0.5 * SLIVER_SHARE * wp.length(triangle.normal))
    for axis in range(3):
        # The outermost voxels are closed on the far side too: a wall may lie on the box's border.
        if triangle.low[axis] >= corner[axis] + 1.0 and cell[axis] < n - 1:
            mine = False
    if not mine:
        key_out[i] = EMPTY_KEY
    position = low + (corner + wp.vec3(moments[0], moments[1], moments[2])) * voxel
    fragment_out[i] = wp.vec4(position[0], position[1], position[2], moments[3])


@wp.kernel
def _sort_fragments(
    first: int,
    order_in: wp.array(dtype=wp.int32),
    key_in: wp.array(dtype=wp.int32),
    triangle_in: wp.array(dtype=wp.int32),
    fragment_in: wp.array(dtype=wp.vec4),
    key_out: wp.array(dtype=wp.int32),
    triangle_out: wp.array(dtype=wp.int32),
    fragment_out: wp.array(dtype=wp.vec4),
):
    i = first + wp.tid()
    key_out[i] = key_in[i]
    triangle_out[i] = triangle_in[order_in[i]]
    fragment_out[i] = fragment_in[order_in[i]]


@wp.kernel
def _join_fragments(
    first: int,
    key_in: wp.array(dtype=wp.int32),
    triangle_in: wp.array(dtype=wp.int32),
    fragment_in: wp.array(dtype=wp.vec4),
    other_key_in: wp.array(dtype=wp.int32),
    others: int,
    ties: int,
    triangle_first: int,
    key_out: wp.array(dtype=wp.int32),
    triangle_out: wp.array(dtype=wp.int32),
    fragment_out: wp.array(dtype=wp.vec4),
):
    """Put one of two sorted lists where it belongs in their union; ``ties`` is 1 where equal keys of the other list
    come first."""
    i = first + wp.tid()
    key = key_in[i]
    low = int(0)
    high = int(others)
    while low < high:
        middle = (low + high) / 2
        if other_key_in[middle] < key + ties:
            low = middle + 1
        else:
            high = middle
    key_out[i + low] = key
    triangle_out[i + low] = triangle_in[i] + triangle_first
    fragment_out[i + low] = fragment_in[i]


@wp.kernel
def _parent_keys(first: int, key_in: wp.array(dtype=wp.int32), n: int, level: int, key_out: wp.array(dtype=wp.int32)):
    """Keys, one level up, of the voxels that hold the voxels of a level."""
    i = first + wp.tid()
    cell = key_cell(key_in[i], brick_extent(n, level))
    key_out[i] = cell_key(cell[0] >> 1, cell[1] >> 1, cell[2] >> 1, brick_extent(n, level + 1))


@wp.kernel
def _fill_table(
    first: int,
    brick_in: wp.array(dtype=wp.int32),
    table_start: int,
    brick_start: int,
    tables_out: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    tables_out[table_start + brick_in[i]] = brick_start + i


@wp.kernel
def _fill_cells(
    first: int,
    key_in: wp.array(dtype=wp.int32),
    tables_in: wp.array(dtype=wp.int32),
    table_start: int,
    record_start: int,
    cells_out: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    key = key_in[i]
    brick = tables_in[table_start + (key >> 9)]
    cells_out[brick * 512 + (key & 511)] = record_start + i


@wp.kernel
def _sum_areas(
    first: int,
    record_start_in: wp.array(dtype=wp.int32),
    order_in: wp.array(dtype=wp.int32),
    triangle_in: wp.array(dtype=wp.int32),
    fragment_in: wp.array(dtype=wp.vec4),
    normal_in: wp.array(dtype=wp.vec3),
    double_sided_in: wp.array(dtype=wp.int32),
    synthetic_first: int,
    fragments: int,
    records: int,
    area_out: wp.array(dtype=wp.vec2),
):
    """Projected front-facing area of each face of a record, before (real) and after (all), in voxel faces.

    Where both kinds together exceed the face, one lies over the other (a rug on a floor): the light that reaches the
    face is then spread over the face, not over what is hidden as well.
    """
    i = first + wp.tid()
    end = fragments
    if i + 1 < records:
        end = record_start_in[i + 1]
    for face in range(6):
        real_sum = wp.float64(0.0)  # double: a voxel may hold a million fragments
        synthetic_sum = wp.float64(0.0)
        for j in range(record_start_in[i], end):
            fragment = order_in[j]
            triangle = triangle_in[fragment]
            normal = normal_in[triangle]
            shown = face_weight(normal, face)
            if double_sided_in[triangle] != 0:
                shown += face_weight(-normal, face)
            if triangle >= synthetic_first:
                synthetic_sum += wp.float64(shown * fragment_in[fragment][3])
            else:
                real_sum += wp.float64(shown * fragment_in[fragment][3])
        real = float(real_sum)
        synthetic = float(synthetic_sum)
        area_out[i * 6 + face] = wp.vec2(real, wp.min(real + synthetic, wp.max(wp.max(real, synthetic), 1.0)))

"""Sparse gathering: which points are gathered, and guided reconstruction at all others."""

import warp as wp

from warp_dvct.kernels.gbuffer import BACKGROUND, Points
from warp_dvct.kernels.sampling import uniform1

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Spot:
    """A gathered point, in one piece: every pixel asks those of the blocks around it."""

    position: wp.vec3
    normal_g: wp.vec3
    normal: wp.vec3
    center: wp.vec2  # of its pixel, in pixels
    triangle: wp.int32


@wp.struct
class Gathered:
    """The gathered point of each block of the picture."""

    choice: wp.array(dtype=wp.int32)  # [columns * rows], the point, or -1
    spot: wp.array(dtype=Spot)


@wp.kernel
def _choose_points(
    first: int,
    points: Points,
    width: int,
    height: int,
    stride: int,
    columns: int,
    window: wp.vec4i,
    role: int,
    seed: int,
    gathered_out: Gathered,
):
    """The pixel that stands for a ``stride`` x ``stride`` block: a hashed one if it has the role, else the next that
    has; -1 where none has. None has outside of ``window``: first and last column, first and last row."""
    i = first + wp.tid()
    bx = (i % columns) * stride
    by = (i / columns) * stride
    cells = stride * stride
    if bx > window[1] or bx + stride <= window[0] or by > window[3] or by + stride <= window[2]:
        cells = 0
    start = int(uniform1(seed, i, 0, 7) * float(cells))
    found = int(-1)
    tried = int(0)
    while found < 0 and tried < cells:
        cell = (start + tried) % cells
        x = bx + cell % stride
        y = by + cell / stride
        if x < width and y < height:
            if points.role[y * width + x] == role:
                found = y * width + x
        tried += 1
    gathered_out.choice[i] = found
    if found >= 0:
        spot = Spot()
        spot.position = points.position[found]
        spot.normal_g = points.normal_g[found]
        spot.normal = points.normal[found]
        spot.center = wp.vec2(float(found % width) + 0.5, float(found / width) + 0.5)
        spot.triangle = points.triangle[found]
        gathered_out.spot[i] = spot


@wp.struct
class Guide:
    """How far a gathered point may lend its irradiance to another."""

    stride: wp.int32
    columns: wp.int32
    rows: wp.int32
    radius: wp.int32  # blocks to each side
    plane: wp.float32  # tolerated distance off the tangent plane, in pixel footprints times stride
    reach: wp.float32  # smoothing: tolerated distance over the mean distance of the surfaces around


@wp.func
def falloff(square: float) -> float:
    """exp(-square) to within 0.08, and 0 from a square of 4 on; no call to a library."""
    rest = wp.max(1.0 - 0.25 * square, 0.0)
    rest = rest * rest
    return rest * rest


@wp.func
def same_surface(
    triangle: int,
    position: wp.vec3,
    normal_g: wp.vec3,
    normal: wp.vec3,
    tolerance: float,
    spot: Spot,
) -> float:
    """Weight in [0, 1] by how well two points lie in each other's tangent plane and face the same way; ``tolerance`` is
    the distance off the plane at which they hardly count. Points of one triangle lie in its plane."""
    facing = wp.max(wp.dot(normal, spot.normal), 0.0)
    square = facing * facing
    fourth = square * square
    if spot.triangle == triangle:
        return fourth * fourth
    offset = spot.position - position
    gap = wp.max(wp.abs(wp.dot(offset, normal_g)), wp.abs(wp.dot(offset, spot.normal_g))) / tolerance
    return fourth * fourth * falloff(gap * gap)


@wp.kernel
def _smooth(
    first: int,
    points: Points,
    gathered: Gathered,
    guide: Guide,
    spacing: int,
    mark_in: wp.array(dtype=wp.int32),
    before_in: wp.array(dtype=wp.vec3),
    after_in: wp.array(dtype=wp.vec3),
    nearness_in: wp.array(dtype=wp.float32),
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
):
    """One a-trous step over the gathered points: an average of those on the same surface, as far as irradiance can be
    smooth there, that is over a share of the harmonic mean distance to what they see (Ward et al. 1988). Blocks that
    ``mark_in`` does not mark stay as they are."""
    i = first + wp.tid()
    at = gathered.choice[i]
    total = float(1.0)
    before = before_in[i]
    after = after_in[i]
    if at >= 0 and mark_in[i] != 0:
        cx = i % guide.columns
        cy = i / guide.columns
        own = gathered.spot[i]
        tolerance = guide.plane * float(guide.stride) * points.footprint[at]
        for dy in range(-guide.radius, guide.radius + 1):
            for dx in range(-guide.radius, guide.radius + 1):
                bx = cx + dx * spacing
                by = cy + dy * spacing
                if (dx != 0 or dy != 0) and bx >= 0 and by >= 0 and bx < guide.columns and by < guide.rows:
                    block = by * guide.columns + bx
                    if gathered.choice[block] >= 0:
                        spot = gathered.spot[block]
                        # Both must see far: a smooth point does not smooth one at a contact.
                        inverse = wp.max(nearness_in[i], nearness_in[block]) / guide.reach
                        apart = wp.length_sq(spot.position - own.position) * inverse * inverse
                        weight = falloff(apart)
                        weight *= same_surface(own.triangle, own.position, own.normal_g, own.normal, tolerance, spot)
                        weight = wp.where(weight > 1.0e-3, weight, 0.0)
                        total += weight
                        before += before_in[block] * weight
                        after += after_in[block] * weight
    before_out[i] = before / total
    after_out[i] = after / total


@wp.struct
class Interpolated:
    before: wp.vec3
    after: wp.vec3
    missing: wp.int32  # 1: no gathered point lies on the same surface


@wp.func
def interpolated(
    points: Points,
    i: int,
    guide: Guide,
    gathered: Gathered,
    before_in: wp.array(dtype=wp.vec3),
    after_in: wp.array(dtype=wp.vec3),
) -> Interpolated:
    """Mean of the points gathered around, weighted by distance in the picture, plane and normal."""
    result = Interpolated()
    px = float(points.pixel[i][0]) + 0.5
    py = float(points.pixel[i][1]) + 0.5
    position = points.position[i]
    normal = points.normal[i]
    normal_g = points.normal_g[i]
    triangle = points.triangle[i]
    tolerance = guide.plane * float(guide.stride) * points.footprint[i]
    cx = points.pixel[i][0] / guide.stride
    cy = points.pixel[i][1] / guide.stride
    extent = float(guide.stride) * (float(guide.radius) + 0.5)
    scale = 1.0 / (extent * extent)
    total = float(0.0)
    before = wp.vec3(0.0, 0.0, 0.0)
    after = wp.vec3(0.0, 0.0, 0.0)
    for by in range(wp.max(cy - guide.radius, 0), wp.min(cy + guide.radius, guide.rows - 1) + 1):
        for bx in range(wp.max(cx - guide.radius, 0), wp.min(cx + guide.radius, guide.columns - 1) + 1):
            block = by * guide.columns + bx
            if gathered.choice[block] >= 0:
                spot = gathered.spot[block]
                dx = spot.center[0] - px
                dy = spot.center[1] - py
                near = wp.max(0.0, 1.0 - (dx * dx + dy * dy) * scale)
                weight = near * near * same_surface(triangle, position, normal_g, normal, tolerance, spot)
                # Added without a branch: no processor can foresee which blocks count.
                weight = wp.where(weight > 1.0e-4, weight, 0.0)
                total += weight
                before += before_in[block] * weight
                after += after_in[block] * weight
    if total > 1.0e-3:
        result.before = before / total
        result.after = after / total
    else:
        result.missing = 1
    return result


@wp.kernel
def _find_detail(
    first: int,
    points: Points,
    fine_columns: int,
    fine: Gathered,
    guide: Guide,
    gathered: Gathered,
    nearness_in: wp.array(dtype=wp.float32),
    before_in: wp.array(dtype=wp.vec3),
    after_in: wp.array(dtype=wp.vec3),
    limit: float,
    mark_out: wp.array(dtype=wp.int32),
    nearness_out: wp.array(dtype=wp.float32),
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
):
    """Where blocks of half the stride have to be gathered, and the interpolated irradiance of the others.

    By the split-sphere bound on how fast irradiance can change (Ward et al. 1988): the way to the point gathered in the
    block (half a block at least), over the harmonic mean distance of what that saw, plus the turn of the normal.
    """
    i = first + wp.tid()
    j = fine.choice[i]
    mark = int(0)
    nearness_out[i] = 0.0
    before_out[i] = wp.vec3(0.0, 0.0, 0.0)
    after_out[i] = wp.vec3(0.0, 0.0, 0.0)
    if j >= 0:
        block = ((i / fine_columns) / 2) * guide.columns + (i % fine_columns) / 2
        half = 0.5 * float(guide.stride) * points.footprint[j]
        spot = fine.spot[i]
        around = gathered.spot[block]
        way = wp.max(wp.length(spot.position - around.position), half) * nearness_in[block]
        turn = wp.sqrt(wp.max(1.0 - wp.dot(spot.normal, around.normal), 0.0))
        found = interpolated(points, j, guide, gathered, before_in, after_in)
        nearness_out[i] = nearness_in[block]
        before_out[i] = found.before
        after_out[i] = found.after
        if found.missing != 0 or way + turn > limit:
            mark = 1
    mark_out[i] = mark


@wp.kernel
def _reconstruct(
    first: int,
    points: Points,
    role: int,
    guide: Guide,
    gathered: Gathered,
    before_in: wp.array(dtype=wp.vec3),
    after_in: wp.array(dtype=wp.vec3),
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
    missing_out: wp.array(dtype=wp.int32),
):
    """Irradiance of every point of a role from the gathered ones around, weighted by distance, plane and normal; 0 at
    the background.

    ``missing_out`` is 1 where none of them lies on the same surface.
    """
    i = first + wp.tid()
    missing = int(0)
    if points.role[i] == BACKGROUND:
        before_out[i] = wp.vec3(0.0, 0.0, 0.0)
        after_out[i] = wp.vec3(0.0, 0.0, 0.0)
    if points.role[i] == role:
        found = interpolated(points, i, guide, gathered, before_in, after_in)
        missing = found.missing
        if missing == 0:
            before_out[i] = found.before
            after_out[i] = found.after
    missing_out[i] = missing


@wp.kernel
def _pick(
    first: int,
    listed_in: wp.array(dtype=wp.int32),
    choice_in: wp.array(dtype=wp.int32),
    index_out: wp.array(dtype=wp.int32),
):
    """The points of listed blocks."""
    i = first + wp.tid()
    index_out[i] = choice_in[listed_in[i]]


@wp.kernel
def _put_detail(
    first: int,
    listed_in: wp.array(dtype=wp.int32),
    before_in: wp.array(dtype=wp.vec3),
    after_in: wp.array(dtype=wp.vec3),
    found_nearness_in: wp.array(dtype=wp.float32),
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
    nearness_out: wp.array(dtype=wp.float32),
):
    """Put what was gathered in listed blocks where they are; every block is listed once."""
    i = first + wp.tid()
    before_out[listed_in[i]] = before_in[i]
    after_out[listed_in[i]] = after_in[i]
    nearness_out[listed_in[i]] = found_nearness_in[i]


@wp.kernel
def _scatter_missing(
    first: int,
    index_in: wp.array(dtype=wp.int32),
    before_in: wp.array(dtype=wp.vec3),
    after_in: wp.array(dtype=wp.vec3),
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
):
    """Put what was gathered at listed points where they are; every point is listed once."""
    i = first + wp.tid()
    before_out[index_in[i]] = before_in[i]
    after_out[index_in[i]] = after_in[i]


@wp.kernel
def _mark_role(first: int, points: Points, role: int, mark_out: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    mark_out[i] = wp.where(points.role[i] == role, 1, 0)

"""Filtering a stream of depth images (Knecht et al. 2012, section 4), on inverse depth.

Inverse depth suits every step: a plane's is affine in the picture, so triangles interpolate it exactly and symmetric
averages do not bend it; noise of disparity is the same at all distances; and 0 stands for "nothing measured", which is
infinitely far away and never a surface at the origin. Camera axes are OpenCV's, pixel centres have whole coordinates.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SOURCE_TILE = wp.constant(8)  # quads an edge of the blocks whose boxes are tested
TARGET_TILE = wp.constant(16)  # pixels an edge of what one thread draws

NOTHING = wp.constant(0)
MEASURED = wp.constant(1)  # by this frame, perhaps averaged with earlier ones
CARRIED = wp.constant(2)  # by earlier frames alone
FILLED = wp.constant(3)  # by none: guessed from around

NEAR = wp.constant(0.01)  # m: what comes nearer to the new camera is not drawn


@wp.struct
class Lens:
    """A pinhole, in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


@wp.struct
class Limits:
    """Thresholds of inverse depth: ``fixed + share * inverse depth``."""

    edge_fixed: float  # [1/m] between neighbours of one surface
    edge_share: float
    agree_fixed: float  # [1/m] between two measurements of one point
    agree_share: float


@wp.func
def same_surface(a: float, b: float, limits: Limits) -> bool:
    """Whether two neighbours, both measured, are on one surface."""
    nearest = wp.max(a, b)
    return a > 0.0 and b > 0.0 and wp.abs(a - b) <= limits.edge_fixed + limits.edge_share * nearest


@wp.kernel
def _invert(first: int, depth_in: wp.array(dtype=wp.float32), inverse_out: wp.array(dtype=wp.float32)):
    i = first + wp.tid()
    z = depth_in[i]
    inverse_out[i] = wp.where(z > 0.0, 1.0 / wp.max(z, NEAR), 0.0)


@wp.kernel
def _move_vertices(
    first: int,
    lens: Lens,
    inverse_in: wp.array(dtype=wp.float32),
    turn: wp.mat33,
    shift: wp.vec3,
    moved_out: wp.array(dtype=wp.vec3),
):
    """p_hat = T_warp p (eqs. 11-13): each pixel's place in the new view (u, v) and its inverse depth (eq. 14) there."""
    i = first + wp.tid()
    moved = wp.vec3(0.0, 0.0, 0.0)
    rho = inverse_in[i]
    if rho > 0.0:
        u, v = float(i % lens.width), float(i / lens.width)
        p = turn * (wp.vec3((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, 1.0) / rho) + shift
        if p[2] > NEAR:
            moved = wp.vec3(lens.fx * p[0] / p[2] + lens.cx, lens.fy * p[1] / p[2] + lens.cy, 1.0 / p[2])
    moved_out[i] = moved


@wp.kernel
def _bound_tiles(
    first: int, lens: Lens, moved_in: wp.array(dtype=wp.vec3), tiles_across: int, box_out: wp.array(dtype=wp.vec4)
):
    """Where a block of quads lies in the new view: (least u, least v, most u, most v); inverted where it is empty."""
    t = first + wp.tid()
    x0 = (t % tiles_across) * SOURCE_TILE
    y0 = (t / tiles_across) * SOURCE_TILE
    box = wp.vec4(1.0e9, 1.0e9, -1.0e9, -1.0e9)
    for y in range(y0, wp.min(y0 + SOURCE_TILE + 1, lens.height)):
        for x in range(x0, wp.min(x0 + SOURCE_TILE + 1, lens.width)):
            p = moved_in[y * lens.width + x]
            if p[2] > 0.0:
                box = wp.vec4(wp.min(box[0], p[0]), wp.min(box[1], p[1]), wp.max(box[2], p[0]), wp.max(box[3], p[1]))
    box_out[t] = box


@wp.func
def draw_triangle(
    lens: Lens,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    weight: wp.vec3,
    x0: int,
    y0: int,
    x1: int,
    y1: int,
    inverse: wp.array(dtype=wp.float32),
    weights: wp.array(dtype=wp.float32),
):
    """Draw what of a triangle lies in pixels x0 … x1 - 1, y0 … y1 - 1, where it is nearer than what is there."""
    area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if area <= 0.0:
        return  # seen from behind
    left = wp.max(x0, int(wp.ceil(wp.min(a[0], wp.min(b[0], c[0])))))
    right = wp.min(x1 - 1, int(wp.floor(wp.max(a[0], wp.max(b[0], c[0])))))
    top = wp.max(y0, int(wp.ceil(wp.min(a[1], wp.min(b[1], c[1])))))
    bottom = wp.min(y1 - 1, int(wp.floor(wp.max(a[1], wp.max(b[1], c[1])))))
    for y in range(top, bottom + 1):
        for x in range(left, right + 1):
            px, py = float(x), float(y)
            wa = (c[0] - b[0]) * (py - b[1]) - (px - b[0]) * (c[1] - b[1])
            wb = (a[0] - c[0]) * (py - c[1]) - (px - c[0]) * (a[1] - c[1])
            wc = (b[0] - a[0]) * (py - a[1]) - (px - a[0]) * (b[1] - a[1])
            if wa >= 0.0 and wb >= 0.0 and wc >= 0.0:
                rho = (wa * a[2] + wb * b[2] + wc * c[2]) / area
                i = y * lens.width + x
                if rho > inverse[i]:
                    inverse[i] = rho
                    weights[i] = (wa * weight[0] + wb * weight[1] + wc * weight[2]) / area


@wp.kernel
def _draw_tiles(
    first: int,
    lens: Lens,
    limits: Limits,
    inverse_in: wp.array(dtype=wp.float32),
    weight_in: wp.array(dtype=wp.float32),
    moved_in: wp.array(dtype=wp.vec3),
    box_in: wp.array(dtype=wp.vec4),
    source_across: int,
    target_across: int,
    warped_out: wp.array(dtype=wp.float32),
    weight_out: wp.array(dtype=wp.float32),
):
    """Draw last frame's depth as triangles into one tile of the new view, with a z-test.

    Triangles with an unmeasured corner or with an edge across a depth jump are left out. Both outputs must be 0.
    """
    t = first + wp.tid()
    x0, y0 = (t % target_across) * TARGET_TILE, (t / target_across) * TARGET_TILE
    x1, y1 = wp.min(x0 + TARGET_TILE, lens.width), wp.min(y0 + TARGET_TILE, lens.height)
    fx0, fy0, fx1, fy1 = float(x0), float(y0), float(x1 - 1), float(y1 - 1)
    for s in range(box_in.shape[0]):
        box = box_in[s]
        if box[0] <= fx1 and box[2] >= fx0 and box[1] <= fy1 and box[3] >= fy0:
            sx, sy = (s % source_across) * SOURCE_TILE, (s / source_across) * SOURCE_TILE
            for y in range(sy, wp.min(sy + SOURCE_TILE, lens.height - 1)):
                for x in range(sx, wp.min(sx + SOURCE_TILE, lens.width - 1)):
                    i = y * lens.width + x
                    j = i + lens.width
                    a = moved_in[i]
                    b = moved_in[i + 1]
                    c = moved_in[j]
                    d = moved_in[j + 1]
                    if wp.max(wp.max(a[0], b[0]), wp.max(c[0], d[0])) < fx0:
                        continue
                    if wp.min(wp.min(a[0], b[0]), wp.min(c[0], d[0])) > fx1:
                        continue
                    rb = inverse_in[i + 1]
                    rc = inverse_in[j]
                    if b[2] <= 0.0 or c[2] <= 0.0 or not same_surface(rb, rc, limits):
                        continue
                    wb = weight_in[i + 1]
                    wc = weight_in[j]
                    if a[2] > 0.0:
                        ra = inverse_in[i]
                        if same_surface(ra, rb, limits) and same_surface(ra, rc, limits):
                            w = wp.vec3(weight_in[i], wb, wc)
                            draw_triangle(lens, a, b, c, w, x0, y0, x1, y1, warped_out, weight_out)
                    if d[2] > 0.0:
                        rd = inverse_in[j + 1]
                        if same_surface(rd, rb, limits) and same_surface(rd, rc, limits):
                            w = wp.vec3(wb, weight_in[j + 1], wc)
                            draw_triangle(lens, b, d, c, w, x0, y0, x1, y1, warped_out, weight_out)


@wp.kernel
def _merge(
    first: int,
    limits: Limits,
    measured_in: wp.array(dtype=wp.float32),
    warped_in: wp.array(dtype=wp.float32),
    warped_weight_in: wp.array(dtype=wp.float32),
    most: float,
    inverse_out: wp.array(dtype=wp.float32),
    weight_out: wp.array(dtype=wp.float32),
    kind_out: wp.array(dtype=wp.int32),
):
    """Running mean of at most ``most`` frames; it starts anew where old and new disagree.

    What this frame did not measure stays for as many frames as it had been measured in.
    """
    i = first + wp.tid()
    new, old, weight = measured_in[i], warped_in[i], warped_weight_in[i]
    inverse, total, kind = float(0.0), float(0.0), int(NOTHING)
    if new > 0.0:
        inverse, total, kind = float(new), float(1.0), int(MEASURED)
        if old > 0.0 and wp.abs(new - old) <= limits.agree_fixed + limits.agree_share * wp.max(new, old):
            inverse = (weight * old + new) / (weight + 1.0)
            total = wp.min(weight + 1.0, most)
    elif old > 0.0 and weight > 1.0:
        inverse, total, kind = float(old), weight - 1.0, int(CARRIED)
    inverse_out[i] = inverse
    weight_out[i] = total
    kind_out[i] = kind


@wp.kernel
def _fill(
    first: int,
    lens: Lens,
    limits: Limits,
    inverse_in: wp.array(dtype=wp.float32),
    kind_in: wp.array(dtype=wp.int32),
    inverse_out: wp.array(dtype=wp.float32),
    kind_out: wp.array(dtype=wp.int32),
):
    """Give holes beside measured pixels the mean of the farthest surface around: the shadow of structured light falls
    on what is behind."""
    i = first + wp.tid()
    rho, kind = float(inverse_in[i]), int(kind_in[i])
    if rho <= 0.0:
        x, y = i % lens.width, i / lens.width
        farthest = float(1.0e9)
        for k in range(9):
            nx, ny = x + k % 3 - 1, y + k / 3 - 1
            if nx >= 0 and ny >= 0 and nx < lens.width and ny < lens.height:
                other = inverse_in[ny * lens.width + nx]
                if other > 0.0:
                    farthest = wp.min(farthest, other)
        total, count = float(0.0), float(0.0)
        for k in range(9):
            nx, ny = x + k % 3 - 1, y + k / 3 - 1
            if nx >= 0 and ny >= 0 and nx < lens.width and ny < lens.height:
                other = inverse_in[ny * lens.width + nx]
                if same_surface(other, farthest, limits):
                    total += other
                    count += 1.0
        if count > 0.0:
            rho, kind = total / count, int(FILLED)
    inverse_out[i] = rho
    kind_out[i] = kind


@wp.kernel
def _smooth(
    first: int,
    lens: Lens,
    limit: float,
    step: int,
    inverse_in: wp.array(dtype=wp.float32),
    inverse_out: wp.array(dtype=wp.float32),
):
    """One a-trous level over pairs of pixels that face each other across this one.

    A pair counts where its mean is within ``limit`` [1/m] of this pixel: an affine function, which a plane is, passes
    unchanged at any slope, and a pair across a depth jump never counts. Weights are those of the 3 x 3 binomial.
    """
    i = first + wp.tid()
    rho = float(inverse_in[i])
    if rho > 0.0:
        x, y = i % lens.width, i / lens.width
        total, weight = 4.0 * rho, float(4.0)
        for k in range(4):
            dx = wp.where(k == 1, 0, step)
            dy = wp.where(k == 0, 0, wp.where(k == 3, -step, step))
            ax, ay, bx, by = x + dx, y + dy, x - dx, y - dy
            if ax < lens.width and bx >= 0 and wp.max(ay, by) < lens.height and wp.min(ay, by) >= 0:
                a = inverse_in[ay * lens.width + ax]
                b = inverse_in[by * lens.width + bx]
                if a > 0.0 and b > 0.0 and wp.abs(0.5 * (a + b) - rho) <= limit:
                    w = wp.where(k < 2, 2.0, 1.0)
                    total += w * (a + b)
                    weight += 2.0 * w
        rho = total / weight
    inverse_out[i] = rho


@wp.func
def slope(inverse: wp.array(dtype=wp.float32), here: int, before: int, after: int, limits: Limits) -> wp.vec2:
    """Derivative along one axis from the neighbours on this surface, and whether there is one."""
    rho = inverse[here]
    back = before >= 0 and same_surface(inverse[wp.max(before, 0)], rho, limits)
    forth = after >= 0 and same_surface(inverse[wp.max(after, 0)], rho, limits)
    if back and forth:
        return wp.vec2(0.5 * (inverse[after] - inverse[before]), 1.0)
    if forth:
        return wp.vec2(inverse[after] - rho, 1.0)
    if back:
        return wp.vec2(rho - inverse[before], 1.0)
    return wp.vec2(0.0, 0.0)


@wp.kernel
def _find_normals(
    first: int, lens: Lens, limits: Limits, inverse_in: wp.array(dtype=wp.float32), normal_out: wp.array(dtype=wp.vec3)
):
    """Unit normals towards the camera, in camera axes; 0 where nothing was measured or no neighbour is on the surface.

    A plane n . p = d has the inverse depth (n . ray) / d, so its derivatives give n: the limit of the paper's
    N = (V(u+1,v) - V(u,v)) x (V(u,v+1) - V(u,v)) for small steps.
    """
    i = first + wp.tid()
    normal = wp.vec3(0.0, 0.0, 0.0)
    rho = inverse_in[i]
    if rho > 0.0:
        x, y, w = i % lens.width, i / lens.width, lens.width
        du = slope(inverse_in, i, wp.where(x > 0, i - 1, -1), wp.where(x < w - 1, i + 1, -1), limits)
        dv = slope(inverse_in, i, wp.where(y > 0, i - w, -1), wp.where(y < lens.height - 1, i + w, -1), limits)
        if du[1] > 0.0 and dv[1] > 0.0:
            along = rho - du[0] * (float(x) - lens.cx) - dv[0] * (float(y) - lens.cy)
            normal = -wp.normalize(wp.vec3(du[0] * lens.fx, dv[0] * lens.fy, along))
    normal_out[i] = normal

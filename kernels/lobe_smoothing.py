"""Reflections averaged over neighbouring pixels, as far as their lobes blur what they show."""

import warp as wp

from warp_dvct.kernels.gbuffer import SYNTHETIC, Points
from warp_dvct.kernels.reconstruction import falloff

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

TAPS = wp.constant(2)  # to each side
WIDEST = wp.constant(4)  # pixels between taps at most
TURN = wp.constant(0.25)  # of a lobe's half width: turn of the normal at which a neighbour hardly counts
OFF_PLANE = wp.constant(2.0)  # pixel footprints off the tangent plane at which a neighbour hardly counts
ALIKE = wp.constant(0.05)  # difference of alpha, over it, and of F0 from which lobes are not the same


@wp.struct
class Reflected:
    """What the rays of listed points brought."""

    change: wp.array(dtype=wp.vec3)  # after on synthetic points, after - before on real ones
    before: wp.array(dtype=wp.vec3)
    nearness: wp.array(dtype=wp.float32)  # mean inverse distance of what the rays met


@wp.struct
class Grid:
    """Where pixels' centres are among the listed points."""

    columns: wp.int32
    rows: wp.int32
    rank: wp.array(dtype=wp.int32)  # [points], -1 where a point is not listed


@wp.func
def listed_at(grid: Grid, x: int, y: int) -> int:
    """Rank of a pixel's centre, or -1."""
    if x < 0 or y < 0 or x >= grid.columns or y >= grid.rows:
        return -1
    return grid.rank[y * grid.columns + x]


@wp.func
def like_lobe(points: Points, j: int, other: int) -> float:
    """Weight in [0, 1] by how nearly two points have the same lobe on the same smooth surface."""
    alpha = points.lobe[j][1]
    f0 = wp.abs(points.f0[j] - points.f0[other])
    if points.role[j] != points.role[other] or wp.abs(points.lobe[other][1] - alpha) > ALIKE * alpha:
        return 0.0
    if wp.max(f0[0], wp.max(f0[1], f0[2])) > ALIKE:
        return 0.0
    turn = wp.length_sq(points.normal[other] - points.normal[j]) / (TURN * TURN * alpha * alpha)
    gap = wp.dot(points.position[other] - points.position[j], points.normal_g[j])
    gap = gap / (OFF_PLANE * points.footprint[j])
    return falloff(turn) * falloff(gap * gap)


@wp.kernel
def _smooth_lobes(
    first: int,
    points: Points,
    index_in: wp.array(dtype=wp.int32),
    grid: Grid,
    eye: wp.vec3,
    share: float,
    reflected: Reflected,
    with_before: int,
    light_out: wp.array(dtype=wp.vec3),
    before_out: wp.array(dtype=wp.vec3),
):
    """Add the mean reflection of a point and of pixels around it.

    A lobe of GGX alpha shows what is ``d`` away blurred by about 2 alpha d. A step ``x`` on the surface moves the
    mirror image by x (1 + d / D), D being the distance to the eye: a mean over a ``share`` of that width hardly blurs
    it more.
    """
    i = first + wp.tid()
    j = index_in[i]
    pixel = points.pixel[j]
    alpha = points.lobe[j][1]
    near = reflected.nearness[i]
    count = float(1.0)
    for k in range(9):
        r = listed_at(grid, pixel[0] + k % 3 - 1, pixel[1] + k / 3 - 1)
        if r >= 0 and r != i:
            if points.role[index_in[r]] == points.role[j]:
                near += reflected.nearness[r]
                count += 1.0
    distance = count / wp.max(near, 1.0e-6)
    width = share * 2.0 * alpha * distance / (1.0 + distance / wp.length(points.position[j] - eye))
    change = reflected.change[i]
    before = reflected.before[i]
    total = float(1.0)
    if width > 0.5 * points.footprint[j]:
        spacing = wp.clamp(int(0.5 * width / points.footprint[j]), 1, WIDEST)
        for dy in range(-TAPS, TAPS + 1):
            for dx in range(-TAPS, TAPS + 1):
                r = listed_at(grid, pixel[0] + dx * spacing, pixel[1] + dy * spacing)
                if r >= 0 and r != i:
                    other = index_in[r]
                    weight = falloff(wp.length_sq(points.position[other] - points.position[j]) / (width * width))
                    if weight > 0.0:
                        weight *= like_lobe(points, j, other)
                        total += weight
                        change += reflected.change[r] * weight
                        before += reflected.before[r] * weight
    light_out[j] += change / total
    if with_before != 0 and points.role[j] != SYNTHETIC:
        before_out[j] += before / total

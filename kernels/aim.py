"""Aimed rays: of the rays gathered at a real surface, those spent on the directions that synthetic objects take up.

What an object changes at a point mostly lies in the direction of the object: it hides what is behind it and shows
itself. Rays that know of it find that with fewer samples than rays over the whole hemisphere; both are combined by the
balance heuristic (Veach & Guibas 1995), so that the sum stays right wherever they are aimed.
"""

import warp as wp

from warp_dvct.kernels.materials import Surface
from warp_dvct.kernels.sampling import PI, tangent_of

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

WIDEST = wp.constant(0.5)  # share of the disk from which on aiming says no more than the cosine does
ROUND = wp.constant(3.0)  # radians of azimuth from which on objects are taken to be all around
# Aimed rays for each even one, over the share of the disk that they are aimed at; from 10 to 20 errors fall by 2 to 5 %
# in rooms while the gather takes 14 % longer (docs/accuracy.md).
PER_SHARE = wp.constant(15.0)
FEWEST = wp.constant(0.25)  # of them, where objects are distant
MOST = wp.constant(3.0)
NUMBERS = wp.constant(4)  # of the aimed rays' sequence for each even ray: MOST, as a power of two
NARROWEST = wp.constant(1.0e-4)  # of the disk's radius, in each direction: keeps rounding from emptying a sector


@wp.struct
class Targets:
    """Boxes that together hold the synthetic triangles: their middles and half their edges."""

    count: wp.int32  # 0, 1 or 2
    center: wp.vec3
    extent: wp.vec3
    other_center: wp.vec3
    other_extent: wp.vec3


@wp.struct
class Sector:
    """Part of the unit disk under the hemisphere, on which cosine-distributed directions are uniform."""

    middle: wp.vec2  # unit vector towards the middle
    half: wp.float32  # half the angle at the disk's centre
    sine: wp.float32  # of that
    inner: wp.float32  # squares of the radii between which it lies
    outer: wp.float32
    share: wp.float32  # of the disk's area; 0 for no sector


@wp.struct
class Aim:
    """Sectors that the targets take up, and how many rays go into them."""

    rays: wp.int32  # 0: none, and nothing else counts
    first: wp.int32  # of these go into the first sector, the others into the other
    sector: Sector
    other: Sector
    density: wp.float32  # of rays in the first sector: how many to the disk's area
    other_density: wp.float32


@wp.func
def sector_of_box(center: wp.vec3, extent: wp.vec3, s: Surface) -> Sector:
    """Where a box is over a surface's horizon."""
    sector = Sector()
    toward = center - s.position
    t = tangent_of(s.normal)
    b = wp.cross(s.normal, t)
    sector.middle = wp.normalize(wp.vec2(wp.dot(toward, t), wp.dot(toward, b)))
    high = float(0.0)
    low = float(1.0e18)
    near = float(1.0e18)
    far = float(0.0)
    left = float(0.0)
    right = float(0.0)
    for corner in range(8):
        way = toward + wp.vec3(
            wp.where((corner & 1) == 0, -extent[0], extent[0]),
            wp.where((corner & 2) == 0, -extent[1], extent[1]),
            wp.where((corner & 4) == 0, -extent[2], extent[2]),
        )
        x = wp.dot(way, t)
        y = wp.dot(way, b)
        height = wp.dot(way, s.normal)
        high = wp.max(high, height)
        low = wp.min(low, height)
        near = wp.min(near, x * x + y * y)
        far = wp.max(far, x * x + y * y)
        turn = wp.atan2(sector.middle[0] * y - sector.middle[1] * x, sector.middle[0] * x + sector.middle[1] * y)
        left = wp.min(left, turn)
        right = wp.max(right, turn)
    if high <= 0.0 or far <= 0.0:
        return sector
    low = wp.max(low, 0.0)
    sector.outer = far / (far + low * low)
    sector.half = PI
    if right - left < ROUND:
        sector.half = wp.max(0.5 * (right - left), NARROWEST)
        turn = 0.5 * (left + right)
        x = sector.middle[0] * wp.cos(turn) - sector.middle[1] * wp.sin(turn)
        sector.middle = wp.vec2(x, sector.middle[0] * wp.sin(turn) + sector.middle[1] * wp.cos(turn))
        # Between two corners the box comes nearer than either, at most to the middle of the chord.
        near = near * wp.cos(sector.half) * wp.cos(sector.half)
        sector.inner = wp.min(near / (near + high * high), sector.outer - NARROWEST)
    sector.sine = wp.sin(sector.half)
    sector.share = (sector.outer - sector.inner) * sector.half / PI
    return sector


@wp.func
def aim_at(targets: Targets, s: Surface, even: int) -> Aim:
    """Rays to go with ``even`` ones, spread over the targets' sectors; none where these are too wide to be worth it.

    The more of the view the sectors take up, the more rays: the error that these leave is in proportion to it, and is
    least over all points if their number is as well (Neyman's allocation).
    """
    aim = Aim()
    if even <= 0 or targets.count == 0:
        return aim
    aim.sector = sector_of_box(targets.center, targets.extent, s)
    if targets.count > 1:
        aim.other = sector_of_box(targets.other_center, targets.other_extent, s)
    share = aim.sector.share + aim.other.share
    if share > 0.0 and share < WIDEST:
        aim.rays = wp.max(int(float(even) * wp.clamp(PER_SHARE * share, FEWEST, MOST) + 0.5), 1)
        aim.first = int(float(aim.rays) * aim.sector.share / share + 0.5)
        if aim.first > 0:
            aim.density = float(aim.first) / aim.sector.share
        if aim.first < aim.rays:
            aim.other_density = float(aim.rays - aim.first) / aim.other.share
    return aim


@wp.func
def in_sector(sector: Sector, disk: wp.vec2) -> bool:
    """Whether a point of the disk lies in the sector."""
    square = wp.length_sq(disk)
    if square < sector.inner or square > sector.outer:
        return False
    if sector.half >= PI:
        return True
    across = sector.middle[0] * disk[1] - sector.middle[1] * disk[0]
    return wp.dot(disk, sector.middle) > 0.0 and wp.abs(across) <= wp.sqrt(square) * sector.sine


@wp.func
def ray_weight(aim: Aim, even: int, disk: wp.vec2, drawn: int) -> float:
    """Of a ray in the mean of ``even`` rays spread over the disk and the aimed ones: the balance heuristic.

    ``drawn``: From the first sector (0), from the other (1) or from the disk (-1); rounding may put it beside its own.
    """
    density = float(even)
    if aim.density > 0.0 and (drawn == 0 or in_sector(aim.sector, disk)):
        density += aim.density
    if aim.other_density > 0.0 and (drawn == 1 or in_sector(aim.other, disk)):
        density += aim.other_density
    return 1.0 / density


@wp.func
def sector_point(sector: Sector, xi: wp.vec2) -> wp.vec2:
    """A uniformly distributed point of the sector."""
    radius = wp.sqrt(sector.inner + (sector.outer - sector.inner) * xi[0])
    turn = sector.half * (2.0 * xi[1] - 1.0)
    along = radius * wp.cos(turn)
    across = radius * wp.sin(turn)
    return wp.vec2(
        sector.middle[0] * along - sector.middle[1] * across, sector.middle[1] * along + sector.middle[0] * across
    )

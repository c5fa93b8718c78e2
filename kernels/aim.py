"""Aimed rays: of the rays gathered at a real surface, those spent on the directions that synthetic objects take up.

What an object changes at a point mostly lies in the direction of the object: it hides what is behind it and shows
itself. Rays that know of it find that with fewer samples than rays over the whole hemisphere; both are combined by the
balance heuristic (Veach & Guibas 1995), so that the sum stays right wherever they are aimed.
"""

import warp as wp

from warp_dvct.kernels.geometry import Geometry
from warp_dvct.kernels.materials import Surface
from warp_dvct.kernels.sampling import PI, tangent_of

wp.set_module_options({"enable_backward": False})

WIDEST = wp.constant(0.5)  # share of the disk from which on aiming says no more than the cosine does
ROUND = wp.constant(3.0)  # radians of azimuth from which on objects are taken to be all around
NARROWEST = wp.constant(1.0e-4)  # of the disk's radius, in each direction: keeps rounding from emptying a sector


@wp.struct
class Sector:
    """Part of the unit disk under the hemisphere, on which cosine-distributed directions are uniform, and which of a
    point's rays go into it."""

    rays: wp.int32  # 0: none, and nothing else counts
    middle: wp.vec2  # unit vector towards the middle
    half: wp.float32  # half the angle at the disk's centre
    sine: wp.float32  # of that
    inner: wp.float32  # squares of the radii between which it lies
    outer: wp.float32
    share: wp.float32  # of the disk's area
    weight: wp.float32  # of a ray within in the mean of all, where as many as go here are spread over the disk


@wp.func
def sector_of_objects(geo: Geometry, s: Surface, rays: int) -> Sector:
    """Where the box around the synthetic objects is over a surface's horizon; without rays where that is nowhere, or
    too wide to be worth aiming at."""
    sector = Sector()
    if rays <= 0 or geo.has_synthetic == 0:
        return sector
    toward = geo.center - s.position
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
            wp.where((corner & 1) == 0, -geo.extent[0], geo.extent[0]),
            wp.where((corner & 2) == 0, -geo.extent[1], geo.extent[1]),
            wp.where((corner & 4) == 0, -geo.extent[2], geo.extent[2]),
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
    sector.share = (sector.outer - sector.inner) * sector.half / PI
    if sector.share < WIDEST:
        sector.rays = rays
        sector.sine = wp.sin(sector.half)
        sector.weight = 1.0 / (float(rays) * (1.0 + 1.0 / sector.share))
    return sector


@wp.func
def in_sector(sector: Sector, disk: wp.vec2) -> bool:
    """Whether a point of the disk lies in the sector."""
    square = wp.length_sq(disk)
    if sector.rays == 0 or square < sector.inner or square > sector.outer:
        return False
    if sector.half >= PI:
        return True
    across = sector.middle[0] * disk[1] - sector.middle[1] * disk[0]
    return wp.dot(disk, sector.middle) > 0.0 and wp.abs(across) <= wp.sqrt(square) * sector.sine


@wp.func
def ray_weight(sector: Sector, even: int, disk: wp.vec2) -> float:
    """Of one of ``even`` rays spread over the disk, beside as many in the sector: the balance heuristic."""
    if in_sector(sector, disk):
        return sector.weight
    return 1.0 / float(even)


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

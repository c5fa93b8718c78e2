"""Irradiance of the second and further bounces, on the patches of a coarse level: smooth and without noise."""

import warp as wp

from warp_dvct.kernels.volume import Volume, between_voxels, corner_step, corner_weight, face_of, find_record

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NEAREST_SHARE = wp.constant(1.0e-4)  # weight of a patch at the far corner: it speaks where no other does
HIDDEN_SHARE = wp.constant(1.0e-4)  # of the weight of a patch beyond a wall, likewise
SHOWN = wp.constant(0.1)  # cosine of the face from which on a surface asks the patches behind it
NEIGHBOURS = wp.constant(27)  # voxels around a voxel, itself included
OFF_PLANE = wp.constant(0.1)  # of the distance along a patch's plane counts as much as the distance off it
WALL_MARGIN = wp.constant(0.002)  # of a voxel: how far a point is moved off the wall that it lies on; a wall is thicker


@wp.struct
class Patch:
    """The largest piece of a sheet of surface behind a voxel's face. Those behind one face follow each other."""

    position: wp.vec3
    normal: wp.vec3
    albedo: wp.vec3
    eye: wp.vec3  # above the patch, under what covers it
    wall: wp.vec4  # thin wall beside it: normal and offset; or 0
    reach: wp.float32
    area: wp.float32  # of all that shows on the face, over that of the face
    real: wp.int32  # whether it exists before
    buried: wp.int32  # whether something covers it closely
    next: wp.int32  # patch behind the same face, or -1
    place: wp.int64  # key of the voxel * 6 + face: ascends, and is the same whatever else is there


@wp.struct
class BounceField:
    present: wp.int32  # 0: there is only one bounce
    volume: Volume
    level: wp.int32
    level_first: wp.int32
    has_walls: wp.int32
    patches: wp.array(dtype=Patch)
    table: wp.array(dtype=wp.int32)  # first patch behind each face of a record of the level, or -1
    mixed: wp.array(dtype=wp.int32)  # whether a record of the level, or one next to it, has its sheets told apart
    beside: wp.array(dtype=wp.int32)  # of patches in mixed records: the patch in each voxel around that they see, or -1
    walls: wp.array(dtype=wp.vec4)  # plane of the thin wall in a record of the level: normal and offset; or 0
    irradiance: wp.array(dtype=wp.vec3)  # [patches * 2], before and after


@wp.struct
class Bounced:
    """Irradiance [W m^-2] of the two solutions."""

    before: wp.vec3
    after: wp.vec3


@wp.struct
class BouncedSum:
    """Weighted sums of patches' irradiance; ``open`` is the weight of those that no wall parts from the point."""

    before: wp.vec3
    after: wp.vec3
    weight_before: wp.float32
    weight_after: wp.float32
    open: wp.float32


@wp.func
def wall_side(wall: wp.vec4, position: wp.vec3) -> float:
    """Distance of a point before (positive) or behind a wall; 0 where there is none."""
    return wall[0] * position[0] + wall[1] * position[1] + wall[2] * position[2] - wall[3]


@wp.func
def is_parted(wall: wp.vec4, one: wp.vec3, other: wp.vec3) -> bool:
    """Whether a wall is between two points."""
    return wall_side(wall, one) * wall_side(wall, other) < 0.0


@wp.func
def record_of(field: BounceField, position: wp.vec3) -> int:
    """The record of the field's level that holds a point, or -1."""
    local = (position - field.volume.low) / (field.volume.voxel * float(1 << field.level))
    return find_record(
        field.volume, field.level, int(wp.floor(local[0])), int(wp.floor(local[1])), int(wp.floor(local[2]))
    )


@wp.func
def off_surface(field: BounceField, position: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """A point just off its surface: off the wall that this may be, and, where the surface lies between two voxels, in
    the one that holds what stands on it."""
    return position + normal * (WALL_MARGIN * field.volume.voxel * float(1 << field.level))


@wp.func
def wall_beside(field: BounceField, point: wp.vec3) -> wp.vec4:
    """The thin wall in the voxel of a point; 0 where there is none."""
    record = record_of(field, point)
    if record < 0:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    return field.walls[record - field.level_first]


@wp.func
def neighbour_step(k: int) -> wp.vec3i:
    """Where the k-th of the ``NEIGHBOURS`` is, from -1 to 1 along each axis."""
    return wp.vec3i(k % 3 - 1, (k / 3) % 3 - 1, k / 9 - 1)


@wp.func
def own_patch(field: BounceField, head: int, position: wp.vec3, synthetic: int) -> int:
    """Of the patches behind one face, the first of which is ``head``: the one on whose sheet a surface point seems to
    lie, by its role and by the plane that is nearest."""
    best = int(head)
    least = float(0.0)
    patch = int(head)
    while patch >= 0:
        other = field.patches[patch]
        d = position - other.position
        gap = wp.abs(wp.dot(d, other.normal)) + OFF_PLANE * wp.length(d)
        if other.real == synthetic:
            gap += field.volume.voxel * float(2 << field.level)
        if patch == head or gap < least:
            least = gap
            best = patch
        patch = other.next
    return best


@wp.struct
class Home:
    """The voxel of a surface point near objects or thin walls: light comes from patches that its own ones there see."""

    mixed: wp.int32
    cell: wp.vec3i
    own: wp.vec3i  # patch behind the face of each axis that the point's normal shows on, or -1
    several: wp.int32  # whether one of these was chosen among several


@wp.func
def home_of(field: BounceField, position: wp.vec3, normal: wp.vec3, synthetic: int) -> Home:
    home = Home()
    local = (off_surface(field, position, normal) - field.volume.low) / (field.volume.voxel * float(1 << field.level))
    home.cell = wp.vec3i(int(wp.floor(local[0])), int(wp.floor(local[1])), int(wp.floor(local[2])))
    record = find_record(field.volume, field.level, home.cell[0], home.cell[1], home.cell[2])
    if record >= 0:
        home.mixed = field.mixed[record - field.level_first]
        if home.mixed != 0:
            for axis in range(3):
                head = field.table[(record - field.level_first) * 6 + face_of(axis, normal[axis])]
                home.own[axis] = head
                if head >= 0 and wp.abs(normal[axis]) > SHOWN:
                    if field.patches[head].next >= 0:
                        home.several = 1
                        home.own[axis] = own_patch(field, head, position, synthetic)
    return home


@wp.func
def seen_from(field: BounceField, home: Home, axis: int, x: int, y: int, z: int) -> int:
    """The patch in a voxel that the point's own patch of an axis sees, or -1."""
    step = wp.vec3i(x - home.cell[0], y - home.cell[1], z - home.cell[2])
    own = home.own[axis]
    for k in range(3):
        if step[k] < -1 or step[k] > 1:
            own = -1
    if own < 0:
        return -1
    return field.beside[NEIGHBOURS * own + (step[2] + 1) * 9 + (step[1] + 1) * 3 + step[0] + 1]


@wp.func(inline=False)
def interpolated(
    field: BounceField, position: wp.vec3, normal: wp.vec3, at: wp.vec3, wall: wp.vec4, home: Home
) -> BouncedSum:
    """Patches of the faces that a normal shows on, trilinear around ``at``; those that a wall parts from ``position``,
    or that its own patch does not see, only speak where no others do."""
    result = BouncedSum()
    result.before = wp.vec3(0.0, 0.0, 0.0)
    result.after = wp.vec3(0.0, 0.0, 0.0)
    middle = between_voxels(field.volume, field.level, at)
    corners = int(8)  # not a constant: unrolled, callers spill twice as much on GPUs
    for corner in range(corners):
        step = corner_step(corner)
        voxel = middle.voxel + step
        record = find_record(field.volume, field.level, voxel[0], voxel[1], voxel[2])
        if record >= 0:
            near = corner_weight(middle, step)
            for axis in range(3):
                share = wp.abs(normal[axis])
                if share > SHOWN:
                    patch = int(-1)
                    if home.mixed != 0:
                        patch = seen_from(field, home, axis, voxel[0], voxel[1], voxel[2])
                    parted = home.mixed != 0 and patch < 0
                    if patch < 0:
                        patch = field.table[(record - field.level_first) * 6 + face_of(axis, normal[axis])]
                    if patch >= 0:
                        weight = (near + NEAREST_SHARE) * share
                        if field.has_walls != 0 and not parted:
                            place = field.patches[patch].position
                            parted = is_parted(wall, position, place) or is_parted(
                                field.patches[patch].wall, position, place
                            )
                        if parted:
                            weight *= HIDDEN_SHARE
                        else:
                            result.open += weight
                        result.after += field.irradiance[2 * patch + 1] * weight
                        result.weight_after += weight
                        # What an object's face would get without objects is right for the real surface close behind.
                        weight *= wp.where(field.patches[patch].real != 0, 1.0, NEAREST_SHARE)
                        result.before += field.irradiance[2 * patch] * weight
                        result.weight_before += weight
    return result


@wp.func
def bounced_at_home(field: BounceField, position: wp.vec3, normal: wp.vec3, home: Home) -> Bounced:
    """As ``bounced_irradiance``, for a point whose voxel is known."""
    result = Bounced()
    wall = wp.vec4(0.0, 0.0, 0.0, 0.0)
    point = position
    if field.has_walls != 0:
        point = off_surface(field, position, normal)
        wall = wall_beside(field, point)
    total = interpolated(field, point, normal, position, wall, home)
    if total.open == 0.0 and wp.length_sq(wall) > 0.0:
        size = field.volume.voxel * float(1 << field.level)
        away = wp.vec3(wall[0], wall[1], wall[2]) * wp.sign(wall_side(wall, point)) * size
        farther = interpolated(field, point, normal, position + away, wall, home)
        if farther.open > 0.0:
            total = farther
    result.before = total.before / wp.max(total.weight_before, 1.0e-12)
    result.after = total.after / wp.max(total.weight_after, 1.0e-12)
    return result


@wp.func
def bounced_irradiance(field: BounceField, position: wp.vec3, normal: wp.vec3, synthetic: int) -> Bounced:
    """Irradiance at a surface point, from the patches around on its own side of walls, thin ones and objects'.

    Where a wall cuts the voxel of the point, the patches there may all lie beyond it: then those a voxel farther from
    the wall are asked.

    Args:
        synthetic: Role of the surface: 1 for synthetic, 0 for real.
    """
    result = Bounced()
    if field.present != 0:
        home = home_of(field, position, normal, synthetic)
        result = bounced_at_home(field, position, normal, home)
    return result

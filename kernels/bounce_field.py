"""Irradiance of the second and further bounces, on the patches of a coarse level: smooth and without noise."""

import warp as wp

from warp_dvct.kernels.volume import Volume, face_of, find_record

wp.set_module_options({"enable_backward": False})

NEAREST_SHARE = wp.constant(1.0e-4)  # weight of a patch at the far corner: it speaks where no other does
HIDDEN_SHARE = wp.constant(1.0e-4)  # of the weight of a patch beyond a wall, likewise
WALL_MARGIN = wp.constant(0.002)  # of a voxel: how far a point is moved off the wall that it lies on; a wall is thicker


@wp.struct
class BounceField:
    present: wp.int32  # 0: there is only one bounce
    volume: Volume
    level: wp.int32
    level_first: wp.int32
    table: wp.array(dtype=wp.int32)  # patch behind each face of a record of the level, or -1
    real: wp.array(dtype=wp.int32)  # whether a patch exists before
    position: wp.array(dtype=wp.vec3)  # of the patches
    has_walls: wp.int32
    walls: wp.array(dtype=wp.vec4)  # plane of the thin wall in a record of the level: normal and offset; or 0
    patch_walls: wp.array(dtype=wp.vec4)  # of the thin wall beside each patch
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


@wp.func(inline=False)
def interpolated(field: BounceField, position: wp.vec3, normal: wp.vec3, at: wp.vec3, wall: wp.vec4) -> BouncedSum:
    """Patches of the faces that a normal shows on, trilinear around ``at``; those that a wall parts from ``position``
    only speak where no others do."""
    result = BouncedSum()
    result.before = wp.vec3(0.0, 0.0, 0.0)
    result.after = wp.vec3(0.0, 0.0, 0.0)
    local = (at - field.volume.low) / (field.volume.voxel * float(1 << field.level)) - wp.vec3(0.5, 0.5, 0.5)
    x0 = int(wp.floor(local[0]))
    y0 = int(wp.floor(local[1]))
    z0 = int(wp.floor(local[2]))
    fx = local[0] - float(x0)
    fy = local[1] - float(y0)
    fz = local[2] - float(z0)
    for corner in range(8):
        dx = corner & 1
        dy = (corner >> 1) & 1
        dz = corner >> 2
        record = find_record(field.volume, field.level, x0 + dx, y0 + dy, z0 + dz)
        if record >= 0:
            near = wp.where(dx == 1, fx, 1.0 - fx) * wp.where(dy == 1, fy, 1.0 - fy) * wp.where(dz == 1, fz, 1.0 - fz)
            for axis in range(3):
                share = wp.abs(normal[axis])
                if share > 0.1:
                    patch = field.table[(record - field.level_first) * 6 + face_of(axis, normal[axis])]
                    if patch >= 0:
                        weight = (near + NEAREST_SHARE) * share
                        parted = False
                        if field.has_walls != 0:
                            place = field.position[patch]
                            parted = is_parted(wall, position, place) or is_parted(
                                field.patch_walls[patch], position, place
                            )
                        if parted:
                            weight *= HIDDEN_SHARE
                        else:
                            result.open += weight
                        result.after += field.irradiance[2 * patch + 1] * weight
                        result.weight_after += weight
                        # What an object's face would get without objects is right for the real surface close behind.
                        weight *= wp.where(field.real[patch] != 0, 1.0, NEAREST_SHARE)
                        result.before += field.irradiance[2 * patch] * weight
                        result.weight_before += weight
    return result


@wp.func
def bounced_irradiance(field: BounceField, position: wp.vec3, normal: wp.vec3) -> Bounced:
    """Irradiance at a surface point, from the patches around on its own side of thin walls.

    Where a wall cuts the voxel of the point, the patches there may all lie beyond it: then those a voxel farther from
    the wall are asked.
    """
    result = Bounced()
    result.before = wp.vec3(0.0, 0.0, 0.0)
    result.after = wp.vec3(0.0, 0.0, 0.0)
    if field.present == 0:
        return result
    wall = wp.vec4(0.0, 0.0, 0.0, 0.0)
    point = position
    if field.has_walls != 0:
        point = off_surface(field, position, normal)
        wall = wall_beside(field, point)
    total = interpolated(field, point, normal, position, wall)
    if total.open == 0.0 and wp.length_sq(wall) > 0.0:
        size = field.volume.voxel * float(1 << field.level)
        away = wp.vec3(wall[0], wall[1], wall[2]) * wp.sign(wall_side(wall, point)) * size
        farther = interpolated(field, point, normal, position + away, wall)
        if farther.open > 0.0:
            total = farther
    result.before = total.before / wp.max(total.weight_before, 1.0e-12)
    result.after = total.after / wp.max(total.weight_after, 1.0e-12)
    return result

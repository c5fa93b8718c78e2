"""Cone marching through the pyramids: both occupancies and both fields in one march."""

import warp as wp

from warp_dvct.kernels.volume import (
    Volume,
    between_voxels,
    corner_step,
    corner_weight,
    face_of,
    field_slot,
    find_record,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

OPAQUE = wp.constant(0.999)  # a march ends when this share of the cone is covered in both solutions


DUAL = wp.constant(0)
SPLIT = wp.constant(1)


@wp.struct
class ConeSettings:
    aperture: float  # full opening angle [rad]
    step: float  # in voxels of the current level
    detail: float  # voxel edge over the cone's diameter
    start: float  # how far the march starts above its surface, in level-0 voxels
    reach: float  # farthest distance, in volume space
    additive: int  # 1: coverage adds up (surfaces); 0: eq. 4's product of transparencies
    escape: int  # 1: an exact ray decides whether what the march left uncovered is open
    split: int  # DUAL, or the paper's single occupancy with the field's difference in ``before``


@wp.struct
class ConeResult:
    """(radiosity * coverage, coverage) of the two solutions."""

    before: wp.vec4
    after: wp.vec4


@wp.func
def sample_volume(volume: Volume, level: int, position: wp.vec3, direction: wp.vec3, plane: wp.vec4) -> ConeResult:
    """Trilinear sample of the faces that a ray along ``direction`` sees, weighted by its direction cosines.

    ``plane`` (normal and offset) is the cone's own surface, or 0. In voxels that it cuts, and below it, faces that look
    down at it are the surface's own lining, which interpolation would spread over to the cone's side.
    """
    size = volume.voxel * float(1 << level)
    at = between_voxels(volume, level, position)
    face_x = face_of(0, -direction[0])
    face_y = face_of(1, -direction[1])
    face_z = face_of(2, -direction[2])
    wx = wp.abs(direction[0])
    wy = wp.abs(direction[1])
    wz = wp.abs(direction[2])
    result = ConeResult()
    result.before = wp.vec4(0.0, 0.0, 0.0, 0.0)
    result.after = wp.vec4(0.0, 0.0, 0.0, 0.0)
    # Heights above the plane, in voxels, of the corners' centres; half of the spread is what a voxel reaches down.
    spread = wp.abs(plane[0]) + wp.abs(plane[1]) + wp.abs(plane[2])
    height = (plane[0] * position[0] + plane[1] * position[1] + plane[2] * position[2] - plane[3]) / size
    near = height < 1.5 * spread
    for corner in range(8):
        step = corner_step(corner)
        voxel = at.voxel + step
        record = find_record(volume, level, voxel[0], voxel[1], voxel[2])
        if record >= 0:
            weight = corner_weight(at, step)
            share = wp.vec3(wx, wy, wz)
            if near:
                above = height
                for axis in range(3):
                    above += plane[axis] * (float(step[axis]) - at.way[axis])
                if above < 0.5 * spread:
                    for axis in range(3):
                        if direction[axis] * plane[axis] > 0.0:
                            share[axis] = 0.0
            slot_x = field_slot(volume, record, face_x)
            slot_y = field_slot(volume, record, face_y)
            slot_z = field_slot(volume, record, face_z)
            result.before += weight * (
                share[0] * volume.field[slot_x] + share[1] * volume.field[slot_y] + share[2] * volume.field[slot_z]
            )
            result.after += weight * (
                share[0] * volume.field[slot_x + 1]
                + share[1] * volume.field[slot_y + 1]
                + share[2] * volume.field[slot_z + 1]
            )
    return result


@wp.func
def accumulate(total: wp.vec4, value: wp.vec4, step: float, additive: int) -> wp.vec4:
    """Front-to-back compositing of one step.

    ``value`` is an area density per voxel length, so ``value * step`` is the expected number of surfaces crossed.
    Additively the first crossing is opaque; otherwise eqs. 3 and 4, with the step's length in the exponent.
    """
    free = 1.0 - total[3]
    alpha = value[3]
    if free <= 0.0 or alpha <= 0.0:
        return total
    if additive != 0:
        return total + value * wp.min(step, free / alpha)
    covered = 1.0 - wp.pow(1.0 - wp.min(alpha, 1.0), step)
    return total + value * (free * covered / alpha)


@wp.func
def inside_box(volume: Volume, position: wp.vec3, margin: float) -> bool:
    edge = volume.voxel * float(volume.n) + margin
    local = position - volume.low
    return (
        wp.min(local[0], wp.min(local[1], local[2])) >= -margin and wp.max(local[0], wp.max(local[1], local[2])) <= edge
    )


@wp.func
def level_of(volume: Volume, width: float) -> int:
    """The level whose voxels are no wider than a cone."""
    return wp.clamp(int(wp.floor(wp.log2(wp.max(width / volume.voxel, 1.0)))), 0, volume.levels - 1)


@wp.func
def level_voxel(volume: Volume, level: int) -> float:
    return volume.voxel * float(1 << level)


@wp.func
def march_cone(
    fine: Volume,
    coarse: Volume,
    has_coarse: int,
    origin: wp.vec3,
    direction: wp.vec3,
    plane: wp.vec4,
    cone: ConeSettings,
) -> ConeResult:
    """Franke 2014, section 3.3, eqs. 3 and 4, for both solutions at once: ``before`` sees real surfaces alone.

    The march goes through the fine volume and, beyond its border, through the coarse one. With ``cone.split`` the
    result's ``before`` is the delta field under the single occupancy of all surfaces. ``plane`` is as in
    ``sample_volume``.
    """
    total = ConeResult()
    total.before = wp.vec4(0.0, 0.0, 0.0, 0.0)
    total.after = wp.vec4(0.0, 0.0, 0.0, 0.0)
    spread = 2.0 * wp.tan(0.5 * cone.aperture)
    # A face just ahead is spread by the interpolation over a voxel behind it as well.
    t = float(-wp.min(cone.start, 1.0) * fine.voxel)
    searching = bool(True)
    while searching and t < cone.reach:
        width = wp.max(spread * cone.detail * t, fine.voxel)
        position = origin + direction * t
        level = level_of(fine, width)
        step = cone.step * level_voxel(fine, level)
        middle = position + direction * (0.5 * step)
        value = ConeResult()
        if inside_box(fine, middle, wp.where(has_coarse != 0, 0.0, level_voxel(fine, level))):
            value = sample_volume(fine, level, middle, direction, plane)
        elif has_coarse != 0:
            level = level_of(coarse, width)
            step = cone.step * level_voxel(coarse, level)
            middle = position + direction * (0.5 * step)
            value = sample_volume(coarse, level, middle, direction, plane)
            # A wall on the border fades over one voxel to each side of it.
            searching = inside_box(coarse, middle, level_voxel(coarse, level))
        else:
            searching = False
        if cone.split != DUAL:
            delta = value.after - value.before
            value.before = wp.vec4(delta[0], delta[1], delta[2], value.after[3])
        total.before = accumulate(total.before, value.before, cone.step, cone.additive)
        total.after = accumulate(total.after, value.after, cone.step, cone.additive)
        t += step
        searching = searching and (total.before[3] < OPAQUE or total.after[3] < OPAQUE)
    return total

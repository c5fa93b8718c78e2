"""Irradiance of the second and further bounces, on the patches of a coarse level: smooth and without noise."""

import warp as wp

from warp_dvct.kernels.volume import Volume, face_of, find_record

wp.set_module_options({"enable_backward": False})

NEAREST_SHARE = wp.constant(1.0e-4)  # weight of a patch at the far corner: it speaks where no other does


@wp.struct
class BounceField:
    present: wp.int32  # 0: there is only one bounce
    volume: Volume
    level: wp.int32
    level_first: wp.int32
    table: wp.array(dtype=wp.int32)  # patch behind each face of a record of the level, or -1
    real: wp.array(dtype=wp.int32)  # whether a patch exists before
    irradiance: wp.array(dtype=wp.vec3)  # [patches * 2], before and after


@wp.struct
class Bounced:
    """Irradiance [W m^-2] of the two solutions."""

    before: wp.vec3
    after: wp.vec3


@wp.func
def bounced_irradiance(field: BounceField, position: wp.vec3, normal: wp.vec3) -> Bounced:
    """Irradiance at a surface point: patches of the faces that its normal shows on, trilinear over their level."""
    result = Bounced()
    result.before = wp.vec3(0.0, 0.0, 0.0)
    result.after = wp.vec3(0.0, 0.0, 0.0)
    if field.present == 0:
        return result
    weight_before = float(0.0)
    weight_after = float(0.0)
    local = (position - field.volume.low) / (field.volume.voxel * float(1 << field.level)) - wp.vec3(0.5, 0.5, 0.5)
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
                        result.after += field.irradiance[2 * patch + 1] * weight
                        weight_after += weight
                        # What an object's face would get without objects is right for the real surface close behind.
                        weight *= wp.where(field.real[patch] != 0, 1.0, NEAREST_SHARE)
                        result.before += field.irradiance[2 * patch] * weight
                        weight_before += weight
    result.before = result.before / wp.max(weight_before, 1.0e-12)
    result.after = result.after / wp.max(weight_after, 1.0e-12)
    return result

"""Radiosity of a surface point, read from the lit volumes: what gathered rays, reflections and patches meet."""

import warp as wp

from warp_dvct.kernels.environment import Environment
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

FAINT = wp.constant(1.0e-6)  # coverage below which a voxel says nothing of a surface
# Share of a face that a voxel must hold to stand alone: whole texels of a map land in slivers or miss them, so that a
# sliver's flux stands for its surface only with its neighbours'.
SLIVER = wp.constant(0.25)
COARSE_FOOTPRINT = wp.constant(2.0)  # coarse voxels that a ray must cover before one of them may stand for it


@wp.struct
class World:
    """What gathered rays and cones read."""

    fine: Volume
    coarse: Volume
    has_coarse: wp.int32
    env: Environment
    normals: wp.array(dtype=wp.vec3)  # unit geometric normals of all triangles


@wp.struct
class Incident:
    """Radiosity (pi times radiance) of the two solutions, and how far away they were met."""

    before: wp.vec3
    after: wp.vec3
    distance_before: wp.float32
    distance_after: wp.float32


@wp.struct
class FieldPair:
    before: wp.vec4
    after: wp.vec4


@wp.func
def field_pair(volume: Volume, position: wp.vec3, normal: wp.vec3) -> FieldPair:
    """Both solutions of the level-0 faces around a surface point, trilinear, weighted by the surface's normal."""
    at = between_voxels(volume, 0, position)
    total = FieldPair()
    total.before = wp.vec4(0.0, 0.0, 0.0, 0.0)
    total.after = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for corner in range(8):
        step = corner_step(corner)
        voxel = at.voxel + step
        record = find_record(volume, 0, voxel[0], voxel[1], voxel[2])
        if record >= 0:
            weight = corner_weight(at, step)
            for axis in range(3):
                share = wp.abs(normal[axis])
                if share > 0.01:
                    slot = field_slot(volume, record, face_of(axis, normal[axis]))
                    total.before += (weight * share) * volume.field[slot]
                    total.after += (weight * share) * volume.field[slot + 1]
    return total


@wp.func
def ratio(value: wp.vec4) -> wp.vec3:
    if value[3] <= FAINT:
        return wp.vec3(0.0, 0.0, 0.0)
    return wp.vec3(value[0], value[1], value[2]) / value[3]


@wp.func
def voxel_pair(volume: Volume, position: wp.vec3, normal: wp.vec3) -> FieldPair:
    """As ``field_pair``, from the one level-0 voxel that holds the point."""
    local = (position - volume.low) / volume.voxel
    total = FieldPair()
    total.before = wp.vec4(0.0, 0.0, 0.0, 0.0)
    total.after = wp.vec4(0.0, 0.0, 0.0, 0.0)
    record = find_record(volume, 0, int(wp.floor(local[0])), int(wp.floor(local[1])), int(wp.floor(local[2])))
    if record >= 0:
        for axis in range(3):
            share = wp.abs(normal[axis])
            if share > 0.1:
                slot = field_slot(volume, record, face_of(axis, normal[axis]))
                total.before += share * volume.field[slot]
                total.after += share * volume.field[slot + 1]
    return total


@wp.func
def radiosity_at(world: World, position: wp.vec3, normal: wp.vec3, footprint: float) -> Incident:
    """Radiosity of a surface point, averaged over about ``footprint``.

    Wide rays read one voxel, of the coarse volume where that is fine enough; narrow ones, and those that meet a sliver,
    interpolate the fine volume. Where a volume holds no such surface the next one is asked.
    """
    pair = FieldPair()
    if world.has_coarse != 0 and footprint > COARSE_FOOTPRINT * world.coarse.voxel:
        pair = voxel_pair(world.coarse, position, normal)
    elif footprint > world.fine.voxel:
        pair = voxel_pair(world.fine, position, normal)
    if pair.after[3] <= SLIVER:
        pair = field_pair(world.fine, position, normal)
    if world.has_coarse != 0 and pair.after[3] <= FAINT:
        pair = field_pair(world.coarse, position, normal)
    result = Incident()
    result.before = ratio(pair.before)
    result.after = ratio(pair.after)
    return result

"""From areas and reflected flux to the lit field of level 0, and its direction-aware filtered pyramid."""

import warp as wp

from warp_dvct.kernels.volume import (
    Volume,
    brick_extent,
    field_slot,
    find_record,
    key_cell,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

DIRECTIONAL = wp.constant(0)
ISOTROPIC = wp.constant(1)


@wp.func
def radiosity_face(flux: wp.vec3, area: float) -> wp.vec4:
    """(radiosity * alpha, alpha) of a face from its reflected flux per voxel face and its projected area."""
    if area <= 0.0:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    alpha = wp.min(area, 1.0)
    color = flux * (alpha / area)
    return wp.vec4(color[0], color[1], color[2], alpha)


@wp.kernel
def _light_faces(
    first: int,
    volume: Volume,
    area_in: wp.array(dtype=wp.vec2),
    flux_in: wp.array(dtype=wp.vec3),
    mode: int,
    field_out: wp.array(dtype=wp.vec4),
):
    """Level-0 field of one record. The isotropic form, as in the paper, marks the voxel as wholly occupied and
    forgets which way its surfaces face."""
    i = first + wp.tid()
    if mode == ISOTROPIC:
        for solution in range(2):
            flux = wp.vec3(0.0, 0.0, 0.0)
            area = float(0.0)
            for face in range(6):
                flux += flux_in[(i * 6 + face) * 2 + solution]
                area += area_in[i * 6 + face][solution]
            value = wp.vec4(0.0, 0.0, 0.0, 0.0)
            if area > 0.0:
                value = wp.vec4(flux[0] / area, flux[1] / area, flux[2] / area, 1.0)
            for face in range(6):
                field_out[field_slot(volume, i, face) + solution] = value
    else:
        for face in range(6):
            shown = area_in[i * 6 + face]
            slot = field_slot(volume, i, face)
            field_out[slot] = radiosity_face(flux_in[(i * 6 + face) * 2], shown[0])
            field_out[slot + 1] = radiosity_face(flux_in[(i * 6 + face) * 2 + 1], shown[1])


@wp.func
def child_value(volume: Volume, level: int, x: int, y: int, z: int, face: int, solution: int) -> wp.vec4:
    record = find_record(volume, level, x, y, z)
    if record < 0:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    return volume.field[field_slot(volume, record, face) + solution]


@wp.func
def composite_pair(front: wp.vec4, back: wp.vec4) -> wp.vec4:
    """Two voxels one behind the other. Their projected areas add up until the face is covered.

    A surface that passes through both covers a different part of the face in each, so eq. 4's product of
    transparencies, which takes the parts as independent, would let light through a closed wall.
    """
    free = 1.0 - front[3]
    seen = float(0.0)
    if back[3] > 0.0:
        seen = wp.clamp(free / back[3], 0.0, 1.0)
    return front + back * seen


@wp.kernel
def _filter_level(
    first: int,
    key_in: wp.array(dtype=wp.int32),
    volume: Volume,
    level: int,
    record_start: int,
    mode: int,
    field_out: wp.array(dtype=wp.vec4),
):
    """A voxel of ``level`` from its eight children: pairs along the face's axis are composited, then averaged."""
    i = first + wp.tid()
    cell = key_cell(key_in[i], brick_extent(volume.n, level))
    x = 2 * cell[0]
    y = 2 * cell[1]
    z = 2 * cell[2]
    below = level - 1
    for k in range(12):
        face = k / 2
        solution = k % 2
        axis = face / 2
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)
        if mode == ISOTROPIC:
            for child in range(8):
                cx = x + (child & 1)
                cy = y + ((child >> 1) & 1)
                total += child_value(volume, below, cx, cy, z + (child >> 2), face, solution) * 0.125
        else:
            near = wp.where((face & 1) == 0, 1, 0)
            for pair in range(4):
                u = pair & 1
                v = pair >> 1
                ax = x + wp.where(axis == 0, near, u)
                ay = y + wp.where(axis == 1, near, wp.where(axis == 0, u, v))
                az = z + wp.where(axis == 2, near, v)
                flip = 1 - 2 * near
                bx = ax + wp.where(axis == 0, flip, 0)
                by = ay + wp.where(axis == 1, flip, 0)
                bz = az + wp.where(axis == 2, flip, 0)
                front = child_value(volume, below, ax, ay, az, face, solution)
                back = child_value(volume, below, bx, by, bz, face, solution)
                total += composite_pair(front, back) * 0.25
        field_out[field_slot(volume, record_start + i, face) + solution] = total

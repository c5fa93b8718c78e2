"""Split-injection of RSM flux into voxel faces, ordered by voxel so that the sums repeat bit for bit."""

import warp as wp

from warp_dvct.kernels.sorting import EMPTY_KEY
from warp_dvct.kernels.volume import Volume, face_weight, find_record

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NUDGE = wp.constant(0.3)  # voxels; a point on the wall between two voxels may round into the empty one


@wp.func
def shown_area(area: wp.array(dtype=wp.vec2), record: int, normal: wp.vec3, role: int) -> float:
    """Area that real surfaces (role 0), or all, show of an orientation."""
    total = float(0.0)
    for face in range(6):
        shown = area[record * 6 + face]
        total += face_weight(normal, face) * wp.where(role == 0, shown[0], shown[1])
    return total


@wp.func
def record_at(volume: Volume, area: wp.array(dtype=wp.vec2), position: wp.vec3, normal: wp.vec3, role: int) -> int:
    """The record that holds a surface point of that orientation, or -1.

    A real point needs a real surface: the outside of a floor is not to shine through what stands on its inside.
    """
    local = (position - volume.low) / volume.voxel
    for attempt in range(3):
        p = local
        if attempt == 1:
            p = local - normal * NUDGE
        if attempt == 2:
            p = local + normal * NUDGE
        record = find_record(volume, 0, int(wp.floor(p[0])), int(wp.floor(p[1])), int(wp.floor(p[2])))
        if record >= 0:
            if shown_area(area, record, normal, role) > 0.0:
                return record
    return -1


@wp.kernel
def _find_targets(
    first: int,
    volume: Volume,
    area_in: wp.array(dtype=wp.vec2),
    position_after_in: wp.array(dtype=wp.vec3),
    normal_after_in: wp.array(dtype=wp.vec3),
    role_after_in: wp.array(dtype=wp.int32),
    position_before_in: wp.array(dtype=wp.vec3),
    normal_before_in: wp.array(dtype=wp.vec3),
    role_before_in: wp.array(dtype=wp.int32),
    texels: int,
    key_out: wp.array(dtype=wp.int32),
):
    """Records that texel i feeds: entry i by its after surface, entry texels + i by its before surface.

    Where both maps see the same real surface, entry i stands for both and the other is empty.
    """
    i = first + wp.tid()
    after = int(-1)
    before = int(-1)
    if role_after_in[i] >= 0:
        after = record_at(volume, area_in, position_after_in[i], normal_after_in[i], role_after_in[i])
    if role_before_in[i] >= 0 and role_after_in[i] != 0:
        before = record_at(volume, area_in, position_before_in[i], normal_before_in[i], 0)
    key_out[i] = wp.where(after >= 0, after, EMPTY_KEY)
    key_out[texels + i] = wp.where(before >= 0, before, EMPTY_KEY)


@wp.func
def wide(v: wp.vec3) -> wp.vec3d:
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.func
def narrow(v: wp.vec3d) -> wp.vec3:
    return wp.vec3(float(v[0]), float(v[1]), float(v[2]))


@wp.kernel
def _inject(
    first: int,
    record_in: wp.array(dtype=wp.int32),
    start_in: wp.array(dtype=wp.int32),
    order_in: wp.array(dtype=wp.int32),
    normal_after_in: wp.array(dtype=wp.vec3),
    flux_after_in: wp.array(dtype=wp.vec3),
    normal_before_in: wp.array(dtype=wp.vec3),
    flux_before_in: wp.array(dtype=wp.vec3),
    role_after_in: wp.array(dtype=wp.int32),
    role_before_in: wp.array(dtype=wp.int32),
    texels: int,
    runs: int,
    entries: int,
    inverse_face: float,
    flux_out: wp.array(dtype=wp.vec3),
):
    """Add the texels of one record to its faces: eq. 2's cosine becomes the share max(0, n . e) of each face.

    A texel whose first surface is synthetic adds +flux there (after) and has its real surface's flux in before alone,
    so that after - before holds the paper's -flux: the split-injection. Sums are double: a voxel may get 10^7 texels.
    """
    i = first + wp.tid()
    record = record_in[i]
    end = entries
    if i + 1 < runs:
        end = start_in[i + 1]
    for face in range(6):
        before = wide(wp.vec3(0.0, 0.0, 0.0))
        after = wide(wp.vec3(0.0, 0.0, 0.0))
        for j in range(start_in[i], end):
            entry = order_in[j]
            if entry < texels:
                share = face_weight(normal_after_in[entry], face)
                if share > 0.0:
                    after += wide(flux_after_in[entry] * share)
                    if role_after_in[entry] == 0 and role_before_in[entry] == 0:
                        before += wide(flux_after_in[entry] * share)
            else:
                share = face_weight(normal_before_in[entry - texels], face)
                before += wide(flux_before_in[entry - texels] * share)
        flux_out[(record * 6 + face) * 2] += narrow(before) * inverse_face
        flux_out[(record * 6 + face) * 2 + 1] += narrow(after) * inverse_face

"""Averages over the frames of a shot in which only the camera moves.

Diffuse irradiance is of the place, not of the view: it is found again where the camera has moved to (reverse
reprojection, Nehab et al. 2007). What depends on the view is averaged only while the camera stands still.
"""

import warp as wp

from warp_dvct.kernels.gbuffer import BACKGROUND, Points
from warp_dvct.kernels.geometry import CameraFrame

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

PLANE_GAP = wp.constant(2.0)  # footprints by which the found place may lie off the point's tangent plane
REACH = wp.constant(4.0)  # footprints up to which a found place is a neighbour at all
FACING = wp.constant(0.9)  # cosine between normals of the same surface
LEAST = wp.constant(0.05)  # bilinear weight below which nothing was found


@wp.struct
class Past:
    """Mean irradiance at the last frame's points, and over how many frames."""

    camera: CameraFrame
    width: wp.int32
    height: wp.int32
    points: Points
    frames: wp.array(dtype=wp.float32)
    before: wp.array(dtype=wp.vec3)
    after: wp.array(dtype=wp.vec3)


@wp.struct
class Found:
    """What the past knows of a point."""

    frames: wp.float32
    before: wp.vec3
    after: wp.vec3


@wp.func
def is_same_place(points: Points, i: int, old: Points, j: int) -> bool:
    """Whether the last frame's point j shows the surface of point i, and next to it."""
    if old.role[j] != points.role[i]:
        return False
    footprint = wp.max(points.footprint[i], old.footprint[j])
    offset = old.position[j] - points.position[i]
    off_plane = wp.max(wp.abs(wp.dot(offset, points.normal_g[i])), wp.abs(wp.dot(offset, old.normal_g[j])))
    return (
        wp.length(offset) < REACH * footprint
        and off_plane < PLANE_GAP * footprint
        and wp.dot(points.normal[i], old.normal[j]) > FACING
    )


@wp.func
def find_past(past: Past, points: Points, i: int) -> Found:
    """Mean of the last frame's four pixels around a point's place in its picture, where they show the same surface.

    Each counts by its share of the place and by its confidence: over how many frames it is a mean.
    """
    out = Found()
    cam = past.camera
    toward = points.position[i] - cam.origin
    depth = wp.dot(toward, cam.forward)
    if depth <= 0.0:
        return out
    x = wp.dot(toward, cam.right) / depth
    y = wp.dot(toward, cam.up) / depth
    px = (x - cam.tan_left) / (cam.tan_right - cam.tan_left) * float(past.width) - 0.5
    py = (y - cam.tan_top) / (cam.tan_bottom - cam.tan_top) * float(past.height) - 0.5
    if not (px > -1.0 and py > -1.0 and px < float(past.width) and py < float(past.height)):
        return out
    x0 = int(wp.floor(px))
    y0 = int(wp.floor(py))
    total = float(0.0)
    frames = float(0.0)
    before = wp.vec3(0.0, 0.0, 0.0)
    after = wp.vec3(0.0, 0.0, 0.0)
    for corner in range(4):
        cx = x0 + corner % 2
        cy = y0 + corner / 2
        if cx >= 0 and cx < past.width and cy >= 0 and cy < past.height:
            j = cy * past.width + cx
            if is_same_place(points, i, past.points, j):
                share = (1.0 - wp.abs(float(cx) - px)) * (1.0 - wp.abs(float(cy) - py))
                weight = share * past.frames[j]
                total += share
                frames += weight
                before += past.before[j] * weight
                after += past.after[j] * weight
    if total > LEAST and frames > 0.0:
        out.frames = frames / total
        out.before = before / frames
        out.after = after / frames
    return out


@wp.kernel
def _blend_past(
    first: int,
    past: Past,
    points: Points,
    still: int,
    most: float,
    before_out: wp.array(dtype=wp.vec3),
    after_out: wp.array(dtype=wp.vec3),
    frames_out: wp.array(dtype=wp.float32),
):
    """Mean of this frame's irradiance, which the outputs hold, and of the past's, of at most ``most`` frames in all.

    ``still`` is 1 where the points are those of the last frame.
    """
    i = first + wp.tid()
    frames_out[i] = 1.0
    if points.role[i] == BACKGROUND:
        return
    known = Found()
    if still != 0:
        known.frames = past.frames[i]
        known.before = past.before[i]
        known.after = past.after[i]
    else:
        known = find_past(past, points, i)
    n = wp.min(known.frames, most - 1.0)
    if n > 0.0:
        before_out[i] = (known.before * n + before_out[i]) / (n + 1.0)
        after_out[i] = (known.after * n + after_out[i]) / (n + 1.0)
        frames_out[i] = n + 1.0


@wp.kernel
def _blend_same(first: int, past_in: wp.array(dtype=wp.vec3), frames: float, values_out: wp.array(dtype=wp.vec3)):
    """Mean of this frame's values, which the output holds, and of the mean of ``frames`` ones before."""
    i = first + wp.tid()
    values_out[i] = (past_in[i] * frames + values_out[i]) / (frames + 1.0)

"""Depth jumps moved to where the photograph has its edges: depth is uncertain there by a pixel, colour is not."""

import warp as wp

from warp_dvct.kernels.depth_filter import Lens, Limits, same_surface

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

TILE = wp.constant(8)  # pixels an edge of the blocks that are left out where no jump is near
REACH = wp.constant(3)  # pixels to each side that tell both surfaces' colours
BESIDE = wp.constant(3)  # of a pixel's eight neighbours, on the surface that it goes to: none is left alone
BAND = wp.constant(2)  # pixels from a jump that may be on the wrong side of it


@wp.kernel
def _sample_guide(
    first: int,
    lens: Lens,
    inverse_in: wp.array(dtype=wp.float32),
    turn: wp.mat33,
    shift: wp.vec3,
    photo_lens: Lens,
    photo_in: wp.array(dtype=wp.vec3),
    guide_out: wp.array(dtype=wp.vec3),
):
    """The photograph's colour at each pixel's surface, from the nearest of its pixels; negative where there is none."""
    i = first + wp.tid()
    guide = wp.vec3(-1.0, -1.0, -1.0)
    rho = inverse_in[i]
    if rho > 0.0:
        u, v = float(i % lens.width), float(i / lens.width)
        p = turn * (wp.vec3((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, 1.0) / rho) + shift
        if p[2] > 0.0:
            x = int(wp.floor(photo_lens.fx * p[0] / p[2] + photo_lens.cx + 0.5))
            y = int(wp.floor(photo_lens.fy * p[1] / p[2] + photo_lens.cy + 0.5))
            if x >= 0 and y >= 0 and x < photo_lens.width and y < photo_lens.height:
                guide = photo_in[y * photo_lens.width + x]
    guide_out[i] = guide


@wp.kernel
def _mark_jumps(
    first: int, lens: Lens, limits: Limits, inverse_in: wp.array(dtype=wp.float32), mark_out: wp.array(dtype=wp.int32)
):
    """1 for pixels with a neighbour to a side on another surface."""
    i = first + wp.tid()
    rho = inverse_in[i]
    mark = int(0)
    if rho > 0.0:
        x, y = i % lens.width, i / lens.width
        for k in range(4):
            nx = x + wp.where(k == 0, 1, wp.where(k == 1, -1, 0))
            ny = y + wp.where(k == 2, 1, wp.where(k == 3, -1, 0))
            if nx >= 0 and ny >= 0 and nx < lens.width and ny < lens.height:
                other = inverse_in[ny * lens.width + nx]
                if other > 0.0 and not same_surface(rho, other, limits):
                    mark = int(1)
    mark_out[i] = mark


@wp.kernel
def _flag_tiles(
    first: int, lens: Lens, mark_in: wp.array(dtype=wp.int32), tiles_across: int, flag_out: wp.array(dtype=wp.int32)
):
    """1 for blocks of pixels that have a jump in or near them."""
    t = first + wp.tid()
    x0, y0 = (t % tiles_across) * TILE, (t / tiles_across) * TILE
    flag = int(0)
    for y in range(wp.max(y0 - BAND, 0), wp.min(y0 + TILE + BAND, lens.height)):
        for x in range(wp.max(x0 - BAND, 0), wp.min(x0 + TILE + BAND, lens.width)):
            flag = wp.max(flag, mark_in[y * lens.width + x])
    flag_out[t] = flag


@wp.kernel
def _snap(
    first: int,
    lens: Lens,
    inverse_in: wp.array(dtype=wp.float32),
    guide_in: wp.array(dtype=wp.vec3),
    mark_in: wp.array(dtype=wp.int32),
    flag_in: wp.array(dtype=wp.int32),
    tiles_across: int,
    contrast: float,
    inverse_out: wp.array(dtype=wp.float32),
):
    """Give pixels near a jump to the surface whose mean colour around is clearly nearer to theirs.

    Colours and depths of both surfaces are means of pixels that are not beside the jump themselves. Where both have
    nearly one colour (closer than ``contrast``), depth stays as it was measured.
    """
    i = first + wp.tid()
    rho = float(inverse_in[i])
    guide = guide_in[i]
    x, y = i % lens.width, i / lens.width
    near_jump = int(0)
    flag = flag_in[(y / TILE) * tiles_across + x / TILE]
    if flag != 0 and rho > 0.0 and guide[0] >= 0.0:
        for dy in range(-BAND, BAND + 1):
            for dx in range(-BAND, BAND + 1):
                nx, ny = x + dx, y + dy
                if nx >= 0 and ny >= 0 and nx < lens.width and ny < lens.height:
                    near_jump = wp.max(near_jump, mark_in[ny * lens.width + nx])
    if near_jump != 0:
        least, most = float(rho), float(rho)
        for dy in range(-REACH, REACH + 1):
            for dx in range(-REACH, REACH + 1):
                nx, ny = x + dx, y + dy
                if nx >= 0 and ny >= 0 and nx < lens.width and ny < lens.height:
                    other = inverse_in[ny * lens.width + nx]
                    if other > 0.0:
                        least, most = wp.min(least, other), wp.max(most, other)
        middle = 0.5 * (least + most)
        color_near, color_far = wp.vec3(0.0, 0.0, 0.0), wp.vec3(0.0, 0.0, 0.0)
        rho_near, rho_far = float(0.0), float(0.0)
        count_near, count_far = float(0.0), float(0.0)
        beside_near, beside_far = int(0), int(0)
        for dy in range(-REACH, REACH + 1):
            for dx in range(-REACH, REACH + 1):
                nx, ny = x + dx, y + dy
                if nx >= 0 and ny >= 0 and nx < lens.width and ny < lens.height:
                    j = ny * lens.width + nx
                    other = inverse_in[j]
                    color = guide_in[j]
                    if other > 0.0 and wp.max(wp.abs(dx), wp.abs(dy)) == 1:
                        if other > middle:
                            beside_near += 1
                        else:
                            beside_far += 1
                    if other > 0.0 and mark_in[j] == 0 and color[0] >= 0.0:
                        if other > middle:
                            color_near += color
                            rho_near += other
                            count_near += 1.0
                        else:
                            color_far += color
                            rho_far += other
                            count_far += 1.0
        if count_near > 0.0 and count_far > 0.0:
            color_near /= count_near
            color_far /= count_far
            if wp.length(color_near - color_far) > contrast:
                to_near, to_far = wp.length(guide - color_near), wp.length(guide - color_far)
                if rho > middle and to_far < 0.7 * to_near and beside_far >= BESIDE:
                    rho = rho_far / count_far
                elif rho <= middle and to_near < 0.7 * to_far and beside_near >= BESIDE:
                    rho = rho_near / count_near
    inverse_out[i] = rho

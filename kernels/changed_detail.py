"""Sparse gathering on a photograph: detail is gathered only where the synthetic objects change the light."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def _unmark_unchanged(
    first: int,
    columns: int,
    rows: int,
    fine_columns: int,
    coarse_before_in: wp.array(dtype=wp.vec3),
    coarse_after_in: wp.array(dtype=wp.vec3),
    before_in: wp.array(dtype=wp.vec3),
    least: float,
    mark_out: wp.array(dtype=wp.int32),
):
    """Unmark blocks of half the stride around which no gathered point saw a change.

    A photograph holds the light before; only the change is added to it, and where all nine blocks around gathered less
    of it than ``least`` of the irradiance, interpolating it errs by less than that. Blocks on surfaces of which nothing
    is gathered, whose interpolated ``before_in`` is 0, stay marked.
    """
    i = first + wp.tid()
    if mark_out[i] != 0:
        cx = (i % fine_columns) / 2
        cy = (i / fine_columns) / 2
        change = float(0.0)
        for y in range(wp.max(cy - 1, 0), wp.min(cy + 1, rows - 1) + 1):
            for x in range(wp.max(cx - 1, 0), wp.min(cx + 1, columns - 1) + 1):
                block = y * columns + x
                change = wp.max(change, wp.max(wp.abs(coarse_after_in[block] - coarse_before_in[block])))
        if change < least * wp.max(before_in[i]):
            mark_out[i] = 0

"""Sorted integer keys: where runs of equal ones begin, and where those end that count."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

EMPTY_KEY = wp.constant(0x7FFFFFFF)  # sorts behind every other


@wp.kernel
def _count_up(first: int, order_out: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    order_out[i] = i


@wp.kernel
def _mark_starts(first: int, key_in: wp.array(dtype=wp.int32), shift: int, start_out: wp.array(dtype=wp.int32)):
    """1 where a sorted key, less its ``shift`` lowest bits, differs from the one before it; 0 for EMPTY_KEY."""
    i = first + wp.tid()
    key = key_in[i]
    start = int(0)
    if key != EMPTY_KEY:
        start = 1
        if i > 0:
            if (key_in[i - 1] >> shift) == (key >> shift):
                start = 0
    start_out[i] = start


@wp.kernel
def _list_starts(
    first: int,
    key_in: wp.array(dtype=wp.int32),
    mark_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    shift: int,
    key_out: wp.array(dtype=wp.int32),
    start_out: wp.array(dtype=wp.int32),
):
    """Unique keys and where their runs begin; ``rank_in`` is the inclusive scan of ``mark_in``."""
    i = first + wp.tid()
    if mark_in[i] == 1:
        key_out[rank_in[i] - 1] = key_in[i] >> shift
        start_out[rank_in[i] - 1] = i


@wp.kernel
def _find_end(first: int, key_in: wp.array(dtype=wp.int32), count: int, end_out: wp.array(dtype=wp.int32)):
    """The number of sorted keys before EMPTY_KEY, by halving; one element."""
    i = first + wp.tid()
    low = int(0)
    high = int(count)
    while low < high:
        middle = (low + high) / 2
        if key_in[middle] == EMPTY_KEY:
            high = middle
        else:
            low = middle + 1
    end_out[i] = low

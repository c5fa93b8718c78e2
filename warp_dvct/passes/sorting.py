"""Sorting, scans and runs of integer keys, as the passes share them."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_dvct.kernels import sorting as kernels
from warp_dvct.launch import Launcher


def sort_by_key(launcher: Launcher, key: Any, order: Any, count: int) -> None:
    """Sort ``key[:count]`` in place and fill ``order`` with the permutation; both hold 2 * count entries. Stable."""
    launcher.launch(kernels._count_up, count, [], [order])
    if count > 1:
        wp.utils.radix_sort_pairs(key, order, count)


def scan(launcher: Launcher, counts: Any) -> tuple[Any, int]:
    """Inclusive prefix sum, and the total."""
    ends = launcher.empty(counts.shape[0], wp.int32)
    wp.utils.array_scan(counts, ends, inclusive=True)
    return ends, int(ends[-1:].numpy()[0])


def count_below(launcher: Launcher, key: Any, count: int) -> int:
    """Entries of a sorted key array that are not EMPTY_KEY."""
    if count == 0:
        return 0
    found = launcher.empty(1, wp.int32)
    launcher.launch(kernels._find_end, 1, [key, count], [found])
    return int(found.numpy()[0])


def unique_runs(launcher: Launcher, key: Any, count: int, shift: int = 0) -> tuple[Any, Any]:
    """Unique values of ``key[:count] >> shift`` (sorted, without EMPTY_KEY) and the index where each begins."""
    mark = launcher.zeros(max(count, 1), wp.int32)
    launcher.launch(kernels._mark_starts, count, [key, shift], [mark])
    rank, unique = scan(launcher, mark)
    keys = launcher.empty(unique, wp.int32)
    starts = launcher.empty(max(unique, 1), wp.int32)
    launcher.launch(kernels._list_starts, count, [key, mark, rank, shift], [keys, starts])
    return keys, starts

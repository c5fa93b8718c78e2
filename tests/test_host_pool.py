"""Memory that frames leave behind serves the next ones, and none of it is lost, shared or kept without bound."""

import gc

import numpy as np
import pytest
import warp as wp

from warp_dvct import launch
from warp_dvct.errors import DeviceError
from warp_dvct.host_pool import CLASSES_PER_OCTAVE, SMALLEST, HostPool, rounded
from warp_dvct.launch import Launcher
from warp_dvct.relighter import Relighter
from warp_dvct.usd_scenes import path


def test_sizes_are_rounded_up_by_at_most_an_eighth():
    for size in (1, 2, 17, 131072, 131073, 10**6, 2**30 + 1, 3 * 2**33 + 5):
        assert size <= rounded(size) <= size * (1 + 1 / CLASSES_PER_OCTAVE) + 1
        assert rounded(rounded(size)) == rounded(size)
    assert rounded(0) == 0
    assert len({rounded(n) for n in range(2**20 + 1, 2**21 + 1)}) == CLASSES_PER_OCTAVE


def test_a_block_is_used_again_and_never_by_two_at_once():
    pool = HostPool()
    a, b = pool.allocate(10**6), pool.allocate(10**6)
    assert a != b
    pool.deallocate(a, 10**6)
    assert pool.kept_bytes == rounded(10**6)
    assert pool.allocate(10**6 - 5) == a  # of the same size when rounded
    assert pool.kept_bytes == 0
    assert pool.allocate(10**6) not in (a, b)


def test_the_longest_unused_leave_first():
    pool = HostPool(most=3 * rounded(10**6))
    blocks = [pool.allocate(10**6) for _ in range(4)]
    for block in blocks:
        pool.deallocate(block, 10**6)
    assert pool.kept_bytes == pool.most
    assert [pool.allocate(10**6) for _ in range(3)] == blocks[:0:-1]
    big = pool.allocate(10**7)
    pool.deallocate(big, 10**7)  # more than may be kept at all
    assert pool.kept_bytes == 0


def test_what_is_kept_is_given_back_before_memory_runs_out(monkeypatch):
    pool = HostPool()
    pool.deallocate(pool.allocate(10**6), 10**6)
    asked = []

    def empty(size, dtype):
        asked.append(pool.kept_bytes)
        if pool.kept_bytes > 0:
            raise MemoryError
        return np.zeros(size, dtype)

    monkeypatch.setattr("warp_dvct.host_pool.np.empty", empty)
    pool.allocate(10**7)
    assert asked == [rounded(10**6), 0]


def test_running_out_is_an_error_that_names_the_pass():
    launcher = Launcher("cpu")
    with launcher.scope("voxelize"), pytest.raises(DeviceError, match="out of memory in pass 'voxelize'"):
        launcher.empty(2**60, wp.float32)
    assert launcher.live_bytes == 0


def test_arrays_hold_what_they_were_made_with(monkeypatch):
    """Memory used before is not clean: zeros, values and copies have to be written."""
    monkeypatch.setattr(launch, "_host_pool", HostPool())
    launcher = Launcher("cpu")
    count = SMALLEST
    values = np.arange(3 * count, dtype=np.float32).reshape(count, 3)
    for _ in range(2):  # the second time in the memory of the first
        zeros, ones, copied = (
            launcher.zeros(count, wp.vec3),
            launcher.full(count, 1, wp.int32),
            launcher.array(values, wp.vec3),
        )
        assert not zeros.numpy().any()
        assert (ones.numpy() == 1).all()
        assert np.array_equal(copied.numpy(), values)
        assert launcher.live_bytes == count * (12 + 4 + 12)
        copied.numpy()[:] = -1.0
        assert values[1, 0] == 3.0
        zeros.numpy()[:] = 5.0
        ones.numpy()[:] = 7
        del zeros, ones, copied
    assert launcher.live_bytes == 0
    assert launch._host_pool.kept_bytes == rounded(count * 12) * 2 + rounded(count * 4)


def test_layers_own_their_memory_for_as_long_as_they_live(monkeypatch):
    """What a frame hands over is the caller's: the next frame must not write there; once dropped, it may."""
    monkeypatch.setattr(launch, "_host_pool", HostPool())
    plate = np.full((90, 160, 3), 0.5, np.float32)

    def frame():
        return Relighter(path("room_area"), quality="draft", width=160).render(plate)

    first = frame()
    held = first.comp.copy()
    second = frame()
    assert not np.shares_memory(first.comp, second.comp)
    assert np.array_equal(first.comp, held)
    assert np.array_equal(second.comp, held)
    row = second.comp[3]  # a part keeps all of it
    kept = row.copy()
    del first, second
    gc.collect()
    before = launch._host_pool.kept_bytes
    third = frame()
    assert np.array_equal(row, kept)
    assert launch._host_pool.kept_bytes < before
    assert np.array_equal(third.comp, held)


def test_frames_from_scratch_take_no_new_memory(monkeypatch):
    pool = HostPool()
    monkeypatch.setattr(launch, "_host_pool", pool)
    plate = np.full((180, 320, 3), 0.5, np.float32)
    new = []
    monkeypatch.setattr(pool, "_new", lambda size: new.append(size) or HostPool._new(pool, size))
    for _ in range(3):
        new.clear()
        Relighter(path("room_area"), quality="draft", width=320).render(plate)
        gc.collect()
    assert new == []

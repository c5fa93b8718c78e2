"""Launches in slabs, and kernels that run beside others: every element once, nothing at work once a block is left."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp

from warp_dvct.launch import Launcher
from warp_dvct.relighter import Relighter
from warp_dvct.slabs import Slabs
from warp_dvct.usd_scenes import path

COUNT = 4099  # a prime: the last slab is smaller than the others


@wp.kernel
def _count_up(first: int, rounds: int, out: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    x = float(i)
    for _ in range(rounds):
        x = wp.sin(x)
    out[i] += wp.where(x > 2.0, 2, 1)


@pytest.fixture
def launcher():
    launcher = Launcher("cpu", 2)
    launcher.load(_count_up.module)
    return launcher


@pytest.mark.parametrize("slab", [1000, COUNT, COUNT + 5, 7])
@pytest.mark.parametrize("helpers", [0, 1, 5])
def test_every_element_runs_once(launcher, slab, helpers):
    out = launcher.zeros(COUNT, wp.int32)
    with ThreadPoolExecutor(2) as pool:
        slabs = Slabs(pool, _count_up, slab, COUNT, [3], [out], launcher.device)
        slabs.hand_out(helpers)
        slabs.finish()
        assert not slabs.under_way
    assert (out.numpy() == 1).all()
    assert 0.0 <= slabs.helped <= slabs.seconds


def test_no_thread_is_waited_for_that_has_not_begun(launcher):
    """A pool that is busy with something else does not hold a launch up."""
    out = launcher.zeros(COUNT, wp.int32)
    free = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        pool.submit(free.wait)
        slabs = Slabs(pool, _count_up, 100, COUNT, [3], [out], launcher.device)
        slabs.hand_out(1)
        slabs.finish()  # would wait for ever
        free.set()
    assert (out.numpy() == 1).all()
    assert slabs.helped == 0.0


def test_what_runs_beside_is_done_when_the_block_ends(launcher):
    beside, inside = (launcher.zeros(COUNT, wp.int32) for _ in range(2))
    with launcher.beside(_count_up, COUNT, [200], [beside]):
        for _ in range(3):
            launcher.launch(_count_up, COUNT, [20], [inside])
        assert (inside.numpy() == 3).all()
    assert (beside.numpy() == 1).all()


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_two_at_once(threads):
    launcher = Launcher("cpu", threads)
    outs = [launcher.zeros(COUNT, wp.int32) for _ in range(3)]
    with launcher.beside(_count_up, COUNT, [100], [outs[0]]), launcher.beside(_count_up, COUNT, [100], [outs[1]]):
        launcher.launch(_count_up, COUNT, [100], [outs[2]])
    assert all((out.numpy() == 1).all() for out in outs)
    with launcher.beside(_count_up, 0, [1], [outs[0]]):
        pass
    assert (outs[0].numpy() == 1).all()


def test_an_error_leaves_nothing_at_work(launcher):
    """The caller frees arrays after an error: whoever still wrote to them would write to someone else's memory."""
    out = launcher.zeros(COUNT, wp.int32)
    with pytest.raises(KeyboardInterrupt), launcher.beside(_count_up, COUNT, [20000], [out]):
        raise KeyboardInterrupt
    done = out.numpy().copy()
    time.sleep(0.05)
    assert np.array_equal(out.numpy(), done)
    assert (done == 0).any()  # what was not begun is left out
    with launcher.beside(_count_up, COUNT, [3], [out]):
        pass
    assert np.array_equal(out.numpy(), done + 1)


def test_processor_time_counts_where_a_kernel_was_launched(launcher):
    beside, inside = (launcher.zeros(COUNT, wp.int32) for _ in range(2))
    launcher.reset_times()
    start, begun = time.process_time(), time.perf_counter()
    with launcher.scope("outer"), launcher.beside(_count_up, COUNT, [3000], [beside]), launcher.scope("inner"):
        launcher.launch(_count_up, COUNT, [1000], [inside])
    spent, wall = time.process_time() - start, time.perf_counter() - begun
    cpu = launcher.pass_cpu_seconds
    assert cpu["outer"] / cpu["inner"] == pytest.approx(3.0, rel=0.5)
    assert 0.5 * spent < sum(cpu.values()) <= 1.01 * spent
    assert 0.5 * wall < sum(launcher.pass_seconds.values()) <= wall


@pytest.mark.parametrize("settings", [{}, {"shadows": "cone"}])
@pytest.mark.parametrize("plate", [True, False])
def test_frames_do_not_depend_on_what_runs_at_once(settings, plate):
    photograph = np.full((45, 80, 3), 0.5, np.float32) if plate else None
    first, second = (
        Relighter(path("room_area"), quality="draft", width=80, settings=settings, overlap=overlap).render(photograph)
        for overlap in (False, True)
    )
    for name in ("comp", "delta", "rgba"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name

"""A kernel launch on the CPU in slabs, which threads take one after the other until none is left."""

from __future__ import annotations

import copy
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import warp as wp


class Slabs:
    """A launch of ``count`` elements in slabs of ``slab``, recorded once and replayed by every thread that takes part.

    Attributes:
        seconds: Processor time of all threads, once it is finished; ``helped`` is that of the pool's.
    """

    def __init__(
        self,
        pool: ThreadPoolExecutor,
        kernel: wp.Kernel,
        slab: int,
        count: int,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        device: Any,
    ) -> None:
        begun = time.thread_time()
        self._pool, self._slab, self._count = pool, slab, count
        self._waiting = deque(range(0, count, slab))
        self._command = wp.launch(
            kernel, dim=slab, inputs=[0, *inputs], outputs=list(outputs), device=device, record_cmd=True
        )
        self._helpers: list[Future[float]] = []
        self.helped = 0.0
        self.seconds = time.thread_time() - begun

    @property
    def under_way(self) -> bool:
        """Whether a thread of the pool is at work, or about to be."""
        return any(not helper.done() for helper in self._helpers)

    def hand_out(self, threads: int) -> None:
        """Let that many threads of the pool take slabs, as soon as they have nothing else to do."""
        for _ in range(min(threads, len(self._waiting))):
            self._helpers.append(self._pool.submit(self._take, _another(self._command)))

    def finish(self) -> None:
        """Take slabs on this thread too, and come back when all are done."""
        try:
            # A thread that only waits leaves its core last, and of those it woke two may share one.
            self.seconds += self._take(self._command)
            self.helped = sum(helper.result() for helper in self._helpers if not helper.cancel())
            self.seconds += self.helped
        finally:
            self.stop()

    def stop(self) -> None:
        """Leave out what is not begun, and come back when no thread is at work: the caller may then free its arrays."""
        self._waiting.clear()
        wait([helper for helper in self._helpers if not helper.cancel()])

    def _take(self, command: Any) -> float:
        """Replay a recorded launch for slabs until none is left; the processor seconds that took."""
        begun = time.thread_time()
        command.set_param_at_index(0, 0)  # a number of its own: commands of other threads share the rest
        while True:
            try:
                start = self._waiting.popleft()
            except IndexError:
                return time.thread_time() - begun
            command.set_param_at_index_from_ctype(0, start)
            if start + self._slab > self._count:  # the last of all
                command.set_dim(self._count - start)
            command.launch()


def _another(command: Any) -> Any:
    """The same recorded launch for another thread: packing its arguments anew would hold Python's lock again."""
    other = copy.copy(command)
    other.params = list(command.params)
    return other

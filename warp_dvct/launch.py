"""Where kernels run: device choice, slabs over CPU threads, timing scopes and memory accounting.

This is the only caller of ``wp.launch``. A Warp launch on the CPU runs on one thread, so :meth:`Launcher.launch` cuts
the index range into slabs and hands them to a pool. Kernels therefore take ``first: int`` as their first argument and
work on element ``first + wp.tid()``; each writes only what that element owns, so results do not depend on the slabs.
On a GPU, where one thread for each point would leave most of it idle, :meth:`Launcher.parts` elements share a point's
work: each writes its own sum, or a maximum that is atomic there and does not depend on the order.
"""

from __future__ import annotations

import math
import os
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
import warp as wp

from warp_dvct.check import Checker, poison
from warp_dvct.errors import DeviceError, OptionError
from warp_dvct.host_pool import SMALLEST, HostPool
from warp_dvct.slabs import Slabs

SLABS_PER_THREAD = 8  # enough that an uneven slab does not leave the other threads idle
MIN_SLAB_SECONDS = 1.0e-4  # less work is not worth handing to another thread
ALONE_SECONDS = 1.5e-3  # less is not handed to threads that have something else to do
FIRST_GUESS = 1.0e-6  # seconds an element, of a kernel that has not run
PARTS_CUDA = 32  # of a point's rays or a map's splats: a GPU wants more threads than there are points, and short ones
THREADS_CUDA = 2**20  # beyond which more parts would fill memory and not the GPU
KEPT_BYTES_CUDA = 2**30  # freed memory that is kept for the next arrays: to return it and ask again takes 0.1 ms each
FORGETTING = 0.7  # of the dearest launch so far, per launch: kernels are launched with light and heavy elements in turn

Made = TypeVar("Made")

_host_pool = HostPool()  # of all launchers: frames from scratch follow one another too
# Seconds an element took in each kernel's launches so far, by kernel and device: they decide the slabs, never a result.
_element_seconds: dict[tuple[Any, str], float] = {}


class Launcher:
    """Launches kernels on one device and keeps the books: seconds per pass, compile seconds, peak bytes.

    Args:
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        threads: CPU threads for slab launches; None for all cores that this process may use. Ignored on CUDA.
        check: Whether to look at what every launch wrote (``warp_dvct.check``).
    Raises:
        DeviceError: The device is not present.
        OptionError: ``threads`` is below 1.
    """

    def __init__(self, device: str = "cpu", threads: int | None = None, *, check: bool = False) -> None:
        self.device = find_device(device)
        if threads is not None and threads < 1:
            raise OptionError(f"threads is {threads}; give a number of at least 1")
        self.threads = 1 if self.device.is_cuda else (threads or len(os.sched_getaffinity(0)))
        if self.device.is_cuda and self.device.is_mempool_enabled:
            wp.set_mempool_release_threshold(self.device, KEPT_BYTES_CUDA)
        self._pool = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None
        self._beside: list[Slabs] = []
        self._helped_seconds = 0.0  # processor time of the pool's threads
        self.pass_seconds: dict[str, float] = {}
        self.pass_cpu_seconds: dict[str, float] = {}
        self.compile_seconds = 0.0
        self.compile_cpu_seconds = 0.0
        self.live_bytes = 0
        self.peak_bytes = 0
        self._counts: dict[int, weakref.ref[wp.array]] = {}  # of arrays in use, by their id
        self._scopes: list[list[Any]] = []
        self._loaded: set[tuple[int, str]] = set()
        self.checker = Checker() if check else None

    def launch(self, kernel: wp.Kernel, count: int, inputs: Sequence[Any], outputs: Sequence[Any] = ()) -> None:
        """Run ``kernel`` for elements 0 … count - 1; its first argument, the slab's start, is supplied here.

        Raises:
            CheckError: ``check`` was asked for, and the kernel wrote a number that it should not.
        """
        if count <= 0:
            return
        self.load(kernel.module)
        self._launch_all(kernel, count, inputs, outputs)
        if self.checker is not None:
            self.checker.after(self._scope_name(), kernel, count, inputs, outputs, self.device)

    @contextmanager
    def beside(
        self, kernel: wp.Kernel, count: int, inputs: Sequence[Any], outputs: Sequence[Any] = ()
    ) -> Iterator[None]:
        """Run a kernel beside what is done inside, which needs none of its ``outputs`` and leaves its arrays alone.

        One thread begins with it; at the end of the block all join. So the cores that short launches leave idle, and
        Python's own time, are of use. On a GPU, on one thread and where launches are checked, it runs first.
        """
        if self._pool is None or self.checker is not None or count <= 0:
            self.launch(kernel, count, inputs, outputs)
            yield
            return
        self.load(kernel.module)
        slab = -(-count // (self.threads * SLABS_PER_THREAD))
        slabs = Slabs(self._pool, kernel, slab, count, inputs, outputs, self.device)
        slabs.hand_out(1)
        self._beside.append(slabs)
        try:
            yield
            slabs.hand_out(self.threads - 2)
            self._finish(kernel, count, slabs)
        finally:
            slabs.stop()
            self._beside.remove(slabs)

    def apart(self, make: Callable[[], Made]) -> Callable[[], Made]:
        """Begin ``make`` on another thread, where there is one; what is returned waits for its result.

        For work in libraries that leave Python's lock alone; it must not use this launcher.
        """
        if self._pool is None:
            made = make()
            return lambda: made
        return self._pool.submit(make).result

    def _launch_all(self, kernel: wp.Kernel, count: int, inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
        seconds = count * self._element_seconds(kernel)
        slabs = min(self.threads * SLABS_PER_THREAD, int(seconds / MIN_SLAB_SECONDS))
        busy = sum(work.under_way for work in self._beside) >= self.threads - 1
        if self._pool is None or slabs <= 1 or (busy and seconds < ALONE_SECONDS):
            begun = time.thread_time()
            self._launch_slab(kernel, 0, count, inputs, outputs)
            self._learn(kernel, count, time.thread_time() - begun)
            return
        work = Slabs(self._pool, kernel, -(-count // slabs), count, inputs, outputs, self.device)
        work.hand_out(self.threads - 1)
        self._finish(kernel, count, work)

    def _finish(self, kernel: wp.Kernel, count: int, slabs: Slabs) -> None:
        slabs.finish()
        self._helped_seconds += slabs.helped
        self._learn(kernel, count, slabs.seconds)

    def _element_seconds(self, kernel: wp.Kernel) -> float:
        return _element_seconds.get((kernel, self.device.alias), FIRST_GUESS)

    def _learn(self, kernel: wp.Kernel, count: int, seconds: float) -> None:
        key = kernel, self.device.alias
        _element_seconds[key] = max(seconds / count, FORGETTING * self._element_seconds(kernel))

    def parts(self, count: int) -> int:
        """Elements that share out the rays of one of ``count`` points, or a map's splats: 1 on the CPU."""
        return max(1, min(PARTS_CUDA, THREADS_CUDA // max(1, count))) if self.device.is_cuda else 1

    def _scope_name(self) -> str:
        return self._scopes[-1][0] if self._scopes else "loading the scene"

    def differentiate(
        self, kernel: wp.Kernel, count: int, inputs: Sequence[Any], outputs: Sequence[Any], seeds: dict[Any, Any]
    ) -> None:
        """Run a kernel and its adjoint, on one CPU thread: adjoints of elements may share a target.

        Args:
            seeds: The gradient of a scalar by each output that counts, as an array of the output's shape. Afterwards
                the ``grad`` of every input that requires one holds the scalar's gradient by that input.
        """
        self.load(kernel.module)
        with wp.Tape() as tape:
            self._launch_slab(kernel, 0, count, inputs, outputs)
        tape.backward(grads=seeds)

    def _launch_slab(self, kernel, first, count, inputs, outputs) -> None:
        wp.launch(kernel, dim=count, inputs=[first, *inputs], outputs=list(outputs), device=self.device)

    def load(self, module: Any) -> None:
        """Compile and load a module once; its time goes to ``compile_seconds``, not to the pass that runs it."""
        key = (id(module), self.device.alias)
        if key in self._loaded:
            return
        start, cpu_start = time.perf_counter(), self._processor_seconds()
        level, wp.config.log_level = wp.config.log_level, wp.LOG_WARNING
        try:
            # Without it the CPU build is for blocks of 256, which no CPU launch uses: each thread would build again.
            module.load(self.device, block_dim=1 if self.device.is_cpu else None)
        finally:
            wp.config.log_level = level
        spent, cpu_spent = time.perf_counter() - start, self._processor_seconds() - cpu_start
        self.compile_seconds += spent
        self.compile_cpu_seconds += cpu_spent
        self._exclude(spent, cpu_spent)
        self._loaded.add(key)

    @contextmanager
    def scope(self, name: str) -> Iterator[None]:
        """Add the time spent inside to ``pass_seconds[name]``, without compilation; nested scopes count on their own.

        ``pass_cpu_seconds`` holds the processor time of all threads, which moves less on a busy machine. A kernel that
        runs beside (:meth:`beside`) counts where it was launched, by the clock with no more than what is left of it
        then. Running out of memory inside raises DeviceError with the pass's name.
        """
        scope = [name, 0.0, 0.0]
        self._scopes.append(scope)
        start, cpu_start = time.perf_counter(), self._processor_seconds()
        try:
            yield
            wp.synchronize_device(self.device)
        finally:
            self._scopes.pop()
            cpu_spent = self._processor_seconds() - cpu_start - scope[2]
            spent = time.perf_counter() - start - scope[1]
            self.pass_seconds[name] = self.pass_seconds.get(name, 0.0) + spent
            self.pass_cpu_seconds[name] = self.pass_cpu_seconds.get(name, 0.0) + cpu_spent
            self._exclude(spent, cpu_spent)

    def _processor_seconds(self) -> float:
        """Of this thread, and of the pool's in launches that are over."""
        return time.thread_time() + self._helped_seconds

    def _exclude(self, seconds: float, cpu_seconds: float) -> None:
        """Time that the scopes around do not count as their own."""
        for scope in self._scopes:
            scope[1] += seconds
            scope[2] += cpu_seconds

    def reset_times(self) -> None:
        """Forget the seconds per pass (not the compile seconds), as before a new frame."""
        self.pass_seconds = {}
        self.pass_cpu_seconds = {}

    def empty(self, shape: int | tuple[int, ...], dtype: Any) -> wp.array:
        """An uninitialised device array, counted in ``peak_bytes``."""
        array = self._counted(lambda: self._new(shape, dtype), shape, dtype)
        return array if self.checker is None else poison(array)

    def zeros(self, shape: int | tuple[int, ...], dtype: Any) -> wp.array:
        """A zeroed device array, counted in ``peak_bytes``."""
        array = self._counted(lambda: self._new(shape, dtype), shape, dtype)
        array.zero_()
        return array

    def full(self, shape: int | tuple[int, ...], value: Any, dtype: Any) -> wp.array:
        """A device array filled with ``value``, counted in ``peak_bytes``."""
        array = self._counted(lambda: self._new(shape, dtype), shape, dtype)
        array.fill_(value)
        return array

    def array(self, values: np.ndarray, dtype: Any) -> wp.array:
        """Copy host values to the device, counted in ``peak_bytes``; the copy never aliases ``values``."""
        values = np.ascontiguousarray(values)
        if self.device.is_cuda or values.nbytes < SMALLEST:
            return self._counted(
                lambda: wp.array(values, dtype=dtype, device=self.device, copy=True), values.shape, dtype
            )
        given = wp.array(values, dtype=dtype, device=self.device, copy=False)
        array = self._counted(lambda: self._new(given.shape, dtype), given.shape, dtype)
        wp.copy(array, given)
        return array

    def _new(self, shape: int | tuple[int, ...], dtype: Any) -> wp.array:
        size = _size(shape, dtype)
        if self.device.is_cuda or size < SMALLEST:
            return wp.empty(shape, dtype=dtype, device=self.device)
        address = _host_pool.allocate(size)
        return wp.array(ptr=address, shape=shape, dtype=dtype, device=self.device, deleter=_host_pool.deallocate)

    def _counted(self, make, shape, dtype) -> wp.array:
        try:
            array = make()
        except (MemoryError, RuntimeError) as error:
            size = _size(shape, dtype) / 2**20
            raise DeviceError(
                f"out of memory in pass '{self._scope_name()}': {size:.0f} MiB more were asked for on"
                f" {self.device.alias} with {self.live_bytes / 2**20:.0f} MiB in use; lower --set volume.resolution or"
                f" --imageWidth ({error})"
            ) from error
        size, key = array.capacity, id(array)
        self.live_bytes += size
        self.peak_bytes = max(self.peak_bytes, self.live_bytes)
        self._counts[key] = weakref.ref(array, lambda _: self._release(key, size))
        return array

    def hand_over(self, array: wp.array) -> np.ndarray:
        """The values of an array that nothing on the device will use again: on the CPU its own memory, without a copy,
        which from now on is the caller's and no longer counted."""
        if self.device.is_cpu and id(array) in self._counts:
            self._release(id(array), array.capacity)
        return array.numpy()

    def _release(self, key: int, size: int) -> None:
        self.live_bytes -= size
        del self._counts[key]


def _size(shape: int | tuple[int, ...], dtype: Any) -> int:
    """Bytes of an array."""
    elements = shape if isinstance(shape, int) else math.prod(shape)
    return int(elements) * wp.types.type_size_in_bytes(dtype)


def find_device(name: str) -> Any:
    """The Warp device of that name.

    Raises:
        DeviceError: It is not present; the message lists what is.
    """
    level, wp.config.log_level = wp.config.log_level, wp.LOG_WARNING
    try:
        wp.init()
    finally:
        wp.config.log_level = level
    present = [d.alias for d in wp.get_devices()]
    if name == "cuda" and wp.is_cuda_available():
        return wp.get_preferred_device()
    if name not in present:
        raise DeviceError(f"device '{name}' is not present; present: {', '.join(present)}")
    return wp.get_device(name)

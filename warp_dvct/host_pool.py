"""Host memory for large arrays, kept for the next ones, as a GPU's memory pool keeps it.

Memory that is given back to the system comes from it again as zeroed pages, one page fault for each 4 KiB: a tenth of
a frame's time.
"""

from __future__ import annotations

import threading
from collections import OrderedDict

import numpy as np

SMALLEST = 2**17  # bytes; below, the C library keeps freed memory itself
KEPT_BYTES = 2**29
CLASSES_PER_OCTAVE = 8  # sizes are rounded up to one of these, so that arrays of about one size share their memory


class HostPool:
    """Blocks of host memory. Those that are not in use are kept up to ``most`` bytes, the longest unused leave first.

    Threads may share it. Blocks are freed by whichever thread drops an array, and even within another call.
    """

    def __init__(self, most: int = KEPT_BYTES) -> None:
        self.most = most
        self.kept_bytes = 0
        self._used: dict[int, np.ndarray] = {}  # by address
        self._kept: OrderedDict[int, np.ndarray] = OrderedDict()  # by address, the longest unused first
        self._by_size: dict[int, list[int]] = {}  # addresses of kept blocks
        self._lock = threading.RLock()

    def allocate(self, size: int) -> int:
        """The address of a block of at least ``size`` bytes, whose content is arbitrary.

        Raises:
            MemoryError: The system has none left, even without what was kept.
        """
        size = rounded(size)
        with self._lock:
            addresses = self._by_size.get(size)
            if addresses:
                address = addresses.pop()  # the last one used, which caches hold
                block = self._kept.pop(address)
                self.kept_bytes -= size
            else:
                block = self._new(size)
                address = block.ctypes.data
            self._used[address] = block
            return address

    def deallocate(self, address: int, size: int) -> None:
        """Take back the block at an address that :meth:`allocate` gave for ``size`` bytes."""
        with self._lock:
            block = self._used.pop(address)
            if block.nbytes > self.most:
                return
            self._kept[address] = block
            self._by_size.setdefault(block.nbytes, []).append(address)
            self.kept_bytes += block.nbytes
            self._shrink(self.most)

    def release(self) -> None:
        """Give all memory that is not in use back to the system."""
        with self._lock:
            self._shrink(0)

    def _new(self, size: int) -> np.ndarray:
        # NumPy asks for huge pages where a block is large, which leaves few faults even the first time.
        try:
            return np.empty(size, np.uint8)
        except MemoryError:
            self._shrink(0)
            return np.empty(size, np.uint8)

    def _shrink(self, most: int) -> None:
        while self.kept_bytes > most:
            address, block = self._kept.popitem(last=False)
            self._by_size[block.nbytes].remove(address)
            self.kept_bytes -= block.nbytes


def rounded(size: int) -> int:
    """``size`` rounded up to one of ``CLASSES_PER_OCTAVE`` sizes between any power of two and the next."""
    step = max(1, (1 << (max(size, 1) - 1).bit_length()) // (2 * CLASSES_PER_OCTAVE))
    return -(-size // step) * step

"""Pictures that cannot be held are refused by the number of their pixels and by the memory that is there."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from warp_dvct import usd_scenes
from warp_dvct.errors import DeviceError, OptionError
from warp_dvct.memory import MAX_PIXELS, require_countable, require_memory
from warp_dvct.relighter import METHODS, Relighter


@pytest.mark.parametrize(("width", "height"), [(0, 5), (5, -1), (2**14 + 1, 2**14), (10**8, 10**8)])
def test_sizes_that_no_picture_has(width, height):
    with pytest.raises(OptionError, match=f"{width} x {height}"):
        require_countable(width, height)


def test_the_largest_picture_can_be_counted():
    require_countable(2**14, MAX_PIXELS // 2**14)


@pytest.mark.parametrize("method", METHODS)
def test_a_picture_larger_than_the_memory_is_refused(method):
    """By the plan's own estimate of what its pixels take; a GPU's memory counts on a GPU."""
    plan = Relighter(usd_scenes.path("room_area"), method=method, width=1024, height=576).plan
    gpu = SimpleNamespace(is_cuda=True, alias="cuda:0", total_memory=2**30)
    require_memory(plan, gpu)
    small = SimpleNamespace(is_cuda=True, alias="cuda:0", total_memory=2**25)
    with pytest.raises(DeviceError, match=r"1024 x 576 pixels needs 0\.1 GiB, and cuda:0 has 0\.0; lower --imageWidth"):
        require_memory(plan, small)

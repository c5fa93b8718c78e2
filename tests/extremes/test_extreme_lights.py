"""Lights in awkward places and of extreme strength."""

from __future__ import annotations

import lit_scenes as lit
import pytest
from extreme_scenes import lamp, moved, numbers, room


@pytest.mark.parametrize("degrees", [0.0, 33.0])
@pytest.mark.parametrize("method", ["rays", "cones", "vpl-rays"])
def test_a_lamp_in_the_plane_of_the_ceiling_lights_the_room(method, degrees):
    """As a lamp a millimetre below it does: within 5 % in the mean, which is what coarse voxels leave uncertain."""
    in_plane, below = (
        numbers(moved(room(lights=(lamp(position=(0.5, y, 0.5)),)), turn=lit.turned(degrees)), method)
        for y in (0.9, 0.899)
    )
    assert in_plane.picture.mean() == pytest.approx(below.picture.mean(), rel=0.05)
    assert in_plane.picture.mean() > 0.09  # with direct light alone it is 0.066

"""Geometry at the extremes: faces on top of each other, slivers, objects of every size, cameras in odd places."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest
from extreme_scenes import numbers, room

from warp_dvct.frame import share_beyond
from warp_dvct.scene import Role


VPLS = {"vpls__count": 256, "vpls__further": 256}


def rug(height: float, material: int = 0):
    """A synthetic sheet on the floor, of the floor's own material unless said otherwise."""
    return lit.mesh(lit.rectangle((0.5, 0.1 + height, 0.5), (0.35, 0, 0), (0, 0, -0.35)), Role.SYNTHETIC, material)


@pytest.mark.parametrize("height", [0.0, 1e-6, 1e-3])
@pytest.mark.parametrize("method", ["rays", "cones"])
def test_a_rug_like_its_floor_changes_no_indirect_light(method, height):
    """It lies in the floor's voxels: the light that met the floor now meets the rug, and the walls see no difference.

    Counted over both surfaces it was half as bright. Walls alone are compared: 1 % of what is before.
    """
    seen = numbers(room(rug(height)), method, bounces=1)
    walls = (seen.layers.normal[..., 1] < 0.5) & (seen.layers.mask_real == 1.0)
    assert walls.mean() > 0.3
    assert np.abs(seen.delta[walls]).mean() < 0.01 * seen.before[walls].mean()


@pytest.mark.parametrize("radius", [1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("method", ["rays", "cones", "vpl-rays", "path"])
def test_a_small_object_leaves_the_rooms_light_as_it_is(method, radius):
    """The volumes follow the object in size, but never so far that the walls are left out: 7 % of the picture."""
    usual = numbers(room(), "path", samples=64)
    speck = lit.mesh(lit.ball((0.5, 0.1 + radius, 0.5), radius, rings=8), Role.SYNTHETIC, 0)
    seen = numbers(room(speck), method, volume__resolution=64, volume__coarse=64, rsm__texels=192, **VPLS)
    assert seen.before.mean() == pytest.approx(usual.before.mean(), rel=0.07)


def test_share_of_directions_beyond_a_cube():
    """Of a closed room all; of the half space below a ground the part under which its far side is seen; of none, 0."""
    center = np.array([0.5, 0.5, 0.5])
    closed = lit.scene_of(lit.mesh(lit.room(0.4)))
    assert share_beyond(closed, center, 0.39) == pytest.approx(1.0, abs=1e-6)
    assert share_beyond(closed, center, 0.41) == 0.0
    low = lit.scene_of(lit.mesh(lit.rectangle((0.5, 0.0, 0.5), (1e3, 0, 0), (0, 0, -1e3))))
    # Ground 0.5 below, cut to a square of half edge 8: 1/2 less the square's solid angle over 4 pi.
    square = 4.0 * np.arctan(64.0 / (0.5 * np.sqrt(2 * 64.0 + 0.25))) / (4.0 * np.pi)
    assert share_beyond(low, center, 8.0) == pytest.approx(0.5 - square, rel=0.1)

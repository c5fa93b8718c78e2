"""Geometry at the extremes: faces on top of each other, slivers, objects of every size, cameras in odd places."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest
from extreme_scenes import numbers, room

from warp_dvct.scene import Role


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

"""Extremes that the other files show for some methods, for the rest of them."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest
from extreme_scenes import ball, numbers, room

from warp_dvct.scene import Role


@pytest.mark.parametrize("method", ["cones", "vpl-rays", "path"])
def test_a_million_triangles_in_one_voxel(method):
    """A ball of dust of 2 mm beside the usual ball: the room is lit as with the ball alone, within 5 %; 8 % by VPLs, of
    which a part then goes to the dust."""
    rng = np.random.default_rng(1)
    spots = rng.normal(size=(10**6, 1, 3)) * 5e-4 + np.array([0.5131, 0.313, 0.513])
    dust = lit.mesh(spots + rng.normal(size=(10**6, 3, 3)) * 2e-4, Role.SYNTHETIC, 1)
    crowd, alone = (numbers(room(*objects, ball()), method) for objects in ((dust,), ()))
    tolerance = 0.08 if method == "vpl-rays" else 0.05
    assert crowd.before.mean() == pytest.approx(alone.before.mean(), rel=tolerance)
    assert crowd.picture.mean() == pytest.approx(alone.picture.mean(), rel=tolerance)


@pytest.mark.parametrize("height", [0.0, 1e-6])
@pytest.mark.parametrize("method", ["vpl-rays", "path"])
def test_a_rug_like_its_floor_changes_no_indirect_light(method, height):
    """A synthetic sheet in the floor's plane, or a millionth above: the walls see no difference, to 2 % of what is
    before (VPLs on the floor then lie elsewhere)."""
    rug = lit.mesh(lit.rectangle((0.5, 0.1 + height, 0.5), (0.35, 0, 0), (0, 0, -0.35)), Role.SYNTHETIC, 0)
    seen = numbers(room(rug), method, bounces=1, vpls__count=512, samples=32)
    walls = (seen.layers.normal[..., 1] < 0.5) & (seen.layers.mask_real == 1.0)
    assert walls.mean() > 0.3
    assert np.abs(seen.delta[walls].mean()) < 0.02 * seen.before[walls].mean()


@pytest.fixture(scope="module")
def traced():
    """The room path-traced in a strip of 8192 pixels."""
    return numbers(room(), "path", width=8192, height=2, samples=32).picture


@pytest.mark.parametrize("method", ["rays", "cones", "ism", "vpl-rays"])
def test_a_picture_8192_wide_shows_what_is_there(traced, method):
    """Each third of it is the path tracer's within 15 % in the mean."""
    seen = numbers(room(), method, width=8192, height=2, gather__stride=16, antialias=0).picture
    thirds = [[part.mean() for part in np.array_split(picture, 3, axis=1)] for picture in (seen, traced)]
    np.testing.assert_allclose(thirds[0], thirds[1], rtol=0.15)

"""Objects on the floor of a closed room, under a sky that lights the floor's underside: none of it gets in."""

from __future__ import annotations

import lit_scenes as lit
import pytest

from warp_dvct.relighter import Relighter
from warp_dvct.scene import Light, LightKind, Role


@pytest.mark.parametrize("sunk", [0.0, 0.02])
@pytest.mark.parametrize(("name", "most"), [("ball", 2e-3), ("box", 6e-3)])
def test_no_sky_comes_up_through_the_floor(name, most, sunk):
    """The ball's voxels hold the floor's underside as well: it used to pass for the ball's, 5 to 16 % as bright as the
    sky. What is left with a sunk object is what the sky lights of it below the floor."""
    place = (0.5, 0.22 - sunk, 0.5)
    inserted = lit.ball(place, 0.12) if name == "ball" else lit.cuboid(place, 0.12)
    scene = lit.scene_of(
        lit.mesh(lit.room(0.4)),
        lit.mesh(inserted, Role.SYNTHETIC),
        lights=(Light(LightKind.DOME, (1.0, 1.0, 1.0)),),
        camera=lit.look_at((0.5, 0.5, 0.88), (0.5, 0.2, 0.5), half=0.6, aspect=4 / 3),
    )
    layers = Relighter(scene, width=64, height=48).render()
    assert layers.mask_synthetic.any()
    assert layers.comp.max() <= (most if sunk else 1e-4)

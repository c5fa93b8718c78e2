"""A lamp in the very middle of a closed object, as a bulb in its shade: nothing of its direct light gets out."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest
from extreme_scenes import METHODS, lamp, numbers, room

from warp_dvct.scene import Light, LightKind, Role

MIDDLE = np.array([0.5, 0.4, 0.5])
OBJECTS = {"ball": lit.ball(tuple(MIDDLE), 0.15, rings=12), "box": lit.cuboid(tuple(MIDDLE), 0.12)}


def bulb(kind: str, off: float) -> Light:
    place = tuple(MIDDLE + off * np.array([0.3, 0.5, -0.8]))
    if kind == "rect":
        return lamp(position=place, axis_x=(0.03, 0, 0), axis_y=(0, 0, 0.03))
    if kind == "point":
        return Light(LightKind.POINT, (1.0, 1.0, 1.0), position=place)
    return Light(LightKind.SPHERE, (9.0, 9.0, 9.0), position=place, radius=0.03)


@pytest.mark.parametrize("off", [0.0, 1e-9, 1e-6, 1e-3])
@pytest.mark.parametrize("kind", ["point", "sphere", "rect"])
@pytest.mark.parametrize("name", OBJECTS)
@pytest.mark.parametrize("method", [m for m in METHODS if m != "cones"])
def test_no_direct_light_gets_out(method, name, kind, off):
    """Seen from any point the object's box lies on the way to the lamp, and which side of that way it is on is a matter
    of rounding: a fifth of the pixels used to be lit."""
    seen = numbers(room(lit.mesh(OBJECTS[name], Role.SYNTHETIC, 1), lights=(bulb(kind, off),)), method, bounces=0)
    assert seen.before.mean() > 1e-3
    alone = seen.synthetic[..., 3] == 0.0
    assert np.abs(seen.picture[alone]).max() < 1e-5 * seen.before.max()

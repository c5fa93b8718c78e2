"""Lamps, objects and walls on a lattice, so that middles coincide and axes line up: direct light is the path tracer's.

What parts an object's box from the ways to a lamp is decided by rounding there.
"""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
from extreme_scenes import RED, SHINY, WHITE, lamp, numbers
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_dvct.scene import Light, LightKind, Role, Scene

PLACE = st.tuples(*[st.sampled_from([0.2, 0.35, 0.5, 0.65, 0.8])] * 3)
AXIS = st.sampled_from([tuple(s * e) for e in np.eye(3) for s in (1.0, -1.0)])


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """A box, ball or sheet in a room, and one lamp of any kind but a dome; without a ceiling under parallel light."""
    center, place = draw(PLACE), draw(PLACE)
    shapes = {
        "box": lit.cuboid(center, 0.08),
        "ball": lit.ball(center, 0.1, rings=10),
        "sheet": lit.rectangle(center, (0.1, 0, 0), (0, 0, -0.1)),
    }
    shape = draw(st.sampled_from(list(shapes)))
    kinds = {
        "down": lamp(position=place),
        "across": lamp(position=place, axis_x=(0, 0.1, 0), axis_y=(0, 0, 0.1), direction=(1, 0, 0)),
        "sphere": Light(LightKind.SPHERE, (9.0, 9.0, 9.0), position=place, radius=0.05),
        "point": Light(LightKind.POINT, (1.0, 1.0, 1.0), position=place),
        "distant": Light(
            LightKind.DISTANT, (3.0, 3.0, 3.0), direction=draw(AXIS), angle=draw(st.sampled_from([0, 0.2]))
        ),
    }
    kind = draw(st.sampled_from(list(kinds)))
    walls = lit.room(0.4)
    if kind == "distant":
        walls = walls[walls[..., 1].min(1) < 0.89]
    return lit.scene_of(
        lit.mesh(walls),
        lit.mesh(shapes[shape], Role.SYNTHETIC, 1, double_sided=True),
        lights=(kinds[kind],),
        materials=(WHITE, RED, SHINY),
        camera=lit.look_at((0.51, 0.55, 0.86), (0.5, 0.35, 0.4), half=0.6, aspect=4 / 3),
    )


@settings(max_examples=25, deadline=None, database=None, derandomize=True)
@given(scene=scenes())
def test_direct_light_is_the_path_tracers(scene):
    """What the object changes, and the light before, are off by more than a quarter of the light at no more than 3 % of
    the pixels: edges of shadows and bright spots, whose pixels the path tracer averages."""
    ours = numbers(scene, "rays", bounces=0, shadows__samples=64, shadows__probes=64, antialias=16)
    truth = numbers(scene, "path", bounces=0, samples=256)
    real = truth.synthetic[..., 3] == 0.0
    if not real.any() or truth.before[real].mean() < 1e-6:
        return
    level = truth.before[real].max(-1)
    for one, other in ((ours.delta, truth.delta), (ours.before, truth.before)):
        off = np.abs(one - other)[real].max(-1)
        assert (off > 0.25 * level + 0.02 * level.mean()).mean() < 0.03

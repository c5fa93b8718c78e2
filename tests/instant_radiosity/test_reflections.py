"""Light that reaches a glossy surface over another one (instant radiosity traces the first lobe by rays)."""

from __future__ import annotations

import lit_scenes as lit
import pytest

from warp_dvct.relighter import Relighter
from warp_dvct.scene import Light, LightKind, Material, Role, Scene

FLOOR = Material(base_color=(0.5, 0.5, 0.5), roughness=0.25, metallic=1.0)
CHROME = Material(base_color=(0.9, 0.9, 0.9), roughness=0.15, metallic=1.0)
RADIANCE = 5.0


def lamp_over_chrome() -> Scene:
    """A glossy floor that shows a chrome plate, which shows a lamp far larger than its lobe."""
    floor = lit.mesh(lit.rectangle((0.5, 0, 0), (2, 0, 0), (0, 0, -2)), Role.REAL, 0)
    plate = lit.mesh(lit.rectangle((1, 0.6, 0), (0, 0, -0.5), (0, 0.5, 0))[:, ::-1], Role.SYNTHETIC, 1)
    lamp = Light(LightKind.RECT, (RADIANCE,) * 3, (-1, 2.5, 0), (0, 0, 1.5), (0, 1.5, 0), direction=(1, 0, 0))
    camera = lit.look_at((-0.5, 1, 0), (0.5, 0, 0), half=0.05, aspect=4 / 3)
    return lit.scene_of(floor, plate, lights=(lamp,), materials=(FLOOR, CHROME), camera=camera)


def test_a_lamp_in_a_reflection_of_a_reflection_has_no_bright_specks():
    """As bright as the path tracer says within 5 %, and no pixel brighter than the lamp, nor far from the others.

    By samples of the lamp alone, of which one in hundreds met the chrome's lobe, pixels were 20 times the lamp.
    """
    scene = lamp_over_chrome()
    truth, seen = (
        Relighter(scene, method=method, width=32, height=24, settings=settings).render().delta
        for method, settings in (
            ("path-trace", {"samples": 256, "bounces": 1}),
            ("instant-radiosity", {"bounces": 1, "glossy.rays": 4, "vpls.count": 16, "visibility": "ray"}),
        )
    )
    assert seen.mean() == pytest.approx(truth.mean(), rel=0.05)
    assert seen.max() < RADIANCE
    assert seen.mean(-1).std() < 0.3 * truth.mean()

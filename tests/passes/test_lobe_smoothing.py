"""Reflections averaged over neighbouring pixels: less noise where a lobe blurs, nothing where it does not."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct.relighter import Relighter
from warp_dvct.scene import Light, LightKind, Material, Role, Scene


def box_on_metal(roughness: float) -> Scene:
    """A bright box that stands on a metal floor, lit by a lamp in front of it."""
    floor = lit.mesh(lit.rectangle((0, 0, 0), (3, 0, 0), (0, 0, -3)), Role.REAL, 0)
    box = lit.mesh(lit.cuboid((0, 0.4, -0.3), (0.4, 0.4, 0.2), 20.0), Role.SYNTHETIC, 1)
    lamp = Light(
        LightKind.RECT, (20.0, 18.0, 15.0), (0, 1.5, 2.5), (0.5, 0, 0), (0, 0.4, 0.3), direction=(0, -0.6, -0.8)
    )
    materials = (
        Material(base_color=(0.8, 0.8, 0.8), roughness=roughness, metallic=1.0),
        Material(base_color=(0.8, 0.3, 0.2), ior=1.0),
    )
    camera = lit.look_at((0, 1.2, 2.4), (0, 0.15, 0), half=0.35, aspect=4 / 3)
    return lit.scene_of(floor, box, lights=(lamp,), materials=materials, camera=camera)


def change(scene: Scene, **settings) -> np.ndarray:
    values = {"bounces": 1, "antialias": 0, **{k.replace("__", "."): v for k, v in settings.items()}}
    layers = Relighter(scene, width=128, height=96, settings=values).render()
    return np.where(layers.mask_real[..., None] == 1.0, layers.delta.astype(float), 0.0)


def test_a_rough_reflection_has_less_noise_and_keeps_its_light():
    """Beside one of many rays: the root mean square error falls to less than half, the mean is within a percent."""
    scene = box_on_metal(0.45)
    many = change(scene, glossy__rays=512, glossy__smoothing=0)
    plain, smooth = (change(scene, glossy__rays=4, glossy__smoothing=s) for s in (0.0, 0.4))
    noise = [np.sqrt(((image - many) ** 2).mean()) for image in (plain, smooth)]
    assert noise[1] < 0.4 * noise[0]
    assert smooth.mean() == pytest.approx(many.mean(), rel=0.01)


def test_a_mirror_stays_sharp_to_the_last_bit():
    scene = box_on_metal(0.05)
    np.testing.assert_array_equal(change(scene, glossy__smoothing=0.3), change(scene, glossy__smoothing=0.0))

"""Materials and apertures at the ends of their ranges; many bounces."""

from __future__ import annotations

from dataclasses import replace

import lit_scenes as lit
import numpy as np
import pytest
from extreme_scenes import METHODS, RED, SHINY, WHITE, lamp, numbers, room

from warp_dvct.scene import Light, LightKind, Material, Role


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 1.0])
@pytest.mark.parametrize("method", METHODS)
def test_roughness_of_objects_and_of_walls(method, roughness, metallic):
    """Real pixels are within 15 % of the path tracer's mean where the objects are extreme. Walls as smooth as mirrors
    focus light, which only the path tracer follows: there the picture is within 50 %."""
    extreme = Material(base_color=(0.9, 0.8, 0.7), roughness=roughness, metallic=metallic)
    for materials, tolerance in (((WHITE, RED, extreme), 0.15), ((extreme, RED, SHINY), 0.5)):
        truth = numbers(room(materials=materials), "path", samples=48)
        seen = numbers(room(materials=materials), method)
        assert seen.picture.mean() == pytest.approx(truth.picture.mean(), rel=tolerance)


@pytest.mark.parametrize("ior", [1.0, 3.0])
@pytest.mark.parametrize("method", METHODS)
def test_index_of_refraction(method, ior):
    """1 reflects nothing, 3 a quarter head on: within 10 % of the path tracer's mean."""
    materials = (Material(base_color=(0.7, 0.7, 0.7), ior=ior, roughness=0.4), RED, Material(ior=ior, roughness=0.2))
    truth = numbers(room(materials=materials), "path", samples=48)
    assert numbers(room(materials=materials), method).picture.mean() == pytest.approx(truth.picture.mean(), rel=0.1)


@pytest.mark.parametrize("ior", [1.0, 3.0])
@pytest.mark.parametrize("roughness", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("method", METHODS)
def test_nothing_reflects_more_than_it_gets(method, roughness, ior):
    """A ball of albedo 1 in a white furnace: no brighter than the furnace (2 %, for Schlick's lobes and 16 samples)."""
    furnace = Light(LightKind.DOME, (1.0, 1.0, 1.0))
    white = Material(base_color=(1.0, 1.0, 1.0), roughness=roughness, ior=ior)
    object_ = lit.mesh(lit.ball((0.5, 0.5, 0.5), 0.2, rings=16), Role.SYNTHETIC, 0)
    camera = lit.look_at((0.5, 0.5, 1.5), (0.5, 0.5, 0.5), half=0.3, aspect=4 / 3)
    scene = lit.scene_of(object_, lights=(furnace,), materials=(white,), camera=camera)
    seen = numbers(scene, method, **{"vpls.sky": 512, "samples": 64})
    inside = seen.synthetic[..., 3] == 1.0
    assert inside.sum() > 50
    assert seen.synthetic[inside][:, :3].mean() < 1.02


@pytest.mark.parametrize("method", METHODS)
def test_black_surfaces_are_black(method):
    black = (Material(base_color=(0.0, 0.0, 0.0), ior=1.0),) * 3
    assert (numbers(room(materials=black), method, bounces=50).picture == 0.0).all()


@pytest.mark.parametrize("method", METHODS)
def test_fifty_bounces_between_grey_walls_converge(method):
    """Albedo 0.7: what the 51st to the 64th bounce add is below 1e-3 of the picture, and every method's sum stays below
    the truth's by no more than 15 % (20 % with VPLs, which are too dark in corners) and above by no more than 5 %."""
    grey = (Material(base_color=(0.7, 0.7, 0.7), ior=1.0),) * 3
    truth = numbers(room(materials=grey), "path", bounces=50, samples=48).picture.mean()
    fifty, more = (numbers(room(materials=grey), method, bounces=n).picture.mean() for n in (50, 64))
    assert abs(more - fifty) < (1e-2 if method in ("ism", "vpl-rays") else 1e-3) * fifty
    assert (0.8 if method in ("ism", "vpl-rays") else 0.85) * truth < fifty < 1.05 * truth


@pytest.mark.parametrize("method", METHODS)
def test_energy_never_grows_between_white_walls(method):
    """Albedo 1 in a closed room, the worst there is: n bounces hold no more than n + 1 times what the lamp sends."""
    white = (Material(base_color=(1.0, 1.0, 1.0), ior=1.0),) * 3
    power = np.pi * 0.2 * 0.2 * np.mean(lamp().radiance)
    each = power / (6 * 0.8 * 0.8) / np.pi  # radiance of walls that reflect all of it, once
    last = 0.0
    for bounces in (1, 5, 20, 50):
        mean = numbers(room(materials=white), method, bounces=bounces, **{"volume.resolution": 96}).before.mean()
        assert last < mean < 1.2 * (bounces + 1) * each
        last = mean


@pytest.mark.parametrize("method", ["rays", "cones"])
def test_white_walls_lose_nothing(method):
    """Albedo 1 in a closed room with objects in it: each of the 21st to the 50th bounce brings what each of the 6th to
    the 20th does, to 3 %. Patches under and in objects, which stood for the floor around them, took 1 % every time."""
    white = (Material(base_color=(1.0, 1.0, 1.0), ior=1.0),) * 3
    some, more, most = (numbers(room(materials=white), method, bounces=n).picture.mean() for n in (5, 20, 50))
    assert (most - more) / 30 == pytest.approx((more - some) / 15, rel=0.03)


@pytest.mark.parametrize("aperture", [0.1, 1.0, 60.0, 179.0])
def test_apertures_of_diffuse_cones(aperture):
    """From needles to half spaces: within 15 % of the aperture that fits the count."""
    usual, other = (numbers(room(), "cones", **{"cones.aperture": a}).picture.mean() for a in (0.0, aperture))
    assert other == pytest.approx(usual, rel=0.15)


@pytest.mark.parametrize("radius", [1e-9, 0.05, 0.3])
def test_apertures_of_shadow_cones(radius):
    """A lamp from a point to as large as the room: shadow cones leave what shadow rays leave, within 15 %."""
    light = Light(LightKind.SPHERE, (1.0 / radius**2,) * 3, position=(0.5, 0.6, 0.5), radius=radius)
    rays, cones = (
        numbers(room(lights=(light,)), "rays", bounces=0, shadows=s, **{"volume.resolution": 96})
        for s in ("ray", "cone")
    )
    assert cones.picture.mean() == pytest.approx(rays.picture.mean(), rel=0.15)


def test_material_without_any_lobe_is_black():
    """Specular colour 0 and base colour 0: nothing divides by the lobes' sum."""
    none = replace(WHITE, base_color=(0.0, 0.0, 0.0), specular_color=(0.0, 0.0, 0.0))
    for method in METHODS:
        assert (numbers(room(materials=(WHITE, RED, none)), method).synthetic[..., :3].min()) >= 0.0

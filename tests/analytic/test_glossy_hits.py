"""What glossy surfaces send onto others, against the path tracer: it goes where the lobe points, and none is made."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct.methods.path_tracing import gather_irradiance_reference
from warp_dvct.passes.gather import Gatherer, gather_all, glossy_hits
from warp_dvct.passes.injection import empty_flux, inject
from warp_dvct.passes.patches import bounce_field
from warp_dvct.passes.rsm import render_rsm
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Light, LightKind, Material, Role, Scene

COUNT = 240


def glossy_room(roughness: float) -> Scene:
    """A lamp above a floor that mostly reflects, a back wall that it shines on, and an object in the way."""
    floor = lit.rectangle((0.5, 0.2, 0.5), (0.4, 0, 0), (0, 0, -0.4))
    wall = lit.rectangle((0.5, 0.5, 0.15), (0.35, 0, 0), (0, 0.3, 0))
    lamp = Light(
        LightKind.RECT,
        (30.0, 30.0, 30.0),
        position=(0.5, 0.75, 0.8),
        axis_x=(0.06, 0, 0),
        axis_y=(0, 0.04, -0.04),
        direction=(0, -np.sqrt(0.5), -np.sqrt(0.5)),
    )
    materials = [
        Material((0.1, 0.1, 0.1), roughness=roughness, specular_color=(0.5, 0.4, 0.3)),
        Material((0.6, 0.6, 0.6), ior=1.0),
    ]
    box = lit.mesh(lit.cuboid((0.62, 0.27, 0.5), (0.05, 0.06, 0.05), 20.0), Role.SYNTHETIC, 1)
    return lit.scene_of(
        lit.mesh(floor, material=0), lit.mesh(wall, material=1), box, lights=(lamp,), materials=materials
    )


def irradiance(launcher, scene, roughness_hits: bool, positions, normals):
    def flux_of(device_scene, voxels):
        maps = render_rsm(launcher, device_scene, 0, 384, center=(0.5, 0.5, 0.5), radius=0.87, start=3.0)
        flux = empty_flux(launcher, voxels)
        inject(launcher, voxels, maps, flux)
        return flux

    world = lit.lit_world(launcher, scene, 96, flux_of)
    hits = glossy_hits(launcher, scene, world.device_scene, bounce_field(launcher, None), 0) if roughness_hits else None
    points = lit.points_at(launcher, positions, normals)
    gatherer = Gatherer(world.device_scene, world.world, 1024, 3, hits=hits)
    return [a.numpy()[: len(positions)].astype(float) for a in gather_all(launcher, points, len(positions), gatherer)]


@pytest.mark.parametrize(("roughness", "most", "evenly"), [(0.2, 0.25, 0.35), (0.4, 0.05, 0.35)])
def test_a_glossy_floor_lights_the_wall_that_its_lobe_points_at(launcher, roughness, most, evenly):
    """Before and after, RMS over the wall's mean: what widening a narrow lobe costs, and what it costs to spread the
    light evenly, as if the floor were matt. The mean stays."""
    scene = glossy_room(roughness)
    rng = np.random.default_rng(5)
    positions = np.stack([0.2 + 0.6 * rng.random(COUNT), 0.22 + 0.5 * rng.random(COUNT), np.full(COUNT, 0.15)], -1)
    normals = np.broadcast_to([0.0, 0.0, 1.0], (COUNT, 3))
    device_scene = lit.upload(launcher, scene)
    truth = gather_irradiance_reference(launcher, device_scene, scene, positions, normals, samples=4096)
    right = irradiance(launcher, scene, True, positions, normals)
    even = irradiance(launcher, scene, False, positions, normals)
    for got, spread, expected in zip(right, even, truth, strict=True):
        mean = expected.mean()
        np.testing.assert_allclose(got.mean(0), expected.mean(0), rtol=0.06)
        assert np.sqrt(((got - expected) ** 2).mean()) / mean < most
        assert np.sqrt(((spread - expected) ** 2).mean()) / mean > evenly


def test_matt_scenes_need_none_of_it(launcher):
    assert glossy_hits(launcher, glossy_room(0.9), lit.upload(launcher, glossy_room(0.9)), None, 0) is None


@pytest.mark.parametrize(("method", "roughness"), [("delta-cones", 1.0), ("instant-radiosity", 0.25)])
def test_a_synthetic_mirror_shows_no_lamp_through_a_real_wall(method, roughness):
    """A chrome plate beside a floor, and the only lamp behind a wall: what floors gather, or reflect, of the plate used
    to hold the lamp's highlight, since only objects were asked whether they hide it."""
    floor = lit.mesh(lit.rectangle((0.5, 0, 0), (2, 0, 0), (0, 0, -2)), Role.REAL, 0)
    wall = lit.mesh(lit.rectangle((-0.9, 3, 0), (0, 0, -6), (0, 6, 0)), Role.REAL, 0)
    plate = lit.mesh(lit.rectangle((1, 0.6, 0), (0, 0, -0.5), (0, 0.5, 0))[:, ::-1], Role.SYNTHETIC, 1)
    lamp = Light(LightKind.RECT, (5.0, 5.0, 5.0), (-1, 2.5, 0), (0, 0, 1.5), (0, 1.5, 0), direction=(1, 0, 0))
    materials = (
        Material(base_color=(0.5, 0.5, 0.5), roughness=roughness, metallic=float(roughness < 1.0)),
        Material(base_color=(0.9, 0.9, 0.9), roughness=0.15, metallic=1.0),
    )
    camera = lit.look_at((-0.5, 1, 0), (0.5, 0, 0), half=0.4, aspect=4 / 3)
    scene = lit.scene_of(floor, wall, plate, lights=(lamp,), materials=materials, camera=camera)
    seen = Relighter(scene, method=method, width=32, height=24, settings={"bounces": 1, "visibility": "ray"}).render()
    assert seen.mask_synthetic.any()
    assert not seen.plate.any()
    assert not seen.comp.any()


def test_a_blurred_reflection_of_a_glossy_floor_is_not_that_of_a_matt_one():
    """A metal card over a metal floor that a spot lights from above: hardly any of that light goes to the card. Rays of
    lobes wide enough to read voxels took the floor's radiosity for it, which shines to all sides."""
    floor = lit.mesh(lit.rectangle((0, 0, 0), (3, 0, 0), (0, 0, -3)), Role.REAL, 0)
    card = lit.mesh(lit.rectangle((0, 0.7, 0), (0.4, 0, 0), (0, 0.3, 0)), Role.SYNTHETIC, 1)
    spot = Light(LightKind.POINT, (30.0, 30.0, 30.0), (0, 4, 1.0), direction=(0, -1, 0), cone_angle=0.5)
    materials = (
        Material(base_color=(0.8, 0.8, 0.8), roughness=0.25, metallic=1.0),
        Material(base_color=(0.9, 0.9, 0.9), roughness=0.35, metallic=1.0),
    )
    camera = lit.look_at((0, 0.7, 2.5), (0, 0.7, 0), half=0.15, aspect=4 / 3)
    scene = lit.scene_of(floor, card, lights=(spot,), materials=materials, camera=camera)
    truth, seen = (
        Relighter(scene, method=method, width=32, height=24, settings={"bounces": 1, **settings}).render()
        for method, settings in (("path-trace", {"samples": 512}), ("delta-cones", {"glossy.rays": 64}))
    )
    whole = truth.mask_synthetic == 1.0
    assert seen.comp[whole].mean() == pytest.approx(truth.comp[whole].mean(), rel=0.1)

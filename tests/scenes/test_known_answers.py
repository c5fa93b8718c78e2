"""The answers that ``usd_scenes/README.md`` calls known, measured on the stages themselves."""

from dataclasses import replace
from math import atan, pi, radians, sin, sqrt

import numpy as np
import pytest

from warp_dvct import usd_scenes
from warp_dvct.device_scene import DeviceScene
from warp_dvct.methods.path_tracing import path_trace
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Camera, LightKind, Role
from warp_dvct.usd.read import read_stage

WIDTH, HEIGHT = 64, 36


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def trace(launcher, scene, width=WIDTH, height=HEIGHT, samples=16, bounces=0):
    low, high = scene.bounds()
    device_scene = DeviceScene.upload(launcher, scene, (low + high) / 2, 1 / (high - low).max())
    return path_trace(launcher, device_scene, scene, width, height, samples=samples, bounces=bounces)


def picture(array, channels=3):
    return array.numpy().reshape(HEIGHT, WIDTH, channels)


def looking_down_at(x, z, height, size=1e-3):
    """A camera above (x, z) that sees a square of about ``size`` times ``height`` of the floor."""
    to_world = np.eye(4)
    to_world[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    to_world[:3, 3] = (x, height, z)
    return Camera(to_world, -size, size, -size, size)


def real_only(scene):
    return replace(scene, meshes=tuple(m for m in scene.meshes if m.role == Role.REAL))


def test_room_area_direct_light_below_the_lamp(launcher):
    scene = real_only(read_stage(usd_scenes.path("room_area")))
    scene = replace(scene, camera=looking_down_at(0.0, 0.1, 0.5))
    before = trace(launcher, scene, 8, 8, samples=256).before.numpy().mean(0)
    a = 0.45 / 2.19
    irradiance = 4 * 13 * a / sqrt(1 + a * a) * atan(a / sqrt(1 + a * a))
    np.testing.assert_allclose(before, 0.73 / pi * irradiance, rtol=0.01)


def test_room_spot_lights_nothing_outside_of_its_cone(launcher):
    scene = read_stage(usd_scenes.path("room_spot"))
    result = trace(launcher, real_only(scene))
    before, position = picture(result.before), picture(result.position)
    upper_wall = (np.abs(position[..., 2] + 1.8) < 1e-3) & (position[..., 1] > 1.25)
    assert upper_wall.sum() > 100
    assert before[upper_wall].max() == 0
    assert before.max() > 0.4


def test_room_glossy_mirrors_the_crate_in_the_floor(launcher):
    """The floor in front of the crate becomes bluer than it becomes red when the crate is inserted."""
    scene = read_stage(usd_scenes.path("room_glossy"))
    result = trace(launcher, scene, samples=64, bounces=1)
    position, delta = picture(result.position), picture(result.delta)
    coverage = picture(result.synthetic, 4)[..., 3]
    floor = (np.abs(position[..., 1]) < 1e-3) & (coverage == 0)
    near = floor & (np.abs(position[..., 0] + 0.25) < 0.15) & (position[..., 2] > -0.2) & (position[..., 2] < 0.1)
    assert near.sum() >= 5
    change = delta[near].mean(0)
    assert change[2] > change[0] + 0.01


def test_ground_dome_sun(launcher):
    scene = read_stage(usd_scenes.path("ground_dome"))
    sun = next(light for light in scene.lights if light.kind == LightKind.DISTANT)
    grey = replace(scene.materials[0], base_color=(0.5,) * 3, base_color_texture=None, specular_color=(0, 0, 0))
    ground = next(m for m in scene.meshes if m.path.endswith("Ground"))
    ground = replace(ground, materials=np.zeros_like(ground.materials))
    scene = replace(scene, meshes=(ground,), materials=(grey,), lights=(sun,), camera=looking_down_at(3, 3, 2))
    before = trace(launcher, scene, 8, 8).before.numpy().mean(0)
    irradiance = 13500 * pi * sin(radians(0.5)) ** 2 * sin(radians(42))
    np.testing.assert_allclose(before, 0.5 / pi * irradiance * np.array([1, 0.93, 0.82]), rtol=0.005)


def test_ground_dome_sky_is_brightest_towards_the_sun():
    """The texture's azimuth and the light's direction agree: both come from the same side."""
    scene = read_stage(usd_scenes.path("ground_dome"))
    sun = next(light for light in scene.lights if light.kind == LightKind.DISTANT)
    sky = next(light for light in scene.lights if light.kind == LightKind.DOME)
    height, width = sky.texture.shape[:2]
    brightest = sky.texture[height // 2 - 2].sum(-1).argmax()
    angle = (0.5 - (brightest + 0.5) / width) * 2 * pi  # from +z towards +x, as UsdLux lays a lat-long out
    to_bright = sky.rotation @ np.array([np.sin(angle), 0, np.cos(angle)])
    to_sun = -np.array(sun.direction) * (1, 0, 1)
    assert to_bright @ to_sun / np.linalg.norm(to_sun) > np.cos(radians(8))


@pytest.mark.parametrize("method", ["path-trace", "delta-cones"])
@pytest.mark.parametrize("bounces", ["0", "2"])
def test_furnace(method, bounces):
    """All is 1, the right part 0.5: the plate, the composite, and no delta on real pixels."""
    settings = {"bounces": bounces, "samples": "64", "volume.resolution": "64", "gather.stride": "1"}
    relighter = Relighter(
        usd_scenes.path("furnace"), method=method, settings=settings, width=WIDTH, height=HEIGHT, threads=2
    )
    layers = relighter.render()
    half = (layers.mask_synthetic == 1) & (np.abs(layers.albedo[..., 0] - 0.5) < 1e-3)
    white = (layers.mask_synthetic == 1) & (np.abs(layers.albedo[..., 0] - 1) < 1e-3)
    clear = layers.mask_synthetic == 0
    assert half.sum() > 200
    assert clear.sum() > 500
    np.testing.assert_allclose(layers.plate, 1, atol=2e-3)
    np.testing.assert_allclose(layers.delta[clear], 0, atol=2e-3)
    np.testing.assert_allclose(layers.comp[clear], 1, atol=2e-3)
    np.testing.assert_allclose(layers.comp[half], 0.5, atol=2e-3)
    np.testing.assert_allclose(layers.comp[white], 1, atol=4e-3)
    assert layers.comp.min() >= 0.5 - 2e-3

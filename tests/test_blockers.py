"""Protects shadow rays that ask only the real triangles which can be in their way: no shadow may be lost by that."""

from dataclasses import replace

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct import blockers
from warp_dvct.bench.motion import same
from warp_dvct.device_scene import DeviceScene
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Light, LightKind, LightRole, Material, Role

BULB = Light(LightKind.SPHERE, (20.0, 20.0, 30.0), position=(0.2, 0.6, 0.7), radius=0.03, path="/World/Bulb")
SUN = Light(LightKind.DISTANT, (3.0, 3.0, 2.5), direction=(0.3, -1.0, 0.2), angle=0.02, path="/World/Sun")
ROOM = 12  # triangles, the first of every scene; on the planes 0.05 and 0.95
FLOOR_Y, SHELF = 0.05, lit.cuboid((0.3, 0.15, 0.3), 0.1)
SETTINGS = {
    "volume.resolution": 32,
    "volume.coarse": 16,
    "gather.rays": 16,
    "gather.object_rays": 16,
    "patches.count": 200,
    "patches.rays": 16,
    "shadows.samples": 4,
    "glossy.rays": 2,
}


def scene(*lights, center=(0.6, 0.2, 0.5), shell=None, materials=(lit.GREY,)):
    shell = lit.room(0.45) if shell is None else shell
    meshes = lit.mesh(shell), lit.mesh(SHELF), lit.mesh(lit.cuboid(center, 0.08, 20.0), Role.SYNTHETIC)
    return lit.scene_of(*meshes, lights=lights, materials=materials)


def left_out(launcher, made) -> np.ndarray:
    """Indices of the room's triangles that shadow rays do not ask."""
    uploaded = DeviceScene.upload(launcher, made, np.zeros(3), 1.0)
    asked = uploaded.blockers.points.numpy().reshape(-1, 9)
    real = uploaded.real.points.numpy().reshape(-1, 9)
    out = np.flatnonzero(~(real[:, None] == asked[None]).all(-1).any(1))
    return out[out < ROOM]


def heights(indices) -> set[float]:
    """On which horizontal planes the room's triangles lie."""
    levels = lit.room(0.45)[indices][..., 1]
    return {round(float(level[0]), 3) for level in levels if np.ptp(level) < 1e-9}


def test_walls_hide_nothing_from_lights_in_the_room(launcher):
    np.testing.assert_array_equal(left_out(launcher, scene(lit.LAMP, BULB)), np.arange(ROOM))


def test_a_lamp_beyond_the_ceiling_is_hidden_by_it(launcher):
    outside = replace(lit.LAMP, position=(0.5, 0.97, 0.5))
    out = left_out(launcher, scene(outside, BULB))
    assert len(out) == ROOM - 2
    assert heights(out) == {FLOOR_Y}


def test_the_sun_is_hidden_by_walls_and_ceiling_but_not_by_the_floor(launcher):
    out = left_out(launcher, scene(replace(SUN, direction=(0.0, -1.0, 0.0))))
    assert heights(out) == set(), "the floor alone is not a quarter of the surface"
    shell = lit.rectangle((0.5, FLOOR_Y, 0.5), (0.0, 0.0, 2.0), (2.0, 0.0, 0.0))
    assert {0, 1} <= set(left_out(launcher, scene(SUN, shell=shell)))
    from_below = replace(SUN, direction=(0.3, 1.0, 0.2))
    assert len(left_out(launcher, scene(from_below, shell=shell))) == 0


def test_an_object_that_stands_out_of_the_floor_keeps_it(launcher):
    out = left_out(launcher, scene(lit.LAMP, center=(0.6, 0.12, 0.5)))
    assert heights(out) == {0.95}


def test_lights_as_large_as_the_room_keep_its_walls(launcher):
    out = left_out(launcher, scene(replace(BULB, radius=0.9)))
    assert len(out) == 0


def outdoors(*lights):
    return scene(*lights, shell=lit.rectangle((0.5, FLOOR_Y, 0.5), (0.0, 0.0, 2.0), (2.0, 0.0, 0.0)))


def from_outside(*lights):
    """A room whose walls show both sides, seen through none of them: the camera is beside it."""
    made = scene(*lights)
    both = tuple(replace(mesh, double_sided=True) for mesh in made.meshes)
    return replace(made, meshes=both, camera=lit.look_at((1.6, 1.4, 1.8), lit.CENTER))


SHINY = Material(base_color=(0.6, 0.5, 0.4), roughness=0.3, metallic=1.0)
SCENES = {
    "room": scene(lit.LAMP, replace(BULB, role=LightRole.ADDED)),
    "glossy room": scene(lit.LAMP, BULB, materials=(SHINY,)),
    "ground": outdoors(SUN, BULB),
    "room from outside": from_outside(lit.LAMP, BULB),
    "lamp in the ceiling's plane": scene(replace(lit.LAMP, position=(0.5, 0.95, 0.5))),
}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("plated", [False, True], ids=["rendered", "plate"])
def test_pictures_are_the_same_where_all_triangles_are_asked(monkeypatch, name, plated):
    plate = np.full((60, 80, 3), 0.4, np.float32) if plated else None
    options = {"settings": SETTINGS, "width": 80, "height": 60, "threads": 2}
    few = Relighter(SCENES[name], **options)
    frame = few.render(plate)
    assert few._uploaded[1].blockers is not few._uploaded[1].real
    monkeypatch.setattr(blockers, "LEAST_SHARE", 2.0)
    every = Relighter(SCENES[name], **options)
    assert same(frame, every.render(plate))
    assert every._uploaded[1].blockers is every._uploaded[1].real


def test_a_shot_keeps_them_until_an_object_leaves_the_room():
    options = {"settings": SETTINGS, "width": 32, "height": 24, "threads": 2}
    moving = Relighter(scene(lit.LAMP), **options)
    moving.render()
    kept = []
    for y in (0.21, 0.12):
        moving.set_scene(scene(lit.LAMP, center=(0.6, y, 0.5)))
        moving.render()
        kept.append(moving.stats["kept"]["blockers"])
    assert kept == [True, False]

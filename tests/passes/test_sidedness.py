"""Protects rooms that were modelled as boxes facing outwards, and closed objects from needless back faces."""

from dataclasses import replace

import numpy as np

from warp_dvct.device_scene import DeviceScene
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Camera, Light, LightKind, Material, Mesh, Role, Scene

LAMBERT = Material(base_color=(0.6, 0.6, 0.6), ior=1.0)


def box(low, high, role, *, inward=False, path="/Box") -> Mesh:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    points = np.asarray(low) + corners * (np.asarray(high) - np.asarray(low))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    if inward:
        triangles = triangles[:, ::-1]
    return Mesh(points, np.ascontiguousarray(triangles), np.zeros(12, np.int32), role, path=path)


def room(inward: bool) -> Scene:
    light = Light(LightKind.SPHERE, (20.0, 20.0, 20.0), position=(1.0, 1.7, 1.0), radius=0.1, path="/Light")
    to_world = np.eye(4)
    to_world[:3, 3] = (1.0, 1.0, 1.9)
    return Scene(
        (
            box((0, 0, 0), (2, 2, 2), Role.REAL, inward=inward, path="/Room"),
            box((0.7, 0, 0.5), (1.1, 0.5, 0.9), Role.SYNTHETIC, path="/Object"),
        ),
        (LAMBERT,),
        (),
        (light,),
        Camera(to_world, -0.8, 0.8, -0.8, 0.8),
    )


def test_a_room_seen_from_its_back_shows_both_sides(launcher):
    outward = DeviceScene.upload(launcher, room(False), np.zeros(3), 1.0)
    inward = DeviceScene.upload(launcher, room(True), np.zeros(3), 1.0)
    assert np.all(outward.double_sided[:12] == 1)
    assert np.all(inward.double_sided[:12] == 0)
    assert np.all(outward.double_sided[12:] == 0), "the closed object is met from its front alone"


def test_indirect_light_does_not_depend_on_which_way_the_room_faces():
    settings = {"volume.resolution": 32, "volume.coarse": 32, "rsm.texels": 128, "gather.rays": 64, "bounces": 3}
    pictures = [
        Relighter(scene, settings=settings, width=24, height=24, threads=2).render().comp
        for scene in (room(True), room(False), replace(room(False)))
    ]
    np.testing.assert_array_equal(pictures[1], pictures[2])
    assert abs(pictures[1].mean() / pictures[0].mean() - 1.0) < 0.02


def test_the_outside_of_a_closed_room_is_not_wanted(launcher):
    """A sky lights the walls from outside, but what those reflect meets nothing."""
    sky = Light(LightKind.DOME, (1.0, 1.0, 1.0), path="/Sky")
    scene = replace(room(True), lights=(sky,))
    assert np.all(DeviceScene.upload(launcher, scene, np.zeros(3), 1.0).double_sided[:12] == 0)
    # A second room around it is lit by them.
    around = box((-3, -3, -3), (5, 5, 5), Role.REAL, inward=True, path="/Around")
    lamp = Light(LightKind.SPHERE, (20.0, 20.0, 20.0), position=(-2.0, 1.0, 1.0), radius=0.1, path="/Light")
    nested = replace(scene, meshes=(*scene.meshes, around), lights=(lamp,))
    assert np.all(DeviceScene.upload(launcher, nested, np.zeros(3), 1.0).double_sided[:12] == 1)

"""Geometry at the extremes: faces on top of each other, slivers, objects of every size, cameras in odd places."""

from __future__ import annotations

from dataclasses import replace

import lit_scenes as lit
import numpy as np
import pytest
from extreme_scenes import METHODS, SHINY, WHITE, ball, crate, lamp, numbers, room

from warp_dvct.frame import share_beyond
from warp_dvct.scene import Role

VPLS = {"vpls__count": 256, "vpls__further": 256}


def rug(height: float, material: int = 0):
    """A synthetic sheet on the floor, of the floor's own material unless said otherwise."""
    return lit.mesh(lit.rectangle((0.5, 0.1 + height, 0.5), (0.35, 0, 0), (0, 0, -0.35)), Role.SYNTHETIC, material)


@pytest.mark.parametrize("height", [0.0, 1e-6, 1e-3])
@pytest.mark.parametrize("method", ["rays", "cones"])
def test_a_rug_like_its_floor_changes_no_indirect_light(method, height):
    """It lies in the floor's voxels: the light that met the floor now meets the rug, and the walls see no difference.

    Counted over both surfaces it was half as bright. Walls alone are compared: 1 % of what is before.
    """
    seen = numbers(room(rug(height)), method, bounces=1)
    walls = (seen.layers.normal[..., 1] < 0.5) & (seen.layers.mask_real == 1.0)
    assert walls.mean() > 0.3
    assert np.abs(seen.delta[walls]).mean() < 0.01 * seen.before[walls].mean()


@pytest.mark.parametrize("method", ["vpl-rays", "ism"])
def test_red_faces_in_the_planes_of_a_rooms_own_change_nothing(method):
    """Real faces have the light of their plane in every bounce: 0.5 % of what is before, which is what maps miss.

    Counted on both the room was a quarter brighter.
    """
    again = lit.mesh(lit.room(0.4), Role.SYNTHETIC, 1)
    seen = numbers(room(again), method, bounces=3, ism__size=64, ism__points=512)
    assert np.abs(seen.delta).mean() < 0.005 * seen.before.mean()


@pytest.mark.parametrize("radius", [1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("method", ["rays", "cones", "vpl-rays", "path"])
def test_a_small_object_leaves_the_rooms_light_as_it_is(method, radius):
    """The volumes follow the object in size, but never so far that the walls are left out.

    7 % of the picture's mean, and 10 % with VPLs, most of which then go to the object's neighbourhood.
    """
    usual = numbers(room(), "path", samples=64)
    speck = lit.mesh(lit.ball((0.5, 0.1 + radius, 0.5), radius, rings=8), Role.SYNTHETIC, 0)
    seen = numbers(room(speck), method, volume__resolution=64, volume__coarse=64, rsm__texels=192, **VPLS)
    assert seen.before.mean() == pytest.approx(usual.before.mean(), rel=0.1 if method == "vpl-rays" else 0.07)


def test_share_of_directions_beyond_a_cube():
    """Of a closed room all; of the half space below a ground the part under which its far side is seen; of none, 0."""
    center = np.array([0.5, 0.5, 0.5])
    closed = lit.scene_of(lit.mesh(lit.room(0.4)))
    assert share_beyond(closed, center, 0.39) == pytest.approx(1.0, abs=1e-6)
    assert share_beyond(closed, center, 0.41) == 0.0
    low = lit.scene_of(lit.mesh(lit.rectangle((0.5, 0.0, 0.5), (1e3, 0, 0), (0, 0, -1e3))))
    # Ground 0.5 below, cut to a square of half edge 8: 1/2 less the square's solid angle over 4 pi.
    square = 4.0 * np.arctan(64.0 / (0.5 * np.sqrt(2 * 64.0 + 0.25))) / (4.0 * np.pi)
    assert share_beyond(low, center, 8.0) == pytest.approx(0.5 - square, rel=0.1)


OBJECTS = {
    "larger than the scene": lit.ball((0.5, 0.5, 0.5), 5.0, rings=12)[:, ::-1],
    "touching the volume's border": lit.cuboid((0.5, 0.5, 0.5), 0.1),
    "sliver of aspect 1e6": np.array([[[0.2, 0.3, 0.4], [0.8, 0.3, 0.4], [0.5, 0.3 + 6e-7, 0.4]]]),
    "triangles without area": np.array([[[0.2, 0.3, 0.4], [0.5, 0.3, 0.4], [0.8, 0.3, 0.4]], [[0.3, 0.3, 0.3]] * 3]),
    "faces of the room again": lit.room(0.4),
    "the room's outside": lit.cuboid((0.5, 0.5, 0.5), 0.4),
}


@pytest.mark.parametrize("name", OBJECTS)
@pytest.mark.parametrize("method", METHODS)
def test_any_object_gives_a_finite_picture_within_its_light(method, name):
    """No launch writes a NaN, an infinity or a negative radiance (``numbers`` checks all); and light is not made up:
    in the mean no more than 1.3 times what is before, which is twice what coarse maps miss by."""
    seen = numbers(room(lit.mesh(OBJECTS[name], Role.SYNTHETIC, 1)), method, **{"volume.scale": 1.0})
    assert seen.picture.mean() < 1.3 * seen.before.mean()
    if name in ("sliver of aspect 1e6", "triangles without area"):
        assert np.abs(seen.delta).mean() < 1e-4 * seen.before.mean()


def test_a_million_triangles_in_one_voxel():
    """A ball of dust of 2 mm beside the usual ball: the room is lit as with the ball alone, within 5 %."""
    rng = np.random.default_rng(1)
    spots = rng.normal(size=(10**6, 1, 3)) * 5e-4 + np.array([0.5131, 0.313, 0.513])
    dust = lit.mesh(spots + rng.normal(size=(10**6, 3, 3)) * 2e-4, Role.SYNTHETIC, 1)
    crowd, alone = (numbers(room(*objects, ball()), "rays") for objects in ((dust,), ()))
    assert crowd.before.mean() == pytest.approx(alone.before.mean(), rel=0.05)
    assert crowd.picture.mean() == pytest.approx(alone.picture.mean(), rel=0.05)


@pytest.mark.parametrize(
    "eye",
    [(0.62, 0.22, 0.42), (0.5, 0.5, 0.9), (0.1, 0.1, 0.1), (0.5, 0.1 + 1e-5, 0.86)],
    ids=["in the ball", "in a wall's plane", "in a corner", "on the floor"],
)
@pytest.mark.parametrize("method", METHODS)
def test_a_camera_anywhere_gives_a_finite_picture(method, eye):
    """No brighter in the mean than twice the usual view of the room."""
    scene = replace(room(), camera=lit.look_at(eye, (0.48, 0.3, 0.41), half=0.5, aspect=4 / 3))
    assert numbers(scene, method).picture.mean() < 0.25
    away = replace(room(), camera=lit.look_at((0.5, 5.0, 0.5), (0.5, 9.0, 0.51), half=0.5, aspect=4 / 3))
    empty = numbers(away, method)
    assert (empty.picture == 0.0).all()
    assert np.isinf(empty.layers.depth).all()


@pytest.mark.parametrize("method", METHODS)
def test_scenes_without_real_or_synthetic_or_any_surface(method):
    """Only real: nothing changes. Only synthetic: nothing is before. Neither: black."""
    camera = room().camera
    real, synthetic, neither = (
        numbers(lit.scene_of(*meshes, lights=(lamp(),), materials=(WHITE, WHITE, SHINY), camera=camera), method)
        for meshes in ((lit.mesh(lit.room(0.4)),), (ball(), crate()), ())
    )
    assert (real.delta == 0.0).all()
    assert real.before.mean() > 0.1
    assert (synthetic.before == 0.0).all()
    assert synthetic.synthetic[..., :3].mean() > 0.0
    assert (neither.picture == 0.0).all()


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 13), (13, 1), (31, 23), (8192, 1)])
@pytest.mark.parametrize("method", METHODS)
def test_pictures_of_any_size(method, width, height):
    """The mean is that of the usual picture within what a row of pixels may differ by."""
    usual = numbers(room(), "rays").picture.mean()
    seen = numbers(room(), method, width=width, height=height)
    assert seen.layers.comp.shape == (height, width, 3)
    assert 0.5 * usual < seen.picture.mean() < 2.0 * usual


@pytest.mark.parametrize("resolution", [1, 2, 3, 5, 17])
@pytest.mark.parametrize("coarse", [0, 1, 24])
@pytest.mark.parametrize("method", ["rays", "cones"])
def test_volumes_of_few_voxels(method, coarse, resolution):
    """However coarse, the light in the room stays within 20 % of the truth in the mean."""
    seen = numbers(room(), method, **{"volume.resolution": resolution, "volume.coarse": coarse})
    assert seen.before.mean() == pytest.approx(0.145, rel=0.2)


@pytest.mark.parametrize("method", ["rays", "cones"])
def test_the_largest_volume(method):
    """1024 voxels an edge around a small box in the air, so that few of them hold anything."""
    box = lit.mesh(lit.ball((0.5, 0.5, 0.5), 0.004, rings=6), Role.SYNTHETIC, 0)
    seen = numbers(room(box), method, **{"volume.resolution": 1024, "rsm.texels": 256})
    assert seen.before.mean() == pytest.approx(0.145, rel=0.1)

"""Lights in awkward places and of extreme strength."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest
from extreme_scenes import HEIGHT, METHODS, RED, SHINY, WHITE, WIDTH, ball, lamp, moved, numbers, room
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_dvct.relighter import Relighter
from warp_dvct.scene import Light, LightKind, Scene


def scaled(factor: float) -> Scene:
    """The room under the lamp at ``factor`` times its strength."""
    return room(lights=(lamp(radiance=tuple(factor * np.array([9.0, 8.0, 7.0]))),))


def outdoors(*lights: Light) -> Scene:
    """The ball on an open ground."""
    ground = lit.mesh(lit.rectangle((0.5, 0.1, 0.5), (1, 0, 0), (0, 0, -1)))
    camera = lit.look_at((0.5, 0.8, 1.6), (0.5, 0.15, 0.4), half=0.5, aspect=WIDTH / HEIGHT)
    return lit.scene_of(ground, ball(), lights=lights, materials=(WHITE, RED, SHINY), camera=camera)


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=4, deadline=None, database=None, derandomize=True)
@given(exponent=st.one_of(st.sampled_from([-12.0, 12.0]), st.floats(-12.0, 12.0)))
def test_response_is_linear_in_the_lights_strength(method, exponent):
    """Over 24 decades, to 1e-5 of each picture's mean: nothing depends on an absolute brightness."""
    factor = 10.0**exponent
    usual, other = numbers(scaled(1.0), method), numbers(scaled(factor), method)
    for name in ("before", "delta", "synthetic"):
        one, many = (getattr(x, name)[..., :3] for x in (usual, other))
        assert np.abs(many / factor - one).mean() < 1e-5 * np.abs(one).mean(), name


def test_what_half_floats_cannot_hold_is_clamped_and_counted():
    layers = numbers(scaled(1e12), "rays").layers
    assert (layers.plate == 65504.0).all()
    assert layers.clamped == layers.comp.size
    # The shadow is a ratio of what was there, not of what could be stored.
    usual = numbers(scaled(1.0), "rays").layers
    np.testing.assert_allclose(layers.shadow, usual.shadow, atol=2e-3)
    alone = layers.mask_synthetic == 0.0
    np.testing.assert_allclose(
        layers.comp[alone], np.minimum(65504.0, 65504.0 * layers.shadow[alone] + layers.added[alone]), rtol=1e-3
    )
    assert np.isfinite(layers.delta).all()
    faint = numbers(scaled(1e-12), "rays").layers  # below the smallest half number, 6e-8: black, as documented
    assert (faint.comp == 0.0).all()


@pytest.mark.parametrize("method", METHODS)
def test_light_of_no_strength_leaves_the_plate_untouched(method):
    """Real pixels keep the plate bit for bit, and so they do without any light."""
    plate = np.random.default_rng(3).uniform(0.1, 0.9, (HEIGHT, WIDTH, 3)).astype(np.float16).astype(np.float32)
    for lights in ((lamp(radiance=(0.0, 0.0, 0.0)),), ()):
        name, more = METHODS[method]
        shown = Relighter(room(lights=lights), method=name, settings=more, quality="draft", width=WIDTH, height=HEIGHT)
        layers = shown.render(plate)
        alone = layers.mask_synthetic == 0.0
        assert alone.any()
        assert (layers.comp[alone] == plate[alone]).all()
        assert (layers.shadow == 1.0).all()
        assert (layers.added == 0.0).all()


@pytest.mark.parametrize("method", METHODS)
def test_one_bright_texel_in_a_dome(method):
    """A texel of 1e6 in a dome of 0.1: the ground's mean is the path tracer's within 15 %, with rays enough to find
    it (it fills a 1/700 of the sky), and no pixel is above what the texel alone can give."""
    texture = np.full((16, 32, 3), 0.1, np.float32)
    texture[4, 9] = 1e6
    scene = outdoors(Light(LightKind.DOME, (1.0, 1.0, 1.0), texture=texture))
    truth = numbers(scene, "path", samples=64, bounces=1)
    many = {"gather.rays": 512, "gather.object_rays": 256, "cones.count": 36, "vpls.sky": 128}
    seen = numbers(scene, method, bounces=1, **many)
    # Cones blur the texel over their width, which part of the time lies below the horizon.
    assert seen.before.mean() == pytest.approx(truth.before.mean(), rel=0.6 if method == "cones" else 0.15)
    texel = 2 * np.pi / 32 * (np.cos(4 * np.pi / 16) - np.cos(5 * np.pi / 16))
    if method != "path":  # whose single samples may be brighter than their mean
        assert seen.before.max() < 3.0 * 0.7 / np.pi * 1e6 * texel


@pytest.mark.parametrize("degrees", [0.0, 33.0])
@pytest.mark.parametrize("method", ["rays", "cones", "vpl-rays"])
def test_a_lamp_in_the_plane_of_the_ceiling_lights_the_room(method, degrees):
    """As a lamp a millimetre below it does: within 5 % in the mean, which is what coarse voxels leave uncertain."""
    in_plane, below = (
        numbers(moved(room(lights=(lamp(position=(0.5, y, 0.5)),)), turn=lit.turned(degrees)), method)
        for y in (0.9, 0.899)
    )
    assert in_plane.picture.mean() == pytest.approx(below.picture.mean(), rel=0.05)
    assert in_plane.picture.mean() > 0.09  # with direct light alone it is 0.066


CENTER = (0.62, 0.22, 0.42)
INSIDE = {
    "point": Light(LightKind.POINT, (1.0, 1.0, 1.0), position=CENTER),
    "sphere": Light(LightKind.SPHERE, (9.0, 9.0, 9.0), position=CENTER, radius=0.05),
    "rect": lamp(position=CENTER, axis_x=(0.04, 0, 0), axis_y=(0, 0, 0.04)),
}


FINE = {"volume.resolution": 96, "volume.coarse": 64, "rsm.texels": 256, "patches.count": 4096}
MAPS = {"ism.size": 128, "ism.points": 1024, "ism.blocks": 16, "vpls.count": 128, "vpls.further": 64}


@pytest.mark.parametrize("kind", INSIDE)
@pytest.mark.parametrize(("method", "more"), [("rays", FINE), ("vpl-rays", {}), ("ism", MAPS), ("path", {})])
def test_a_light_inside_of_an_object_is_hidden_by_it(method, more, kind):
    """At most 5 % of it leaks, where the ball's lining and the floor that it stands on share voxels, and through
    shadow maps of the preset's size."""
    seen = numbers(room(lights=(INSIDE[kind],)), method, **more)
    assert seen.picture.mean() < 0.05 * seen.before.mean()


ODD = {
    "on the floor": Light(LightKind.POINT, (1.0, 1.0, 1.0), position=(0.5, 0.1, 0.5)),
    "in a corner": Light(LightKind.POINT, (1.0, 1.0, 1.0), position=(0.1, 0.1, 0.1)),
    "around the ball": Light(LightKind.SPHERE, (5.0, 5.0, 5.0), position=CENTER, radius=0.2),
    "in the wall": Light(LightKind.SPHERE, (5.0, 5.0, 5.0), position=(0.1, 0.5, 0.5), radius=0.1),
    "of 1e-7": Light(LightKind.SPHERE, (5e12, 5e12, 5e12), position=(0.5, 0.8, 0.5), radius=1e-7),
    "of a million": Light(LightKind.SPHERE, (5.0, 5.0, 5.0), position=(0.5, 3e6, 0.5), radius=1e6),
    "a spot of 0.1 degrees": Light(LightKind.POINT, (1e4, 1e4, 1e4), direction=(0, -1, 0), cone_angle=1e-3),
}


@pytest.mark.parametrize("place", ODD)
@pytest.mark.parametrize("method", METHODS)
def test_lights_in_odd_places_and_sizes_give_finite_pictures(method, place):
    """``numbers`` checks each launch; the mean stays below what the lights' power could give a white room."""
    assert numbers(room(lights=(ODD[place],)), method).picture.mean() < 4.0


@pytest.mark.parametrize("angle", [1e-1, 1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize("method", METHODS)
def test_light_at_grazing_angles_falls_with_the_sine(method, angle):
    """Down to 1e-4 rad, to 0.1 %: the cosine comes from the normal, not from a difference of near numbers."""
    sun = Light(LightKind.DISTANT, (1.0, 1.0, 1.0), direction=(np.cos(angle), -np.sin(angle), 0.0))
    seen = numbers(outdoors(sun), method, bounces=0)
    open_ground = seen.layers.mask_real * (np.abs(seen.delta).max(-1) == 0.0) == 1.0
    assert open_ground.sum() > 30
    np.testing.assert_allclose(seen.before[open_ground], 0.7 / np.pi * np.sin(angle), rtol=1e-3)

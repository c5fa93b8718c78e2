"""Direct light: shadows in closed form, every light type, added lights, and shadow cones beside shadow rays."""

from __future__ import annotations

from dataclasses import replace

import lit_scenes as lit
import numpy as np
import pytest
import warp as wp

from warp_dvct.passes.shading import shade_direct
from warp_dvct.scene import Light, LightKind, LightRole, Role

L = np.array([2.0, 3.0, 4.0])
ALBEDO = np.array([0.5, 0.4, 0.3])
BALL, RADIUS = np.array([0.5, 0.4, 0.5]), 0.12
FLOOR = lit.rectangle((0.5, 0.1, 0.5), (0, 0, 5.0), (5.0, 0, 0))


def light(kind=LightKind.POINT, position=(0.5, 0.9, 0.5), **more) -> Light:
    return Light(kind, tuple(L), position=position, direction=(0, -1, 0), **more)


LIGHTS = {
    "point": light(),
    "spot": light(cone_angle=0.5, cone_softness=0.4),
    "sphere": light(LightKind.SPHERE, radius=0.04),
    "rect": light(LightKind.RECT, axis_x=(0.05, 0, 0.02), axis_y=(0, 0, 0.03)),
    "disk": light(LightKind.DISK, axis_x=(0.04, 0, 0), axis_y=(0, 0, 0.04)),
    "directional": light(LightKind.DISTANT),
    "sun": light(LightKind.DISTANT, angle=0.1),
}


def shaded(launcher, scene, points, count, *, world=None, cone=None, endless=False, **more):
    """Light and before of points: float64 ``[count, 3]`` each. ``endless``: Nothing is culled by the objects' box."""
    out = [launcher.full(count, wp.vec3(7.0, 7.0, 7.0), wp.vec3) for _ in range(2)]
    direct = lit.direct_settings(**more)
    device_scene = lit.upload(launcher, scene)
    if endless:
        device_scene.geometry.extent = wp.vec3(1e6, 1e6, 1e6)
    shade_direct(launcher, device_scene, points, count, direct, light=out[0], before=out[1], world=world, cone=cone)
    return tuple(a.numpy()[:count].astype(float) for a in out)


def floor_points(launcher, count=800, half=0.4, seed=0):
    places = np.random.default_rng(seed).uniform(0.5 - half, 0.5 + half, (count, 3))
    places[:, 1] = 0.1
    return lit.points_at(launcher, places, (0, 1, 0), color=ALBEDO), places


def with_ball(*lights, role=Role.SYNTHETIC, more=()):
    return lit.scene_of(lit.mesh(FLOOR), lit.mesh(lit.ball(BALL, RADIUS, 64), role), *more, lights=lights)


def miss_distance(places, eye) -> np.ndarray:
    """How far the segments from places to an eye pass by the ball's centre."""
    direction = eye - places
    t = np.clip(((BALL - places) * direction).sum(-1) / (direction**2).sum(-1), 0, 1)
    return np.linalg.norm(places + t[:, None] * direction - BALL, axis=-1)


def test_point_lights_umbra_is_minus_the_irradiance(launcher):
    """-I cos / d^2 * albedo / pi behind the ball, exactly 0 elsewhere; before has that light everywhere."""
    points, places = floor_points(launcher)
    delta, before = shaded(launcher, with_ball(LIGHTS["point"]), points, 800)
    to_light = np.array([0.5, 0.9, 0.5]) - places
    irradiance = (0.8 / np.linalg.norm(to_light, axis=-1) ** 3)[:, None] * L
    np.testing.assert_allclose(before, irradiance * ALBEDO / np.pi, rtol=1e-4)
    miss = miss_distance(places, np.array([0.5, 0.9, 0.5]))
    hidden, seen = miss < RADIUS * 0.99, miss > RADIUS
    assert hidden.sum() > 50
    assert seen.sum() > 300
    np.testing.assert_array_equal(delta[hidden], -before[hidden])
    assert not delta[seen].any()


@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize("probes", [4, 16])
def test_delta_takes_between_nothing_and_all_of_the_light(launcher, name, probes):
    """For every light type: 0 where all of it is seen, -before where none is, and not beyond in the penumbra."""
    points, places = floor_points(launcher)
    scene = with_ball(LIGHTS[name])
    delta, before = shaded(launcher, scene, points, 800, samples=16, probes=probes)
    assert (before >= 0).all()
    assert (delta <= 0).all()
    assert (delta >= -before * (1 + 1e-5)).all()
    off = np.linalg.norm(places[:, [0, 2]] - 0.5, axis=-1)
    lit_up = before.max(-1) > 0
    umbra = lit_up & (off < 0.08)
    assert umbra.any()
    np.testing.assert_allclose(delta[umbra], -before[umbra], rtol=1e-5)
    outside = off > 0.33
    assert outside.any()
    assert not delta[outside].any()
    alone, _ = shaded(launcher, scene, points, 800, samples=16, probes=probes, with_before=False)
    np.testing.assert_allclose(alone, delta, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(("probes", "bias"), [(64, 0.004), (8, 0.02)])
def test_penumbra_of_a_rectangle(launcher, probes, bias):
    """Against a brute-force integral over the light; ``probes`` that agree save rays and steepen penumbras a little."""
    source = light(LightKind.RECT, axis_x=(0.2, 0, 0), axis_y=(0, 0, 0.12))
    count = 150
    points, places = floor_points(launcher, count, 0.35, seed=4)
    delta, before = shaded(launcher, with_ball(source), points, count, samples=64, probes=probes)
    st = (np.stack(np.meshgrid(np.arange(40), np.arange(40), indexing="ij"), -1).reshape(-1, 2) + 0.5) / 20 - 1
    spots = np.array([0.5, 0.9, 0.5]) + st @ np.array([source.axis_x, source.axis_y])
    d = spots[None] - places[:, None]
    square = (d**2).sum(-1)
    share = 4 * 0.2 * 0.12 / len(st) * d[..., 1] ** 2 / square**2
    hidden = np.stack([miss_distance(np.repeat(p[None], len(spots), 0), spots) < RADIUS for p in places])
    expected = (share * hidden).sum(1)[:, None] * L * ALBEDO / np.pi
    whole = share.sum(1)[:, None] * L * ALBEDO / np.pi
    np.testing.assert_allclose(before, whole, rtol=0.06)
    error = (-delta - expected) / whole
    assert abs(error.mean()) < bias
    assert np.sqrt((error**2).mean()) < 0.04
    penumbra = (hidden.mean(1) > 0.05) & (hidden.mean(1) < 0.95)
    assert penumbra.sum() > 40


LARGE = LIGHTS | {
    "sphere": light(LightKind.SPHERE, radius=0.15),
    "rect": light(LightKind.RECT, axis_x=(0.3, 0, 0.02), axis_y=(0, 0, 0.2)),
    "disk": light(LightKind.DISK, axis_x=(0.25, 0, 0), axis_y=(0, 0, 0.25)),
    "sun": light(LightKind.DISTANT, angle=1.0),
}


@pytest.mark.parametrize("name", LARGE)
def test_culling_by_a_box_changes_nothing(launcher, name):
    """The box around the synthetic objects only saves rays: as if it were endless, from every side of the light."""
    rng = np.random.default_rng(8)
    middle = rng.uniform(0.4, 0.6, 3)
    objects = [lit.mesh(lit.ball(middle + 0.04 * k * lit.EYES[1], 0.02, 8), Role.SYNTHETIC) for k in range(2)]
    walls = lit.room(0.48)
    if LIGHTS[name].kind == LightKind.DISTANT:
        walls = walls[walls[..., 1].mean(-1) < 0.97]  # lets it in from above
    any_shadow = False
    for position in ((0.5, 0.8, 0.5), (0.05, 0.55, 0.9), (0.5, 0.3, 0.45)):
        source = replace(LARGE[name], position=position)
        scene = lit.scene_of(lit.mesh(walls), *objects, lights=(source,))
        points, _ = lit.points_on(launcher, lit.upload(launcher, scene), 1500, inset=0.01)
        culled, whole = (
            shaded(launcher, scene, points, 1500, samples=16, with_before=False, endless=endless)[0]
            for endless in (False, True)
        )
        np.testing.assert_array_equal(culled, whole)
        any_shadow |= bool(culled.any())
    assert any_shadow


@pytest.mark.parametrize("name", LIGHTS)
def test_added_light_is_all_delta(launcher, name):
    """It is positive where neither real nor synthetic surfaces hide it, and before does not have it."""
    points, places = floor_points(launcher)
    shelf = lit.mesh(lit.rectangle((0.85, 0.5, 0.5), (0, 0, 0.5), (0.15, 0, 0)))
    scene = with_ball(replace(LIGHTS[name], role=LightRole.ADDED), more=(shelf,))
    added, before = shaded(launcher, scene, points, 800, samples=16)
    assert not before.any()
    assert (added >= 0).all()
    assert not added[np.linalg.norm(places[:, [0, 2]] - 0.5, axis=-1) < 0.08].any()
    plate = shaded(launcher, with_ball(LIGHTS[name], more=(shelf,)), points, 800, samples=16)
    np.testing.assert_allclose(added, plate[0] + plate[1], rtol=1e-4, atol=1e-6)
    assert added.max() > 0


def test_double_shadowing_is_not_counted(launcher):
    """Where a real shelf already hides the light, an object between makes no delta."""
    points, _ = floor_points(launcher)
    shelf = lit.mesh(lit.rectangle((0.5, 0.2, 0.5), (0, 0, 0.5), (0.5, 0, 0)))
    delta, before = shaded(launcher, with_ball(LIGHTS["point"], more=(shelf,)), points, 800)
    assert not delta.any()
    assert not before.any()


def test_synthetic_points_get_the_light_itself(launcher):
    """Behind the real shelf nothing, else albedo / pi E; 'before' stays 0 there."""
    places = np.array([[0.3, 0.1, 0.3], [0.8, 0.1, 0.5]])
    points = lit.points_at(launcher, places, (0, 1, 0), role=1, color=ALBEDO)
    shelf = lit.mesh(lit.rectangle((0.85, 0.3, 0.5), (0, 0, 0.5), (0.15, 0, 0)))
    after, before = shaded(launcher, lit.scene_of(shelf, lights=(LIGHTS["point"],)), points, 2)
    d = np.linalg.norm([0.2, 0.8, 0.2])
    np.testing.assert_allclose(after[0], 0.8 / d**3 * L * ALBEDO / np.pi, rtol=1e-4)
    assert not after[1].any()
    assert not before.any()


def test_background_and_domes_get_nothing(launcher):
    places = np.array([[0.3, 0.1, 0.3], [0.8, 0.1, 0.5]])
    points = lit.points_at(launcher, places, (0, 1, 0), role=[-1, 0])
    delta, before = shaded(launcher, lit.scene_of(lit.mesh(FLOOR), lights=(LIGHTS["point"],)), points, 2)
    assert not delta[0].any()
    assert not before[0].any()
    assert before[1].all()
    delta, before = shaded(
        launcher, lit.scene_of(lit.mesh(FLOOR), lights=(Light(LightKind.DOME, (1, 1, 1)),)), points, 2
    )
    assert not delta.any()
    assert not before.any()


def test_lights_add_up(launcher):
    points, _ = floor_points(launcher, 200)
    names = ("point", "rect", "sun")
    each = [shaded(launcher, with_ball(LIGHTS[n]), points, 200, samples=8)[1] for n in names]
    together = shaded(launcher, with_ball(*(LIGHTS[n] for n in names)), points, 200, samples=8)[1]
    np.testing.assert_allclose(together, sum(each), rtol=0.03)


@pytest.mark.parametrize(("n", "mean"), [(64, 0.075), (128, 0.055)])
def test_shadow_cones_against_rays(launcher, n, mean):
    """A box hung under a round lamp: cones find umbra and open floor, penumbras differ (.062, .043 measured)."""
    lamp = light(LightKind.DISK, (0.5, 0.88, 0.5), axis_x=(0.1, 0, 0), axis_y=(0, 0, 0.1))
    box = lit.mesh(lit.cuboid((0.5, 0.4, 0.5), (0.14, 0.05, 0.14)), Role.SYNTHETIC)
    scene = lit.scene_of(lit.mesh(lit.room(0.4)), box, lights=(lamp,))
    world = lit.lit_world(launcher, scene, n, lambda _, v: lit.uniform_flux(launcher, v, np.zeros(3))).world
    points, places = floor_points(launcher, 600, 0.38)
    exact = shaded(launcher, scene, points, 600, samples=64)
    cones = shaded(launcher, scene, points, 600, samples=16, world=world, cone=lit.cone_settings())
    np.testing.assert_allclose(cones[1].mean(0), exact[1].mean(0), rtol=0.05)
    share = {name: -(d / exact[1])[:, 0] for name, d in (("rays", exact[0]), ("cones", cones[0]))}
    off = np.abs(places[:, [0, 2]] - 0.5).max(-1)
    assert share["cones"][off < 0.1].min() > 0.9
    assert share["cones"][off > 0.36].max() < 0.1
    assert np.abs(share["cones"] - share["rays"]).mean() < mean
    assert share["cones"].mean() == pytest.approx(share["rays"].mean(), rel=0.15)

"""Reflective shadow maps: the flux of every light type in closed form, and what the pair holds."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct.passes.rsm import render_rsm
from warp_dvct.scene import Light, LightKind, LightRole, Role

L = np.array([2.0, 3.0, 4.0])
ALBEDO = np.array(lit.GREY.base_color)
RADIUS = 0.5 * np.sqrt(3.0)  # of the sphere around the unit cube
SKY = np.random.default_rng(3).lognormal(0, 1.5, (8, 16, 3)).astype(np.float32)


def light(kind, position=(0.5, 0.5, 0.5), direction=(0, -1, 0), **more) -> Light:
    return Light(kind, tuple(L), position=position, direction=direction, **more)


def maps_of(launcher, scene, size, *, center=(0.5, 0.5, 0.5), radius=RADIUS, **more):
    return render_rsm(launcher, lit.upload(launcher, scene), 0, size, center=center, radius=radius, start=3.0, **more)


def flux(maps, solution="after", role=None) -> np.ndarray:
    roles = getattr(maps, f"role_{solution}").numpy()
    chosen = roles >= 0 if role is None else roles == role
    return getattr(maps, f"flux_{solution}").numpy()[chosen].astype(float).sum(0)


def sky_power() -> np.ndarray:
    """Radiance of the textured dome over all directions, its texels interpolated as the light's look-up does."""
    h, w = 400, 800
    v, u = (np.arange(h) + 0.5) / h * 8 - 0.5, (np.arange(w) + 0.5) / w * 16 - 0.5
    y0, x0 = np.floor(v).astype(int), np.floor(u).astype(int)
    fy, fx = (v - y0)[:, None, None], (u - x0)[None, :, None]
    rows = [SKY[np.clip(y0 + k, 0, 7)].astype(float) for k in (0, 1)]
    rows = [r[:, x0 % 16] * (1 - fx) + r[:, (x0 + 1) % 16] * fx for r in rows]
    edges = np.cos(np.linspace(0, np.pi, h + 1))
    band = (edges[:-1] - edges[1:])[:, None, None] * 2 * np.pi / w
    return ((rows[0] * (1 - fy) + rows[1] * fy) * band).sum((0, 1))


def spot_power(angle: float, softness: float) -> float:
    """Solid angle of a spot's cone, weighted by the smoothstep of its edge."""
    theta = (np.arange(20000) + 0.5) / 20000 * angle
    x = np.clip((theta - angle * (1 - softness)) / max(angle * softness, 1e-9), 0, 1)
    return float((2 * np.pi * np.sin(theta) * (1 - x * x * (3 - 2 * x))).sum() * angle / 20000)


DISC = np.pi * RADIUS**2
ROUND = np.pi * 0.05**2
POWERS = {
    "point": (light(LightKind.POINT), 4 * np.pi),
    "sphere": (light(LightKind.SPHERE, radius=0.05), 4 * np.pi * ROUND),
    "rect": (light(LightKind.RECT, axis_x=(0.1, 0, 0.05), axis_y=(0, 0, 0.2)), np.pi * 4 * 0.1 * 0.2),
    "disk": (light(LightKind.DISK, axis_x=(0.1, 0, 0), axis_y=(0, 0, 0.2)), np.pi * np.pi * 0.1 * 0.2),
    "directional": (light(LightKind.DISTANT), DISC),
    "distant": (light(LightKind.DISTANT, angle=0.5), 2 * np.pi * (1 - np.cos(0.25)) * DISC),
    "dome": (light(LightKind.DOME), 4 * np.pi * DISC),
    "hard spot": (light(LightKind.POINT, cone_angle=0.6), spot_power(0.6, 0.0)),
    "soft spot": (light(LightKind.POINT, cone_angle=0.8, cone_softness=0.5), spot_power(0.8, 0.5)),
    "sphere spot": (
        light(LightKind.SPHERE, radius=0.05, cone_angle=0.8, cone_softness=0.2),
        spot_power(0.8, 0.2) * ROUND,
    ),
}
UNEVEN = {"soft spot", "sphere spot"}  # what a beam carries varies with its direction: the sum is an estimate


@pytest.mark.parametrize("name", POWERS)
def test_a_surround_reflects_the_lights_whole_power(launcher, name):
    """Nothing is lost in a closed room (or around one, for parallel light), whatever the size of the map."""
    source, power = POWERS[name]
    scene = lit.scene_of(lit.mesh(lit.room(0.49, 0.0)), lights=(source,))
    outer = {"radius": 0.3} if source.kind in (LightKind.DISTANT, LightKind.DOME) else {}
    share = (0.3 / RADIUS) ** 2 if outer else 1.0
    for size, tolerance in ((1, 1e-5), (7, 1e-5), (64, 1e-5), (200, 1e-5)):
        if name in UNEVEN:
            if size == 1:
                continue
            tolerance = 0.5 / size
        maps = maps_of(launcher, scene, size, **outer)
        np.testing.assert_allclose(flux(maps), ALBEDO * L * power * share, rtol=tolerance, err_msg=f"{size} texels")
        np.testing.assert_allclose(flux(maps, "before"), flux(maps), rtol=1e-6)


def test_textured_dome_brings_its_mean_radiance(launcher):
    source = light(LightKind.DOME, texture=SKY, rotation=lit.turned(40.0))
    scene = lit.scene_of(lit.mesh(lit.room(0.49)), lights=(source,))
    expected = ALBEDO * L * sky_power() * np.pi * 0.3**2
    for size, tolerance in ((64, 0.03), (256, 0.006)):
        np.testing.assert_allclose(flux(maps_of(launcher, scene, size, radius=0.3)), expected, rtol=tolerance)


OUTSIDE = {
    "point": (light(LightKind.POINT, (0.5, 2.0, 0.5)), lambda: 2 * np.pi * (1 - np.sqrt(1 - (0.3 / 1.5) ** 2))),
    "sphere": (light(LightKind.SPHERE, (0.5, 2.0, 0.5), radius=0.1), None),
    "rect": (light(LightKind.RECT, (0.5, 2.0, 0.5), axis_x=(0.2, 0, 0), axis_y=(0, 0, 0.1)), None),
    "disk": (light(LightKind.DISK, (0.5, 2.0, 0.5), axis_x=(0.2, 0, 0), axis_y=(0, 0, 0.2)), None),
    "directional": (light(LightKind.DISTANT), lambda: np.pi * 0.3**2),
    "distant": (light(LightKind.DISTANT, angle=0.3), lambda: np.pi * 0.3**2 * 2 * np.pi * (1 - np.cos(0.15))),
    "dome": (light(LightKind.DOME), lambda: 4 * np.pi * np.pi * 0.3**2),
}


def power_onto_ball(source: Light, radius: float) -> float:
    """Power of a light of unit radiance that reaches a ball in the middle.

    By brute integration over pairs of a place on the emitter and a direction that meets the ball.
    """
    rng = np.random.default_rng(0)
    count = 400_000
    center = lit.CENTER
    if source.kind == LightKind.SPHERE:
        normal = rng.normal(size=(count, 3))
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        place, area = np.asarray(source.position) + source.radius * normal, 4 * np.pi * source.radius**2
    else:
        st = rng.uniform(-1, 1, (count, 2))
        area = 4 * np.linalg.norm(np.cross(source.axis_x, source.axis_y))
        if source.kind == LightKind.DISK:
            r, phi = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
            st, area = np.stack([r * np.cos(phi), r * np.sin(phi)], 1), area * np.pi / 4
        place = np.asarray(source.position) + st @ np.array([source.axis_x, source.axis_y])
        normal = np.broadcast_to(source.direction, place.shape)
    # A direction inside the cap under which the ball is seen: constant density over its solid angle.
    toward = center - place
    distance = np.linalg.norm(toward, axis=-1)
    cap = 1 - np.sqrt(1 - (radius / distance) ** 2)
    cos = 1 - cap * rng.random(count)
    phi = 2 * np.pi * rng.random(count)
    axis = toward / distance[:, None]
    side = np.cross(axis, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    sine = np.sqrt(1 - cos**2)
    direction = (
        axis * cos[:, None]
        + side * (sine * np.cos(phi))[:, None]
        + np.cross(axis, side) * (sine * np.sin(phi))[:, None]
    )
    return float(area * np.mean(np.maximum(0, (direction * normal).sum(-1)) * 2 * np.pi * cap))


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_ball_takes_the_power_that_reaches_it(launcher, name):
    """From outside only a part of the map meets the ball; it does not depend on the target that the map covers."""
    source, form = OUTSIDE[name]
    power = form() if form else power_onto_ball(source, 0.3)
    scene = lit.scene_of(lit.mesh(lit.ball(lit.CENTER, 0.3, 96)), lights=(source,))
    for target, size in ((0.31, 192), (0.6, 256)):
        got = flux(maps_of(launcher, scene, size, radius=target))
        np.testing.assert_allclose(got, ALBEDO * L * power, rtol=0.012, err_msg=f"target {target}")


def test_flux_per_texel_falls_with_their_number(launcher):
    scene = lit.scene_of(lit.mesh(lit.room(0.45)), lights=(POWERS["point"][0],))
    few, many = (maps_of(launcher, scene, size).flux_after.numpy() for size in (16, 64))
    np.testing.assert_allclose(few.mean(0, float), 16 * many.mean(0, float), rtol=1e-5)
    assert len(few) == 256
    assert len(many) == 4096


FLOOR = lit.rectangle((0.5, 0.1, 0.5), (0, 0, 0.4), (0.4, 0, 0))


def pair_of(launcher, *, role=LightRole.PLATE, size=128, object_role=Role.SYNTHETIC):
    """A point light above a ball above a floor."""
    source = light(LightKind.POINT, (0.5, 0.9, 0.5), role=role)
    ball = lit.mesh(lit.ball((0.5, 0.4, 0.5), 0.15, 64), object_role)
    return maps_of(launcher, lit.scene_of(lit.mesh(FLOOR), ball, lights=(source,)), size)


def test_roles_show_where_the_object_stands_in_the_light(launcher):
    """The share of directions that meets the ball is its cap; behind it the before map sees the floor."""
    maps = pair_of(launcher, size=256)
    after, before = maps.role_after.numpy(), maps.role_before.numpy()
    cap = 2 * np.pi * (1 - np.sqrt(1 - (0.15 / 0.5) ** 2))
    np.testing.assert_allclose(flux(maps, "after", 1), ALBEDO * L * cap, rtol=0.01)
    assert set(np.unique(before)) <= {-1, 0}
    shadowed = after == 1
    position = maps.position_after.numpy()[shadowed]
    assert np.abs(np.linalg.norm(position - [0.5, 0.4, 0.5], axis=-1) - 0.15).max() < 1e-3
    behind = shadowed & (before == 0)
    assert behind.sum() == shadowed.sum(), "the floor is larger than the ball's shadow"
    np.testing.assert_allclose(maps.position_before.numpy()[behind][:, 1], 0.1, atol=1e-6)
    # The three points of a beam lie on one line.
    eye = np.array([0.5, 0.9, 0.5])
    a, b = (x.numpy()[behind] - eye for x in (maps.position_after, maps.position_before))
    assert np.linalg.norm(np.cross(a, b), axis=-1).max() < 1e-5
    assert (np.linalg.norm(a, axis=-1) < np.linalg.norm(b, axis=-1)).all()
    # A beam carries one flux: both maps reflect it with the same albedo here.
    np.testing.assert_allclose(maps.flux_after.numpy()[behind], maps.flux_before.numpy()[behind], rtol=1e-5)
    for name in ("after", "before"):
        seen = getattr(maps, f"role_{name}").numpy() >= 0
        p, n = (getattr(maps, f"{x}_{name}").numpy()[seen] for x in ("position", "normal"))
        assert ((n * (eye - p)).sum(-1) > 0).all(), "normals face the light"
        np.testing.assert_allclose(np.linalg.norm(n, axis=-1), 1.0, atol=1e-5)


def test_where_nothing_synthetic_is_seen_both_maps_are_equal(launcher):
    maps = pair_of(launcher)
    same = maps.role_after.numpy() == 0
    assert same.sum() > 100
    assert (maps.role_before.numpy()[same] == 0).all()
    for name in ("position", "normal", "flux"):
        np.testing.assert_array_equal(
            getattr(maps, f"{name}_after").numpy()[same], getattr(maps, f"{name}_before").numpy()[same]
        )
    real = pair_of(launcher, object_role=Role.REAL)
    np.testing.assert_array_equal(real.role_after.numpy(), real.role_before.numpy())
    assert set(np.unique(real.role_after.numpy())) == {-1, 0}


def test_an_added_light_has_no_before(launcher):
    maps = pair_of(launcher, role=LightRole.ADDED)
    assert (maps.role_before.numpy() == -1).all()
    plate = pair_of(launcher)
    np.testing.assert_array_equal(maps.role_after.numpy(), plate.role_after.numpy())
    np.testing.assert_array_equal(flux(maps), flux(plate))


def test_a_far_object_behind_the_floor_is_not_seen(launcher):
    ball = lit.mesh(lit.ball((0.5, -0.3, 0.5), 0.1), Role.SYNTHETIC)
    scene = lit.scene_of(
        lit.mesh(lit.rectangle((0.5, 0.1, 0.5), (0, 0, 9), (9, 0, 0))), ball, lights=(light(LightKind.DISTANT),)
    )
    maps = maps_of(launcher, scene, 64)
    assert (maps.role_after.numpy() == 0).all()


def test_seed_moves_texels_and_nothing_else_does(launcher):
    scene = lit.scene_of(lit.mesh(lit.room(0.45, 20.0)), lights=(POWERS["rect"][0],))
    one, again, other = (maps_of(launcher, scene, 32, seed=s).position_after.numpy() for s in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).max() > 1e-3

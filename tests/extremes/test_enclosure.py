"""Synthetic surfaces far larger than the closed room that is seen: only their part in the room matters."""

from __future__ import annotations

from dataclasses import replace

import lit_scenes as lit
import numpy as np
import pytest
from extreme_scenes import ball, numbers, room

from warp_dvct.enclosure import cut_to, winding_number, within_enclosure
from warp_dvct.scene import Light, LightKind, LightRole, Role

SHELF_INSIDE = 0.39999


def shelf(half: float):
    """A synthetic plane at a quarter of the room's height; the room is 0.8 wide."""
    return lit.mesh(lit.rectangle((0.5, 0.3, 0.5), (half, 0, 0), (0, 0, -half)), Role.SYNTHETIC, 0)


@pytest.mark.parametrize("half", [10.0, 1e4, 1e6])
@pytest.mark.parametrize(
    ("method", "tolerance", "more"),
    [
        ("rays", 0.01, {}),
        ("cones", 0.01, {}),
        ("path", 1e-6, {}),
        ("vpl-rays", 0.06, {"vpls__count": 512, "vpls__further": 256}),
    ],
)
def test_a_synthetic_plane_a_million_times_the_room(method, tolerance, more, half):
    """As the part of it in the room alone: 1 %, VPLs 6 %, which is their sampling. Volumes of its size were 25 % too
    dark at 25 rooms, and rays missed the room at 1e4."""
    within, beyond = (numbers(room(shelf(h)), method, **more) for h in (SHELF_INSIDE, half))
    assert beyond.picture.mean() == pytest.approx(within.picture.mean(), rel=tolerance)


def test_winding_numbers():
    """One inside of closed meshes, with the sign of their faces; 0 outside; a half under an endless plane."""
    closed = lit.mesh(lit.cuboid((0.5, 0.5, 0.5), 0.4))
    assert winding_number(closed, np.array([0.3, 0.6, 0.5])) == pytest.approx(1.0, abs=1e-12)
    assert winding_number(lit.mesh(lit.room(0.4)), np.array([0.3, 0.6, 0.5])) == pytest.approx(-1.0, abs=1e-12)
    assert winding_number(closed, np.array([2.0, 0.6, 0.5])) == pytest.approx(0.0, abs=1e-12)
    plane = lit.mesh(lit.rectangle((0, 0, 0), (1e6, 0, 0), (0, 0, -1e6)))
    assert abs(winding_number(plane, np.array([0.0, -1.0, 0.0]))) == pytest.approx(0.5, abs=1e-5)


def test_what_is_cut():
    """Areas are those inside, attributes are linear over the triangles, and triangles inside keep their bits."""
    rng = np.random.default_rng(4)
    corners = rng.uniform(-1, 1, (200, 3, 3)) * np.where(np.arange(200) < 20, 0.25, 1.0)[:, None, None]
    mesh = replace(
        lit.mesh(corners, Role.SYNTHETIC),
        corner_uvs=(corners[..., :2] * 3 + 1).astype(np.float32),
        corner_colors=corners.astype(np.float32),
        materials=np.arange(200, dtype=np.int32),
    )
    low, high = np.full(3, -0.4), np.array([0.5, 0.3, 0.6])
    cut = cut_to(mesh, low, high)
    points = cut.points[cut.triangles]
    assert points.min(axis=(0, 1)) == pytest.approx(low, abs=1e-9)
    assert points.max(axis=(0, 1)) == pytest.approx(high, abs=1e-9)
    np.testing.assert_allclose(cut.corner_uvs, points[..., :2] * 3 + 1, atol=1e-5)
    np.testing.assert_allclose(cut.corner_colors, points, atol=1e-6)
    inside = np.all((corners >= low) & (corners <= high), (1, 2))
    assert inside.any()
    np.testing.assert_array_equal(points[: inside.sum()], corners[inside])
    samples = rng.random((200, 20000, 2))
    weights = np.sqrt(samples[..., :1]) * np.concatenate([1 - samples[..., 1:], samples[..., 1:]], -1)
    places = corners[:, :1] + weights[..., :1] * (corners[:, 1:2] - corners[:, :1])
    places = places + weights[..., 1:] * (corners[:, 2:] - corners[:, :1])
    share = np.all((places >= low) & (places <= high), -1).mean(1)
    areas = 0.5 * np.linalg.norm(lit.cross_of(corners), axis=-1)
    found = np.bincount(cut.materials, 0.5 * np.linalg.norm(lit.cross_of(points), axis=-1), 200)
    np.testing.assert_allclose(found, areas * share, atol=0.012)


def test_what_is_not_closed_is_left_as_it_is():
    """A room without its ceiling, a camera outside, objects inside: the very scene comes back."""
    open_room = room(shelf(10.0))
    walls = lit.room(0.4)
    walls = walls[walls[..., 1].min(1) < 0.89]
    open_room = replace(open_room, meshes=(lit.mesh(walls), *open_room.meshes[1:]))
    assert within_enclosure(open_room) is open_room
    outside = replace(room(shelf(10.0)), camera=lit.look_at((0.5, 0.5, 3.0), (0.5, 0.5, 0.5)))
    assert within_enclosure(outside) is outside
    inside = room(ball())
    assert within_enclosure(inside) is inside
    beyond = room(shelf(10.0), lit.mesh(lit.ball((5, 5, 5), 0.5, 6), Role.SYNTHETIC))
    assert len(within_enclosure(beyond).meshes) == 2


OVER_THE_FLOOR, IN_THE_AIR = (0.5, 0.202, 0.42), (0.5, 0.32, 0.42)


def lantern(walls: str, center: tuple[float, float, float], half: float = 0.1, thickness: float = 0.01):
    """A closed synthetic box or ball around ``center``: of one sheet, or of an outer and an inner one."""
    if walls == "ball":
        return lit.mesh(lit.ball(center, half, 10), Role.SYNTHETIC, 0)
    sheets = [lit.cuboid(center, half)]
    if walls == "thick":
        sheets.append(lit.cuboid(center, half - thickness)[:, ::-1])
    return lit.mesh(np.concatenate(sheets), Role.SYNTHETIC, 0)


FINE = {"volume__resolution": 96, "volume__coarse": 64, "rsm__texels": 256}


def lit_from_inside(walls: str, center: tuple[float, float, float], method: str, **settings):
    """The room with a new lamp in a closed object, and with the lamp alone; a small ball lies in a corner."""
    light = Light(LightKind.POINT, (1.0, 1.0, 1.0), position=center, role=LightRole.ADDED)
    corner = lit.mesh(lit.ball((0.2, 0.2, 0.3), 0.03, 4), Role.SYNTHETIC, 0)
    return [
        numbers(room(*objects, lights=(light,)), method, **settings)
        for objects in ((lantern(walls, center), corner), (corner,))
    ]


@pytest.mark.parametrize(
    ("walls", "center", "patches", "most"),
    [
        ("sheet", IN_THE_AIR, 256, 1e-4),
        ("thick", IN_THE_AIR, 256, 1e-4),
        ("ball", IN_THE_AIR, 256, 0.005),
        ("sheet", OVER_THE_FLOOR, 256, 0.02),
        ("thick", OVER_THE_FLOOR, 256, 0.01),
        ("sheet", OVER_THE_FLOOR, 4096, 0.01),
        ("ball", OVER_THE_FLOOR, 4096, 0.015),
    ],
)
def test_a_lamp_in_a_closed_object_lights_nothing_else(walls, center, patches, most):
    """Eight bounces, over the light that it sends into the room without the object. 256 patches are as large as the
    object. What is left at the floor is in voxels that hold it and the object's lining, which face the same way."""
    fine = FINE if patches > 256 else {}
    closed, free = lit_from_inside(walls, center, "rays", bounces=8, patches__count=patches, **fine)
    assert closed.picture.mean() < most * free.picture.mean()


@pytest.mark.parametrize("walls", ["sheet", "ball"])
def test_cones_do_not_see_the_lining_of_the_surface_that_they_leave(walls):
    """Of a closed object with a lamp in it the outside is dark; half of the light showed on it. Other surfaces see the
    lining in coarse voxels, as they see what is behind any wall that fills a voxel in part: a quarter of the light."""
    closed, free = lit_from_inside(walls, IN_THE_AIR, "cones", bounces=1, shadows="ray", **FINE)
    lit_room = free.picture[free.layers.mask_real > 0.99].mean()
    assert closed.picture[closed.layers.mask_synthetic > 0.5].mean() < 0.05 * lit_room

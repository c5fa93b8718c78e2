"""Split-injection: a voxel's radiosity depends on neither resolution, and after - before is exactly what was split."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct.passes.injection import empty_flux, inject
from warp_dvct.passes.pyramid import light_faces
from warp_dvct.passes.rsm import render_rsm
from warp_dvct.scene import Light, LightKind, LightRole, Role

RADIUS = 0.5 * np.sqrt(3.0)
ALBEDO = np.array(lit.GREY.base_color)
I = np.array([2.0, 3.0, 4.0])  # noqa: E741
FACES = np.concatenate([[s * lit.EYES[k] for s in (1, -1)] for k in range(3)])


def injected(launcher, scene, n, size, seed=0):
    """Voxels, the RSM pair, and the flux per record, face and solution: ``[records, 6, 2, 3]``."""
    device_scene = lit.upload(launcher, scene)
    voxels = lit.voxels_of(launcher, device_scene, n)
    maps = render_rsm(launcher, device_scene, 0, size, center=(0.5, 0.5, 0.5), radius=RADIUS, start=3.0, seed=seed)
    flux = empty_flux(launcher, voxels)
    assert not flux.numpy().any()
    inject(launcher, voxels, maps, flux)
    return voxels, maps, flux


def by_face(voxels, flux) -> np.ndarray:
    return flux.numpy()[: voxels.level_records[0] * 12].reshape(-1, 6, 2, 3).astype(float)


def point(position=(0.5, 0.9, 0.5), **more) -> Light:
    return Light(LightKind.POINT, tuple(I), position=position, **more)


FLOOR = lit.rectangle((0.5, 0.13, 0.5), (0, 0, 0.45), (0.45, 0, 0))


@pytest.mark.parametrize(("n", "size"), [(16, 256), (16, 1024), (64, 1024)])
def test_floor_under_a_point_light(launcher, n, size):
    """Radiosity is albedo * I cos / d^2 for any map and volume, within the noise of a voxel's border texels.

    Of t stratified texels about .9 t^(1/4) more or fewer than expected fall into a voxel.
    """
    scene = lit.scene_of(lit.mesh(FLOOR), lights=(point(),))
    voxels, _, flux = injected(launcher, scene, n, size)
    light_faces(launcher, voxels, flux)
    up = lit.field_of(voxels, 0)[:, :, :, 2, 1]
    layer = int(0.13 * n)
    assert not up[:, :layer].any()
    assert not up[:, layer + 1 :].any()
    up = up[:, layer]
    full = up[..., 3] > 0.999
    assert full.sum() > 0.7 * n * n
    x = ((np.arange(n) + 0.5) / n - 0.5) ** 2
    d2 = x[:, None] + x[None, :] + 0.77**2
    expected = 0.77 / d2**1.5
    ratio = up[..., :3] / (ALBEDO * I) / expected[..., None]
    noise = 0.9 * np.mean((size**2 * expected / n**2 / (4 * np.pi))[full]) ** -0.75
    assert ratio[full].mean() == pytest.approx(1.0, abs=1e-3 + 2 * noise / np.sqrt(full.sum()))
    assert np.sqrt(((ratio[full] - 1) ** 2).mean()) < noise + 3e-3


def test_radiosity_of_slanted_surfaces_is_the_same_on_each_face(launcher):
    """A turned plate lit by parallel light: every face that shows it has its one radiosity."""
    plate = lit.rectangle((0, 0, 0), (0, 0, 0.3), (0.3, 0, 0)) @ lit.turned(35.0).T + lit.CENTER
    normal = lit.cross_of(plate)[0] / np.linalg.norm(lit.cross_of(plate)[0])
    sun = Light(
        LightKind.DISTANT,
        tuple(I),
        direction=tuple(
            -normal * 0.8 + 0.6 * np.cross(normal, lit.EYES[0]) / np.linalg.norm(np.cross(normal, lit.EYES[0]))
        ),
    )
    voxels, _, flux = injected(launcher, lit.scene_of(lit.mesh(plate), lights=(sun,)), 12, 1024)
    light_faces(launcher, voxels, flux)
    field = voxels.field()[: voxels.level_records[0], :, 1].astype(float)
    area = lit.areas(voxels)[..., 1]
    shown = area > 0.1
    assert sorted(np.unique(np.argwhere(shown)[:, 1])) == sorted(np.flatnonzero(FACES @ normal > 0.1))
    radiosity = field[..., :3][shown] / field[..., 3:][shown]
    weight = area[shown] / area[shown].sum()
    np.testing.assert_allclose(weight @ radiosity, ALBEDO * I * 0.8, rtol=5e-3)
    assert np.abs(radiosity / (ALBEDO * I * 0.8) - 1).max() < 0.12


def face_sums(maps, name: str, chosen: np.ndarray) -> np.ndarray:
    """Flux times max(0, n . e) per face over chosen texels: ``[6, 3]``."""
    normal = getattr(maps, f"normal_{name}").numpy()[chosen].astype(float)
    flux = getattr(maps, f"flux_{name}").numpy()[chosen].astype(float)
    return np.maximum(FACES @ normal.T, 0) @ flux


def split_scene(role=LightRole.PLATE, object_role=Role.SYNTHETIC):
    return lit.scene_of(
        lit.mesh(lit.room(0.36, 12.0)),
        lit.mesh(lit.ball((0.5, 0.45, 0.5), 0.14, 32), object_role),
        lights=(point((0.5, 0.75, 0.45), role=role),),
    )


@pytest.mark.parametrize("n", [8, 37, 64])
def test_no_flux_is_lost_or_made(launcher, n):
    """Every texel inside the grid lands in a voxel, split over its faces by max(0, n . e)."""
    voxels, maps, flux = injected(launcher, split_scene(), n, 128)
    held = by_face(voxels, flux).sum(0) * voxels.box.voxel**2
    for solution, name in enumerate(("before", "after")):
        roles = getattr(maps, f"role_{name}").numpy()
        assert (roles >= 0).all(), "the room is closed"
        np.testing.assert_allclose(held[:, solution], face_sums(maps, name, roles >= 0), rtol=2e-4)


def test_after_minus_before_is_what_was_split(launcher):
    """V-delta = V-rho - V-mu at level 0: +flux on the object, -flux on the real surface behind it, else nothing."""
    voxels, maps, flux = injected(launcher, split_scene(), 24, 128)
    split = maps.role_after.numpy() == 1
    assert 100 < split.sum() < 128**2 / 2
    delta = by_face(voxels, flux)
    delta = delta[:, :, 1] - delta[:, :, 0]
    expected = face_sums(maps, "after", split) - face_sums(maps, "before", split)
    np.testing.assert_allclose(delta.sum(0) * voxels.box.voxel**2, expected, atol=2e-4 * np.abs(expected).max())
    # A twin of the split texels alone, voxel by voxel.
    twin = np.zeros((24, 24, 24, 6, 3))
    for sign, name in ((1, "after"), (-1, "before")):
        p, n, f = (getattr(maps, f"{x}_{name}").numpy()[split].astype(float) for x in ("position", "normal", "flux"))
        share = np.maximum(n @ FACES.T, 0)[..., None] * f[:, None]
        np.add.at(twin, tuple(np.floor(p * 24).astype(int).T), sign * share / voxels.box.voxel**2)
    got = lit.dense(voxels, delta)
    assert np.abs(got - twin).max() < 1e-4 * np.abs(twin).max()
    assert (got > 0.01).any()
    assert (got < -0.01).any()


def test_voxels_without_split_texels_are_equal_bit_for_bit(launcher):
    """Even where both solutions sum thousands of texels."""
    voxels, maps, flux = injected(launcher, split_scene(), 24, 256)
    split = maps.role_after.numpy() == 1
    touched = np.zeros((24, 24, 24), bool)
    for name in ("after", "before"):
        cells = np.floor(getattr(maps, f"position_{name}").numpy()[split].astype(float) * 24 + 1e-4)
        touched[tuple(cells.astype(int).T)] = True
        touched[tuple(np.floor(cells - 2e-4).astype(int).T)] = True
    values = lit.dense(voxels, by_face(voxels, flux))[~touched]
    assert values.any()
    np.testing.assert_array_equal(values[:, :, 0], values[:, :, 1])


def test_nothing_synthetic_means_no_delta_at_all(launcher):
    voxels, _, flux = injected(launcher, split_scene(object_role=Role.REAL), 24, 128)
    values = by_face(voxels, flux)
    assert values.any()
    np.testing.assert_array_equal(values[:, :, 0], values[:, :, 1])


def test_an_added_light_is_all_after(launcher):
    voxels, maps, flux = injected(launcher, split_scene(LightRole.ADDED), 24, 128)
    values = by_face(voxels, flux)
    assert not values[:, :, 0].any()
    expected = face_sums(maps, "after", maps.role_after.numpy() >= 0)
    np.testing.assert_allclose(values[:, :, 1].sum(0) * voxels.box.voxel**2, expected, rtol=2e-4)


def test_lights_add_up(launcher):
    scene = split_scene()
    device_scene = lit.upload(launcher, scene)
    voxels = lit.voxels_of(launcher, device_scene, 16)
    maps = render_rsm(launcher, device_scene, 0, 64, center=(0.5, 0.5, 0.5), radius=RADIUS, start=3.0)
    flux = empty_flux(launcher, voxels)
    inject(launcher, voxels, maps, flux)
    once = flux.numpy().copy()
    inject(launcher, voxels, maps, flux)
    np.testing.assert_allclose(flux.numpy(), 2 * once, rtol=1e-6)


@pytest.mark.parametrize("wall", [0.5, 0.125, 7 / 16])
def test_walls_between_two_voxels_get_all_their_light(launcher, wall):
    """Hit points on such a wall round to either side; a one-sided wall fills one voxel layer only."""
    source = point((0.5, wall + 0.4, 0.5))
    floor = lit.rectangle((0.5, wall, 0.5), (0, 0, 0.5), (0.5, 0, 0))
    voxels, maps, flux = injected(launcher, lit.scene_of(lit.mesh(floor), lights=(source,)), 16, 200)
    inside = maps.role_after.numpy() == 0
    p = maps.position_after.numpy()[inside]
    assert np.abs(p[:, 1] - wall).max() < 1e-6
    held = by_face(voxels, flux).sum(0)[2, 1] * voxels.box.voxel**2
    np.testing.assert_allclose(held, face_sums(maps, "after", inside)[2], rtol=2e-4)


def test_light_outside_the_grid_is_dropped(launcher):
    wide = lit.rectangle((0.5, 0.13, 0.5), (0, 0, 3.0), (3.0, 0, 0))
    voxels, maps, flux = injected(launcher, lit.scene_of(lit.mesh(wide), lights=(point(),)), 16, 256)
    p = maps.position_after.numpy()
    inside = (maps.role_after.numpy() == 0) & (np.abs(p - 0.5).max(-1) < 0.5)
    assert 0 < inside.sum() < (maps.role_after.numpy() == 0).sum()
    held = by_face(voxels, flux).sum(0)[2, 1] * voxels.box.voxel**2
    np.testing.assert_allclose(held, face_sums(maps, "after", inside)[2], rtol=2e-4)

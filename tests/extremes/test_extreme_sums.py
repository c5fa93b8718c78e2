"""Sums of very many numbers keep their digits, in whatever order they come: against float64."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest
import warp as wp

from warp_dvct.bench.twins.volumes import next_level
from warp_dvct.launch import Launcher
from warp_dvct.passes.injection import empty_flux, inject
from warp_dvct.passes.pyramid import build_pyramid, light_faces
from warp_dvct.passes.rsm import ShadowMaps
from warp_dvct.scene import Role

EDGE = 3163  # texels: 10^7 of them
FLOOR = lit.rectangle((0.5, 0.53, 0.5), (0.5, 0, 0), (0, 0, -0.5))


def contributions(order: str) -> tuple[np.ndarray, np.ndarray]:
    """Places on the floor and fluxes over six decades, 10^7 of each, sorted or shuffled: ``[n, 3]``, ``[n]``."""
    rng = np.random.default_rng(5)
    flux = (10.0 ** rng.uniform(-3, 3, EDGE * EDGE)).astype(np.float32)
    place = rng.random((EDGE * EDGE, 3), dtype=np.float32)
    place[:, 1] = 0.53
    rank = {"rising": np.argsort(flux), "falling": np.argsort(-flux), "shuffled": slice(None)}[order]
    return place[rank], flux[rank]


@pytest.mark.parametrize(("n", "order"), [(1, "rising"), (1, "falling"), (16, "shuffled")])
def test_injection_and_filtering_of_ten_million_contributions(n, order):
    """To 1e-5: each voxel's flux, and at every level of the isotropic pyramid the sum over voxels."""
    launcher = Launcher("cpu", 2)
    voxels = lit.voxels_of(launcher, lit.upload(launcher, lit.scene_of(lit.mesh(FLOOR))), n)
    place, flux = contributions(order)
    count = len(flux)
    position = launcher.array(place, wp.vec3)
    normal = launcher.full(count, wp.vec3(0.0, 1.0, 0.0), wp.vec3)
    sent = launcher.array(np.stack([flux, 2 * flux, 0.1 * flux], 1), wp.vec3)
    role = launcher.zeros(count, wp.int32)
    maps = ShadowMaps(EDGE, position, normal, sent, role, position, normal, sent, role)
    got = empty_flux(launcher, voxels)
    inject(launcher, voxels, maps, got)

    cell = np.minimum((place * n).astype(int), n - 1)
    each = np.bincount(cell[:, 0] * n + cell[:, 2], flux.astype(float), n * n).reshape(n, n) * n * n
    values = got.numpy()[: voxels.level_records[0] * 12].reshape(-1, 6, 2, 3).astype(float)
    dense = lit.dense(voxels, values)[:, int(0.53 * n), :, 2]
    for solution in range(2):
        np.testing.assert_allclose(dense[:, :, solution], each[..., None] * [1.0, 2.0, np.float32(0.1)], rtol=1e-5)

    light_faces(launcher, voxels, got, filter="isotropic")
    build_pyramid(launcher, voxels, filter="isotropic")
    for level in range(len(voxels.level_records)):
        field = lit.field_of(voxels, level)[:, :, :, 2, 1]
        scale = 8.0**level / (n * n)
        np.testing.assert_allclose(field[..., 0].sum() * scale, flux.astype(float).sum(), rtol=1e-5)


def on_surface(triangles: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points drawn by area and their normals, both float32 ``[count, 3]``."""
    cross = lit.cross_of(triangles)
    size = np.linalg.norm(cross, axis=-1)
    chosen = rng.choice(len(triangles), count, p=size / size.sum())
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    a, b, c = triangles[chosen].transpose(1, 0, 2)
    return (a + u * (b - a) + v * (c - a)).astype(np.float32), (cross / size[:, None]).astype(np.float32)[chosen]


def face_shares(normal: np.ndarray) -> np.ndarray:
    """max(0, n . e) of the six faces."""
    return np.maximum(np.stack([s * normal[:, k] for k in range(3) for s in (1, -1)], 1), 0.0)


def test_the_directional_pyramid_of_ten_million_contributions():
    """To 1e-5 of each value of every level: a synthetic box over a floor, both tilted, fluxes over six decades, largest
    first; against sums, quotients and front-to-back compositing in float64 from the first level to the last."""
    launcher, n, places, rng = Launcher("cpu", 2), 8, 20_000, np.random.default_rng(7)
    floor, box = lit.cuboid((0.5, 0.25, 0.5), (0.36, 0.05, 0.36), 17.0), lit.cuboid((0.52, 0.55, 0.47), 0.17, 31.0)
    scene = lit.scene_of(lit.mesh(floor), lit.mesh(box, Role.SYNTHETIC))
    voxels = lit.voxels_of(launcher, lit.upload(launcher, scene), n)
    area = lit.dense(voxels, lit.areas(voxels))

    _, flux = contributions("falling")
    count = len(flux)
    chosen = rng.integers(places, size=count, dtype=np.int32)
    # Behind each point of the box lies one of the floor; the others are seen before and after.
    before, hidden = on_surface(floor, places, rng), rng.random(places) < 0.4
    pairs = zip(on_surface(box, places, rng), before, strict=True)
    after = tuple(np.where(hidden[:, None], new, old) for new, old in pairs)
    sent = launcher.array(np.stack([flux, 2 * flux, np.float32(0.1) * flux], 1), wp.vec3)
    maps, power = [], np.zeros((n**3, 6, 2))
    each = np.bincount(chosen, flux.astype(float), places)
    for solution, (place, normal) in ((1, after), (0, before)):
        x, y, z = (place * np.float32(n)).astype(int).T
        cell, shares = (x * n + y) * n + z, face_shares(normal)
        # Not those whose voxel holds, rounded, none of their surface.
        seen = ((shares > 0.0) & (area[..., solution].reshape(-1, 6)[cell] > 0.0)).any(1)
        assert seen.mean() > 0.99
        role = np.where(seen, hidden if solution else 0, -1).astype(np.int32)
        np.add.at(power[..., solution], cell[seen], n * n * each[seen, None] * shares[seen])
        maps += [launcher.array(values[chosen], wp.vec3) for values in (place, normal)]
        maps += [sent, launcher.array(role[chosen], wp.int32)]
    got = empty_flux(launcher, voxels)
    inject(launcher, voxels, ShadowMaps(EDGE, *maps), got)
    light_faces(launcher, voxels, got)
    build_pyramid(launcher, voxels)

    colours = power.reshape(n, n, n, 6, 2, 1) * np.array([1.0, 2.0, np.float32(0.1)])
    alpha = np.minimum(area, 1.0)[..., None]
    lined = area[..., None] > 0.0
    colours = np.where(lined, colours * alpha / np.where(lined, area[..., None], 1.0), 0.0)
    expected = np.concatenate([colours, alpha], -1)
    assert len(voxels.level_records) == 4
    for level in range(4):
        np.testing.assert_allclose(lit.field_of(voxels, level), expected, rtol=1e-5, err_msg=f"level {level}")
        expected = next_level(expected)


def test_areas_of_a_million_fragments_in_one_voxel(launcher):
    """To 1e-5, with sizes over three decades, largest first, which loses the small ones in float32."""
    rng = np.random.default_rng(6)
    size = np.sort(10.0 ** rng.uniform(-5, -2, 10**6))[::-1]
    corners = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0]]) * size[:, None, None]
    corners = (corners + rng.uniform(0.1, 0.9, (10**6, 1, 3))).astype(np.float32).astype(float)
    voxels = lit.voxels_of(launcher, lit.upload(launcher, lit.scene_of(lit.mesh(corners))), 1)
    np.testing.assert_allclose(lit.areas(voxels)[0, :, 0], lit.face_areas(corners), rtol=1e-5, atol=1e-9)

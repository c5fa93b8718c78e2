"""Sums of very many numbers keep their digits, in whatever order they come: against float64."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest
import warp as wp

from warp_dvct.launch import Launcher
from warp_dvct.passes.injection import empty_flux, inject
from warp_dvct.passes.pyramid import build_pyramid, light_faces
from warp_dvct.passes.rsm import ShadowMaps

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


def test_areas_of_a_million_fragments_in_one_voxel(launcher):
    """To 1e-5, with sizes over three decades, largest first, which loses the small ones in float32."""
    rng = np.random.default_rng(6)
    size = np.sort(10.0 ** rng.uniform(-5, -2, 10**6))[::-1]
    corners = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0]]) * size[:, None, None]
    corners = (corners + rng.uniform(0.1, 0.9, (10**6, 1, 3))).astype(np.float32).astype(float)
    voxels = lit.voxels_of(launcher, lit.upload(launcher, lit.scene_of(lit.mesh(corners))), 1)
    np.testing.assert_allclose(lit.areas(voxels)[0, :, 0], lit.face_areas(corners), rtol=1e-5, atol=1e-9)

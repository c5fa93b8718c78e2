"""The lit field and its pyramid against a dense NumPy twin, and what each filter does to a wall."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest
import warp as wp

from warp_dvct.errors import OptionError
from warp_dvct.passes.pyramid import build_pyramid, light_faces
from warp_dvct.scene import Role


def voxelized(launcher, n, *meshes):
    return lit.voxels_of(launcher, lit.upload(launcher, lit.scene_of(*meshes)), n)


def fill(launcher, n, filter, radiosity=(1.0, 2.0, 3.0), *meshes):
    voxels = voxelized(launcher, n, *meshes)
    light_faces(launcher, voxels, lit.uniform_flux(launcher, voxels, radiosity), filter=filter)
    build_pyramid(launcher, voxels, filter=filter)
    return voxels


def wall(axis: int, at: float) -> np.ndarray:
    center = lit.CENTER.copy()
    center[axis] = at
    return lit.rectangle(center, 0.5 * lit.EYES[(axis + 1) % 3], 0.5 * lit.EYES[(axis + 2) % 3])


@pytest.mark.parametrize("at", [0.02, 0.37, 0.5, 0.99])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_thin_wall_stays_opaque_seen_straight_on(launcher, axis, at):
    """Its front keeps alpha 1 and its radiosity at every level; its back and its sides stay empty."""
    voxels = fill(launcher, 32, "directional", (1.0, 2.0, 3.0), lit.mesh(wall(axis, at)))
    for level in range(6):
        field = lit.field_of(voxels, level)
        occupied = field[..., 2 * axis, 1, 3] > 0
        assert occupied.sum() == (32 >> level) ** 2
        np.testing.assert_allclose(
            field[occupied][:, 2 * axis], np.broadcast_to([1, 2, 3, 1], (occupied.sum(), 2, 4)), rtol=1e-4
        )
        others = [f for f in range(6) if f != 2 * axis]
        assert not field[..., others, :, :].any()


def test_a_thin_wall_fades_under_the_isotropic_filter(launcher):
    """The paper's filter: at level k a wall one voxel thick has alpha 2^-k."""
    voxels = fill(launcher, 32, "isotropic", (1.0, 2.0, 3.0), lit.mesh(wall(1, 0.37)))
    for level in range(6):
        field = lit.field_of(voxels, level)
        values = field[field[..., 0, 1, 3] > 0]
        np.testing.assert_allclose(
            values, np.broadcast_to(np.array([1, 2, 3, 1]) * 0.5**level, values.shape), rtol=1e-4
        )


@pytest.mark.parametrize("degrees", [0.0, 27.0])
def test_isotropic_levels_keep_the_sum_over_voxels(launcher, degrees):
    voxels = fill(launcher, 32, "isotropic", (1.0, 2.0, 3.0), lit.mesh(lit.room(0.4, degrees)))
    total = lit.field_of(voxels, 0).sum((0, 1, 2))
    for level in range(1, 6):
        np.testing.assert_allclose(lit.field_of(voxels, level).sum((0, 1, 2)) * 8**level, total, rtol=1e-4)


@pytest.mark.parametrize("n", [32, 27, 100])
def test_directional_levels_keep_a_rooms_coverage(launcher, n):
    """A convex room hides none of its own front faces: each level shows the same projected area, however turned."""
    surface = lit.room(0.33, 27.0)
    voxels = fill(launcher, n, "directional", (1.0, 2.0, 3.0), lit.mesh(surface))
    exact = lit.face_areas(surface)
    for level in range(len(voxels.level_records)):
        shown = lit.field_of(voxels, level)[..., 1, :].sum((0, 1, 2)) * (voxels.box.voxel * 2**level) ** 2
        np.testing.assert_allclose(shown[:, 3], exact, rtol=0.02, err_msg=f"level {level}")
        np.testing.assert_allclose(shown[:, :3] / shown[:, 3:], np.broadcast_to([1, 2, 3], (6, 3)), rtol=1e-4)


def test_hidden_surfaces_drop_out(launcher):
    """Two walls that face the same way, in neighbouring voxels: the next level shows the front one alone."""
    first, second = wall(2, 4.5 / 8), wall(2, 5.5 / 8)
    voxels = voxelized(launcher, 8, lit.mesh(first), lit.mesh(second, Role.SYNTHETIC))
    flux = np.zeros((voxels.level_records[0], 6, 2, 3))
    grid = lit.look_up(voxels)
    flux[grid[:, :, 4], 4] = [[1, 1, 1], [1, 1, 1]]
    flux[grid[:, :, 5], 4] = [[0, 0, 0], [7, 7, 7]]
    light_faces(launcher, voxels, launcher.array(flux.reshape(-1, 3).astype(np.float32), wp.vec3))
    build_pyramid(launcher, voxels)
    coarse = lit.field_of(voxels, 1)[:, :, 2, 4]
    np.testing.assert_allclose(coarse[..., 0, :], np.broadcast_to([1, 1, 1, 1], coarse[..., 0, :].shape), rtol=1e-5)
    np.testing.assert_allclose(coarse[..., 1, :], np.broadcast_to([7, 7, 7, 1], coarse[..., 1, :].shape), rtol=1e-5)


def directional_twin(fine: np.ndarray) -> np.ndarray:
    """The next level of a dense field ``[x, y, z, face, solution, 4]``: pairs front over back, the mean of four."""
    n = fine.shape[0]
    extent = (n + 1) // 2
    padded = np.zeros((2 * extent,) * 3 + fine.shape[3:])
    padded[:n, :n, :n] = fine
    out = np.zeros((extent,) * 3 + fine.shape[3:])
    for face in range(6):
        axis, positive = face // 2, face % 2 == 0
        even, odd = (np.take(padded[..., face, :, :], np.arange(k, 2 * extent, 2), axis) for k in (0, 1))
        front, back = (odd, even) if positive else (even, odd)
        free = 1.0 - front[..., 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = np.where(back[..., 3:] > 0, np.clip(free / back[..., 3:], 0, 1), 0)
        both = front + back * seen
        shape = [(extent, 2) if k != axis else (extent, 1) for k in range(3)]
        out[..., face, :, :] = both.reshape(*(m for s in shape for m in s), *both.shape[3:]).mean((1, 3, 5))
    return out


def isotropic_twin(fine: np.ndarray) -> np.ndarray:
    n = fine.shape[0]
    extent = (n + 1) // 2
    padded = np.zeros((2 * extent,) * 3 + fine.shape[3:])
    padded[:n, :n, :n] = fine
    return padded.reshape(extent, 2, extent, 2, extent, 2, *fine.shape[3:]).mean((1, 3, 5))


@pytest.mark.parametrize(("filter", "twin"), [("directional", directional_twin), ("isotropic", isotropic_twin)])
@pytest.mark.parametrize("n", [8, 11])
def test_all_levels_of_a_random_field_match_numpy(launcher, filter, twin, n):
    rng = np.random.default_rng(n)
    triangles = rng.uniform(0, 1, (6, 1, 3)) + rng.normal(0, 0.25, (6, 3, 3))
    voxels = voxelized(launcher, n, lit.mesh(triangles))
    level0 = voxels.level_records[0]
    field = np.zeros((sum(voxels.level_records), 6, 2, 4), np.float32)
    alpha = rng.uniform(0, 1, (level0, 6, 2, 1)) * rng.choice([0, 1], (level0, 6, 2, 1))
    field[:level0] = np.concatenate([alpha * rng.lognormal(0, 1, (level0, 6, 2, 3)), alpha], -1)
    voxels.volume.field.assign(field.swapaxes(0, 1).reshape(-1, 4))
    build_pyramid(launcher, voxels, filter=filter)
    expected = lit.field_of(voxels, 0)
    assert len(voxels.level_records) == 4 + (n > 8)
    for level in range(1, len(voxels.level_records)):
        expected = twin(expected)
        np.testing.assert_allclose(lit.field_of(voxels, level), expected, rtol=1e-4, atol=1e-5)


def test_radiosity_is_flux_over_area_and_coverage_is_clamped(launcher):
    """Three one-sided sheets in one voxel cover it once; their radiosity is the mean over their areas."""
    sheets = [lit.mesh(wall(1, (4 + f) / 8)) for f in (0.2, 0.5, 0.8)]
    voxels = voxelized(launcher, 8, *sheets)
    assert lit.areas(voxels)[:, 2, 1] == pytest.approx(3.0, abs=1e-4)
    light_faces(launcher, voxels, lit.uniform_flux(launcher, voxels, (1.0, 2.0, 3.0)))
    field = lit.field_of(voxels, 0)[:, 4, :, 2]
    np.testing.assert_allclose(field, np.broadcast_to([1, 2, 3, 1], field.shape), rtol=1e-4)


def test_isotropic_voxels_are_wholly_occupied(launcher):
    voxels = voxelized(launcher, 8, lit.mesh(lit.room(0.3, 20.0)), lit.mesh(lit.ball(lit.CENTER, 0.1), Role.SYNTHETIC))
    light_faces(launcher, voxels, lit.uniform_flux(launcher, voxels, [[1, 2, 3], [4, 5, 6]]), filter="isotropic")
    field = lit.field_of(voxels, 0)
    area = lit.dense(voxels, lit.areas(voxels)).sum(3)
    for solution, radiosity in enumerate(([1, 2, 3, 1], [4, 5, 6, 1])):
        values = field[area[..., solution] > 0][:, :, solution]
        np.testing.assert_allclose(values, np.broadcast_to(radiosity, values.shape), rtol=1e-4)
        assert not field[area[..., solution] == 0][:, :, solution].any()


def test_unknown_filter_names_the_choices(launcher):
    voxels = voxelized(launcher, 4, lit.mesh(lit.room(0.3)))
    with pytest.raises(OptionError, match="'gauss'; choose one of directional, isotropic"):
        build_pyramid(launcher, voxels, filter="gauss")

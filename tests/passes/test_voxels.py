"""Voxelisation: exact areas, watertight columns, the split by role, and brick maps that hold what is occupied."""

from __future__ import annotations

import itertools

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct.scene import Role

FACES = [(k, s) for k in range(3) for s in (1.0, -1.0)]


def clip(polygon: list[np.ndarray], axis: int, bound: float, sign: float) -> list[np.ndarray]:
    """The part of a polygon where sign * p[axis] <= sign * bound."""
    kept = []
    for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        a, b = sign * (bound - p[axis]), sign * (bound - q[axis])
        if a >= 0:
            kept.append(p)
        if a * b < 0:
            kept.append(p + (q - p) * a / (a - b))
    return kept


def area_in_cube(triangle: np.ndarray, low: np.ndarray, edge: float) -> float:
    """Area of the part of a triangle in a cube, float64."""
    polygon = list(triangle)
    for axis in range(3):
        polygon = clip(polygon, axis, low[axis], -1.0)
        polygon = clip(polygon, axis, low[axis] + edge, 1.0) if polygon else polygon
        if not polygon:
            return 0.0
    fan = [np.cross(p - polygon[0], q - polygon[0]) for p, q in itertools.pairwise(polygon[1:])]
    return 0.5 * float(np.linalg.norm(np.sum(fan, 0))) if fan else 0.0


def twin(triangles, roles, sides, n) -> np.ndarray:
    """Every triangle against every voxel of the unit cube: ``[x, y, z, face, solution]`` in voxel faces.

    What real and synthetic surfaces have together beyond a whole face is hidden by the other.
    """
    out = np.zeros((n, n, n, 6, 2))
    unit = lit.cross_of(triangles)
    unit = unit / np.linalg.norm(unit, axis=-1, keepdims=True)
    for triangle, normal, role, both in zip(triangles, unit, roles, sides, strict=True):
        for cell in np.ndindex(n, n, n):
            area = area_in_cube(triangle, np.array(cell) / n, 1.0 / n) * n * n
            if area > 0:
                shown = np.array([abs(normal[k]) if both else max(0.0, s * normal[k]) for k, s in FACES])
                out[cell][:, 1] += area * shown
                if role == Role.REAL:
                    out[cell][:, 0] += area * shown
    real, synthetic = out[..., 0], out[..., 1] - out[..., 0]
    out[..., 1] = np.minimum(real + synthetic, np.maximum(np.maximum(real, synthetic), 1.0))
    return out


def voxelized(launcher, n, *meshes, **box):
    return lit.voxels_of(launcher, lit.upload(launcher, lit.scene_of(*meshes)), n, **box)


def summed(voxels) -> np.ndarray:
    """Projected area per face of all voxels, ``[6, 2]``, in volume units."""
    return lit.areas(voxels).sum(0) * voxels.box.voxel**2


@pytest.mark.parametrize("n", [1, 2, 3, 5, 64, 100, 256])
@pytest.mark.parametrize("degrees", [0.0, 33.0])
def test_faces_sum_to_the_projected_surface(launcher, n, degrees):
    surface = np.concatenate([lit.room(0.28, degrees), lit.ball((0.47, 0.52, 0.5), 0.14, 12)])
    voxels = voxelized(launcher, n, lit.mesh(surface))
    expected = lit.face_areas(surface)
    np.testing.assert_allclose(summed(voxels), np.stack([expected, expected], 1), rtol=1e-4)
    pieces = voxels.fragments
    held = pieces.place.numpy()[pieces.order.numpy()[: pieces.count], 3].sum() * voxels.box.voxel**2
    assert held == pytest.approx(lit.area_of(surface), rel=1e-4)


@pytest.mark.parametrize("n", [1, 3, 5, 9])
def test_matches_brute_force_clipping(launcher, n):
    rng = np.random.default_rng(n)
    triangles = rng.uniform(-0.3, 1.3, (12, 3, 3))
    triangles[:6] = rng.uniform(0.1, 0.9, (6, 1, 3)) + rng.normal(0, 0.06, (6, 3, 3))
    parts = [
        lit.mesh(triangles[:4]),
        lit.mesh(triangles[4:8], double_sided=True),
        lit.mesh(triangles[8:10], Role.SYNTHETIC),
        lit.mesh(triangles[10:], Role.SYNTHETIC, double_sided=True),
    ]
    voxels = voxelized(launcher, n, *parts)
    roles = [Role.REAL] * 8 + [Role.SYNTHETIC] * 4
    sides = [False] * 4 + [True] * 4 + [False] * 2 + [True] * 2
    expected = twin(triangles.astype(np.float32).astype(float), roles, sides, n)
    np.testing.assert_allclose(lit.dense(voxels, lit.areas(voxels)), expected, rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize(("n", "degrees"), [(16, 0.0), (33, 25.0), (64, 40.0)])
def test_columns_through_closed_objects_are_watertight(launcher, n, degrees):
    """Each column of voxels sees as much front as back, and exactly its share of a convex object's silhouette."""
    for surface in (lit.cuboid((0.51, 0.5, 0.48), (0.3, 0.21, 0.23), degrees), lit.ball((0.5, 0.5, 0.5), 0.37, 20)):
        voxels = voxelized(launcher, n, lit.mesh(surface))
        grid = lit.dense(voxels, lit.areas(voxels))[..., 1]
        for axis in range(3):
            front, back = (grid[..., 2 * axis + k].sum(axis) for k in (0, 1))
            np.testing.assert_allclose(front, back, atol=5e-4)
            assert front.max() < 1 + 1e-4, "a convex object covers a column at most once"
            inner = np.lib.stride_tricks.sliding_window_view(front > 0, (3, 3)).all((2, 3))
            assert inner.sum() > 4
            np.testing.assert_allclose(front[1:-1, 1:-1][inner], 1.0, atol=5e-4)


def test_silhouette_of_an_aligned_box_is_the_product_of_overlaps(launcher):
    n, center, half = 20, np.array([0.513, 0.47, 0.52]), np.array([0.231, 0.118, 0.307])
    voxels = voxelized(launcher, n, lit.mesh(lit.cuboid(center, half)))
    grid = lit.dense(voxels, lit.areas(voxels))[..., 1]
    edges = np.arange(n + 1) / n
    span = [
        np.clip(np.minimum(edges[1:], c + h) - np.maximum(edges[:-1], c - h), 0, None) * n
        for c, h in zip(center, half, strict=True)
    ]
    for axis in range(3):
        others = [span[k] for k in range(3) if k != axis]
        np.testing.assert_allclose(grid[..., 2 * axis].sum(axis), np.outer(*others), atol=1e-4)


@pytest.mark.parametrize("n", [1, 2, 3, 5, 7, 64, 100])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_triangles_on_voxel_walls_are_counted_once(launcher, n, axis):
    """Also on the border of the grid, and turned so that the triangle's own edges lie on walls."""
    x, y = 0.5 * lit.EYES[(axis + 1) % 3], 0.5 * lit.EYES[(axis + 2) % 3]
    walls = sorted({0, 1, n // 2, n - 1, n})
    for wall in walls:
        center = lit.CENTER.copy()
        center[axis] = wall / n
        voxels = voxelized(launcher, n, lit.mesh(lit.rectangle(center, x, y)))
        area = lit.areas(voxels)[:, 2 * axis, 1]
        assert area.sum() / n**2 == pytest.approx(1.0, abs=1e-5), f"wall {wall}"
        np.testing.assert_allclose(area, 1.0, atol=1e-4)
        assert voxels.level_records[0] == n * n


def test_closed_box_on_the_grids_border_and_on_inner_walls(launcher):
    """The box that is the grid itself, and one whose faces all lie on walls between voxels."""
    for half, n in ((0.5, 8), (0.25, 8), (0.5, 5)):
        surface = lit.cuboid(lit.CENTER, half)
        voxels = voxelized(launcher, n, lit.mesh(surface))
        np.testing.assert_allclose(summed(voxels)[:, 1], lit.face_areas(surface), rtol=1e-5)
        for axis in range(3):
            columns = lit.dense(voxels, lit.areas(voxels))[..., 2 * axis, 1].sum(axis)
            np.testing.assert_allclose(columns[columns > 0], 1.0, atol=1e-5)


def test_outside_is_ignored_and_across_is_cut(launcher):
    outside = np.concatenate(
        [lit.ball((1.8, 0.5, 0.5), 0.3), lit.ball((0.5, -0.6, 0.5), 0.3), lit.ball((2, 2, -2), 0.5)]
    )
    empty = voxelized(launcher, 16, lit.mesh(outside))
    assert set(empty.level_records) == {0}
    assert (lit.look_up(empty) == -1).all()
    # A ball around the box's corner: an eighth of it is inside.
    surface = lit.ball((0, 0, 0), 0.4, 32)
    voxels = voxelized(launcher, 16, lit.mesh(surface))
    assert summed(voxels)[0, 1] == pytest.approx(lit.face_areas(surface)[0] / 4, rel=1e-3)
    assert summed(voxels)[1, 1] == pytest.approx(0, abs=1e-6)


def test_shifted_and_scaled_grid(launcher):
    surface = lit.ball((3.0, -2.0, 7.0), 1.5)
    voxels = voxelized(launcher, 24, lit.mesh(surface), low=(1.0, -4.0, 5.0), edge=4.0)
    np.testing.assert_allclose(summed(voxels)[:, 1], lit.face_areas(surface), rtol=1e-4)
    pieces = voxels.fragments
    place = pieces.place.numpy()[pieces.order.numpy()[: pieces.count], :3]
    distance = np.linalg.norm(place - [3.0, -2.0, 7.0], axis=-1)
    assert distance.max() < 1.5 + 1e-4, "centroids lie on the facets"
    assert distance.min() > 1.5 * np.cos(np.pi / 24) ** 2 - 1e-3


def test_no_triangles_at_all(launcher):
    voxels = voxelized(launcher, 8)
    assert set(voxels.level_records) == {0}
    assert (lit.look_up(voxels) == -1).all()


def test_slivers_keep_their_area_and_degenerate_ones_vanish(launcher):
    rng = np.random.default_rng(5)
    start, end = rng.uniform(0.05, 0.95, (2, 64, 3))
    for width, tolerance in ((1e-3, 1e-3), (1e-5, 2e-2)):  # float32 knows a place to 1e-7: 1 % of the thin ones
        needles = np.stack([start, end, end + width * rng.normal(size=(64, 3))], 1)
        voxels = voxelized(launcher, 64, lit.mesh(needles))
        np.testing.assert_allclose(
            summed(voxels)[:, 1], lit.face_areas(needles.astype(np.float32).astype(float)), rtol=tolerance
        )
    lines = np.stack([start, end, 0.5 * (start + end)], 1)
    dots = np.repeat(start[:, None], 3, 1)
    voxels = voxelized(launcher, 64, lit.mesh(np.concatenate([lines, dots])))
    assert np.isfinite(lit.areas(voxels)).all()
    assert summed(voxels).max() < 1e-6


@pytest.mark.parametrize("size", [3.0, 1e2, 1e4])
def test_huge_triangles(launcher, size):
    """A triangle much larger than the grid fills it with the plane's own area: float32 is what limits it."""
    plane = np.array([[-size, 0.3, -size], [size, 0.3, -size], [0.0, 0.3, 2 * size]])[None]
    flat = voxelized(launcher, 32, lit.mesh(plane))
    assert summed(flat)[3, 1] == pytest.approx(1.0, rel=1e-4 + 1e-7 * size * 32)
    tilted = (plane - [0, 0.3, 0]) @ lit.turned(30.0).T + lit.CENTER
    exact = area_in_cube(tilted[0], np.zeros(3), 1.0)
    normal = lit.cross_of(tilted)[0] / np.linalg.norm(lit.cross_of(tilted)[0])
    expected = [exact * max(0.0, s * normal[k]) for k, s in FACES]
    np.testing.assert_allclose(
        summed(voxelized(launcher, 32, lit.mesh(tilted)))[:, 1], expected, rtol=1e-3 + 1e-6 * size, atol=1e-6
    )


def test_synthetic_surfaces_are_in_after_alone(launcher):
    real, object_ = lit.room(0.4), lit.cuboid((0.5, 0.3, 0.5), 0.1, 20.0)
    voxels = voxelized(launcher, 40, lit.mesh(object_, Role.SYNTHETIC), lit.mesh(real))
    before, after = summed(voxels).T
    np.testing.assert_allclose(before, lit.face_areas(real), rtol=1e-5)
    np.testing.assert_allclose(after - before, lit.face_areas(object_), rtol=1e-3)
    alone = voxelized(launcher, 40, lit.mesh(real))
    grid = lit.dense(voxels, lit.areas(voxels))[..., 0]
    np.testing.assert_array_equal(grid, lit.dense(alone, lit.areas(alone))[..., 0])
    np.testing.assert_array_equal(lit.areas(alone)[..., 0], lit.areas(alone)[..., 1])


def test_double_sided_shows_on_both_faces(launcher):
    wall = lit.rectangle((0.5, 0.5, 0.37), (0.3, 0, 0), (0, 0.3, 0))
    np.testing.assert_allclose(summed(voxelized(launcher, 20, lit.mesh(wall)))[:, 1], [0, 0, 0, 0, 0.36, 0], atol=1e-6)
    both = summed(voxelized(launcher, 20, lit.mesh(wall, double_sided=True)))[:, 1]
    np.testing.assert_allclose(both, [0, 0, 0, 0, 0.36, 0.36], atol=1e-6)


@pytest.mark.parametrize("n", [1, 5, 16, 37, 100])
def test_brick_map_finds_exactly_what_is_occupied(launcher, n):
    """At every level; and each record is found once."""
    voxels = voxelized(launcher, n, lit.mesh(lit.room(0.37, 21.0)), lit.mesh(lit.ball((0.4, 0.5, 0.6), 0.2, 8)))
    occupied = twin_occupied(voxels, n)
    start = 0
    for level, count in enumerate(voxels.level_records):
        records = lit.look_up(voxels, level)
        np.testing.assert_array_equal(records >= 0, occupied)
        np.testing.assert_array_equal(np.sort(records[records >= 0]), np.arange(start, start + count))
        start += count
        extent = (len(occupied) + 1) // 2
        padded = np.zeros((2 * extent,) * 3, bool)
        padded[tuple(slice(0, k) for k in occupied.shape)] = occupied
        occupied = padded.reshape(extent, 2, extent, 2, extent, 2).any((1, 3, 5))
    assert len(lit.look_up(voxels, len(voxels.level_records) - 1)) == 1, "the last level is one voxel"


def twin_occupied(voxels, n) -> np.ndarray:
    """Voxels that hold fragments, by the fragments' centroids."""
    pieces = voxels.fragments
    place = pieces.place.numpy()[pieces.order.numpy()[: pieces.count], :3].astype(float) * n
    grid = np.zeros((n, n, n), bool)
    grid[tuple(np.clip(np.floor(place), 0, n - 1).astype(int).T)] = True
    return grid


def test_memory_follows_the_surface(launcher):
    """Twice the resolution takes four times the bytes (eight would be a dense volume)."""

    def size(n):
        volume = voxelized(launcher, n, lit.mesh(lit.ball(lit.CENTER, 0.45, 24))).volume
        return volume.field.capacity, volume.cells.capacity + volume.tables.capacity

    sizes = {n: size(n) for n in (64, 128, 256)}
    for small, large in ((64, 128), (128, 256)):
        assert 3.6 < sizes[large][0] / sizes[small][0] < 4.2
        assert sizes[large][1] / sizes[small][1] < 4.6
    assert sum(sizes[256]) < 0.1 * 256**3 * 12 * 16, "a tenth of what dense directional voxels take"


def test_same_result_for_any_thread_count(launcher):
    from warp_dvct.launch import Launcher

    results = []
    for threads in (1, 3):
        voxels = voxelized(Launcher(str(launcher.device), threads), 64, lit.mesh(lit.ball(lit.CENTER, 0.4)))
        results.append(
            (lit.areas(voxels), lit.look_up(voxels), voxels.fragments.order.numpy()[: voxels.fragments.count])
        )
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, other)

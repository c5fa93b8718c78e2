"""Further bounces: the geometric series of closed rooms, and the integrating sphere."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct.passes.bounces import mean_albedo, reinject, solve_bounces
from warp_dvct.passes.patches import choose_patches
from warp_dvct.passes.pyramid import light_faces
from warp_dvct.scene import Material, Role

B = np.array([1.0, 2.0, 3.0])


def series(albedo, terms: int) -> np.ndarray:
    """1 + rho + rho^2 + … with that many terms."""
    return sum(np.asarray(albedo, float) ** k for k in range(terms))


class Solver:
    """A lit scene with its patches, those of the last volume; re-injection is into the first."""

    def __init__(self, launcher, scene, flux_of, *, n=48, most=1500, boxes=None):
        self.launcher = launcher
        self.flux = None

        def keep(device_scene, voxels):
            flux = flux_of(device_scene, voxels)
            self.flux = flux if self.flux is None else self.flux
            return flux

        self.lit = lit.lit_world(launcher, scene, n, keep, boxes=boxes)
        self.voxels = self.lit.volumes[0]
        self.normals = lit.unit_normals(launcher, self.lit.device_scene)
        self.patches = choose_patches(launcher, self.lit.device_scene, self.lit.volumes[-1], self.normals, most)

    def solve(self, bounces, rays=64, seed=0):
        """Device array and host values ``[patches, solution, 3]``."""
        total = solve_bounces(
            self.launcher, self.lit.device_scene, self.lit.world, self.patches, bounces=bounces, rays=rays, seed=seed
        )
        return total, total.numpy()[: 2 * self.patches.count].reshape(-1, 2, 3).astype(float)

    @property
    def real(self) -> np.ndarray:
        return self.patches.data.numpy()["real"][: self.patches.count] == 1

    def reinjected(self, total) -> np.ndarray:
        """Radiosity per record, face and solution after re-injection; NaN where nothing is."""
        albedo = mean_albedo(self.launcher, self.lit.device_scene, self.voxels, self.normals)
        device_scene = self.lit.device_scene
        reinject(self.launcher, device_scene, self.normals, self.voxels, albedo, self.flux, self.patches, total)
        light_faces(self.launcher, self.voxels, self.flux)
        field = self.voxels.field()[: self.voxels.level_records[0]].astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            return field[..., :3] / field[..., 3:]


def closed_room(inserted: bool, degrees=20.0, albedo=(0.5, 0.4, 0.3), object_albedo=None):
    parts = [lit.mesh(lit.room(0.32, degrees))]
    if inserted:
        parts.append(lit.mesh(lit.ball((0.5, 0.45, 0.5), 0.12), Role.SYNTHETIC, 1))
    materials = [Material(base_color=c, ior=1.0) for c in (albedo, object_albedo or albedo)]
    return lit.scene_of(*parts, materials=materials)


@pytest.mark.parametrize("inserted", [False, True])
@pytest.mark.parametrize("bounces", [1, 2, 5, 40])
def test_uniform_room_is_the_geometric_series(launcher, inserted, bounces):
    """All surfaces send B: every bounce is the last one times the albedo. Patches within 1 %, re-injection as well."""
    solver = Solver(launcher, closed_room(inserted), lambda _, v: lit.uniform_flux(launcher, v, B))
    total, irradiance = solver.solve(bounces)
    albedo = np.array([0.5, 0.4, 0.3])
    expected = B * series(albedo, bounces)
    np.testing.assert_allclose(irradiance[:, 1].mean(0), expected, rtol=0.01)
    np.testing.assert_allclose(irradiance[:, 1], np.broadcast_to(expected, (len(irradiance), 3)), rtol=0.04)
    np.testing.assert_allclose(irradiance[solver.real, 0].mean(0), expected, rtol=0.01)
    radiosity = solver.reinjected(total)
    shown = lit.areas(solver.voxels)[..., 1] > 0.05
    np.testing.assert_allclose(radiosity[:, :, 1][shown].mean(0), B + albedo * expected, rtol=0.01)
    np.testing.assert_allclose(
        radiosity[:, :, 1][shown], np.broadcast_to(B + albedo * expected, (shown.sum(), 3)), rtol=0.04
    )
    real = lit.areas(solver.voxels)[..., 0] > 0.05
    np.testing.assert_allclose(radiosity[:, :, 0][real].mean(0), B + albedo * expected, rtol=0.01)


def test_energy_never_grows(launcher):
    """In a white closed room each bounce keeps what the last one had, to rounding; so do a hundred."""
    solver = Solver(launcher, closed_room(True, albedo=(1.0, 1.0, 1.0)), lambda _, v: lit.uniform_flux(launcher, v, B))
    for bounces in (1, 10, 100):
        irradiance = solver.solve(bounces)[1]
        assert irradiance[:, 1].max() <= (B * bounces).max() * (1 + 1e-4)
        assert (irradiance[:, 1] / B).max() <= bounces * (1 + 1e-4)
        assert irradiance[:, 1].mean() == pytest.approx(bounces * B.mean(), rel=0.01)


def glowing(launcher, share):
    """Flux of radiosity B on voxels of the upper part of the volume alone: those above height ``share``."""

    def flux(_, voxels):
        extent = voxels.box.n
        records = lit.look_up(voxels)
        height = np.zeros(voxels.level_records[0])
        cells = np.argwhere(records >= 0)
        height[records[records >= 0]] = (cells[:, 2] + 0.5) / extent
        area = lit.areas(voxels) * (height > share)[:, None, None]
        return lit.launcher_vectors(launcher, (area[..., None] * B).reshape(-1, 3))

    return flux


@pytest.mark.parametrize("bounces", [1, 3, 8])
def test_integrating_sphere(launcher, bounces):
    """In a spherical cavity any radiosity makes its mean as irradiance everywhere: 30 % glow, so it is .3 B times the
    series; within 3 % in the mean, 8 % RMS from patch to patch (128 rays)."""
    cavity = lit.ball(lit.CENTER, 0.4, 32)[:, ::-1]
    albedo = np.array(lit.GREY.base_color)
    # A cap of height h holds h / (2 r) of the sphere: all above z = .5 + .4 - .24.
    solver = Solver(launcher, lit.scene_of(lit.mesh(cavity)), glowing(launcher, 0.66), n=50)
    total, irradiance = solver.solve(bounces, rays=128)
    expected = 0.3 * B * series(albedo, bounces)
    np.testing.assert_allclose(irradiance[:, 0], irradiance[:, 1], rtol=1e-6)
    np.testing.assert_allclose(irradiance[:, 1].mean(0), expected, rtol=0.03)
    assert np.sqrt(((irradiance[:, 1] / expected - 1) ** 2).mean()) < 0.12
    radiosity = solver.reinjected(total)
    dark = lit.dense(solver.voxels, np.arange(solver.voxels.level_records[0])[:, None])[:, :, :32, 0]
    dark = np.unique(dark[lit.look_up(solver.voxels)[:, :, :32] >= 0]).astype(int)
    shown = lit.areas(solver.voxels)[dark][..., 1] > 0.05
    np.testing.assert_allclose(radiosity[dark][:, :, 1][shown].mean(0), albedo * expected, rtol=0.03)


def test_a_black_object_takes_its_share(launcher):
    """Before does not know of it; after loses what it swallows."""
    scene = closed_room(True, object_albedo=(0.0, 0.0, 0.0))

    def flux(device_scene, voxels):
        area = lit.areas(voxels)
        values = area[..., None] * B
        values[:, :, 1] = values[:, :, 0]  # the object sends nothing
        return lit.launcher_vectors(launcher, values.reshape(-1, 3))

    solver = Solver(launcher, scene, flux)
    _, irradiance = solver.solve(20)
    albedo = np.array([0.5, 0.4, 0.3])
    expected = B * series(albedo, 20)
    real = irradiance[solver.real]
    np.testing.assert_allclose(real[:, 0].mean(0), expected, rtol=0.01)
    assert (real[:, 1] <= real[:, 0] * (1 + 1e-4)).all()
    # Walls see the ball with its area over theirs (it is convex, they are closed): reciprocity.
    ball, room = lit.area_of(lit.ball((0, 0, 0), 0.12)), lit.area_of(lit.room(0.32))
    loss = 1 - ball / room
    assert real[:, 1].mean(0)[0] < expected[0]
    np.testing.assert_allclose(real[:, 1].mean(0), B * loss * series(albedo * loss, 20), rtol=0.04)


@pytest.mark.parametrize("black", [False, True])
@pytest.mark.parametrize("height", [0.112, 0.888])
def test_a_thin_object_on_a_wall_leaves_before_alone(launcher, height, black):
    """A slab that shares voxels with the floor or the ceiling, and whose faces outweigh theirs."""
    slab = lit.mesh(lit.cuboid((0.5, height, 0.5), (0.25, 0.01, 0.25)), Role.SYNTHETIC, int(black))
    scene = lit.scene_of(lit.mesh(lit.room(0.4)), slab, materials=(lit.GREY, Material(base_color=(0, 0, 0), ior=1.0)))
    solver = Solver(launcher, scene, lambda _, v: lit.uniform_flux(launcher, v, B))
    total, irradiance = solver.solve(10)
    albedo = np.array(lit.GREY.base_color)
    expected = B * series(albedo, 10)
    np.testing.assert_allclose(irradiance[solver.real, 0].mean(0), expected, rtol=0.005)
    radiosity = solver.reinjected(total)
    for solution in (0,) if black else (0, 1):
        shown = lit.areas(solver.voxels)[..., solution] > 0.05
        np.testing.assert_allclose(radiosity[:, :, solution][shown].mean(0), B + albedo * expected, rtol=0.01)


@pytest.mark.parametrize("role", [Role.REAL, Role.SYNTHETIC])
@pytest.mark.parametrize("side", [0.2, 0.8])
def test_both_sides_of_a_thin_wall_keep_to_their_rooms(launcher, role, side):
    """Two rooms, one of which sends B, with a box in each: the wall's dark side gets nothing, the other the series.

    The wall lies between patches and before or behind the middle of the fine voxels that hold it: that middle is beyond
    one of its sides, near a box that looks the same way.
    """
    parts = [lit.mesh(lit.room(0.4)), lit.mesh(lit.cuboid(0.5, (0.0005, 0.41, 0.41)))]
    parts += [lit.mesh(lit.cuboid((x, 0.5, 0.5), (0.03, 0.1, 0.1)), role) for x in (0.42, 0.58)]
    n, voxel = 32, 1 / 96
    low = 0.5 - (n // 2 + side) * voxel
    boxes = (((low, 0.34, 0.34), n * voxel, n), ((0.0, 0.0, 0.0), 1.0, 48))

    def flux(_, voxels):
        """All that looks around in the room at greater x; voxels that the wall cuts show its side alone."""
        records = lit.look_up(voxels)
        cells = np.argwhere(records >= 0)
        edge = voxels.box.edge / voxels.box.n
        begin = np.zeros(voxels.level_records[0])
        begin[records[records >= 0]] = voxels.box.low[0] + cells[:, 0] * edge
        lights = np.repeat((begin > 0.5 - 1e-6)[:, None], 6, 1)
        lights[(begin < 0.5005) & (begin + edge > 0.5005), 0] = True
        return lit.launcher_vectors(launcher, ((lit.areas(voxels) * lights[..., None])[..., None] * B).reshape(-1, 3))

    solver = Solver(launcher, lit.scene_of(*parts), flux, boxes=boxes)
    assert solver.patches.has_walls
    total, _ = solver.solve(10)
    radiosity = solver.reinjected(total)
    wall = lit.look_up(solver.voxels)[n // 2].ravel()
    assert (lit.areas(solver.voxels)[wall, :2] > 0.9 * voxel**2).all()
    expected = B + np.array(lit.GREY.base_color) * B * series(lit.GREY.base_color, 10)
    for solution in (0, 1):
        assert radiosity[wall, 1, solution].max() < 0.002
        np.testing.assert_allclose(radiosity[wall, 0, solution], np.broadcast_to(expected, (n * n, 3)), rtol=0.05)


def test_number_of_patches_follows_what_is_asked(launcher):
    counts = []
    for most in (100, 1500, 20000):
        solver = Solver(launcher, closed_room(True), lambda _, v: lit.uniform_flux(launcher, v, B), most=most)
        counts.append(solver.patches.count)
        assert solver.patches.count <= 2.5 * most
        np.testing.assert_allclose(solver.solve(3)[1][:, 1].mean(0), B * series([0.5, 0.4, 0.3], 3), rtol=0.015)
        table = solver.patches.table.numpy()
        further = solver.patches.data.numpy()["next"][: solver.patches.count]
        reached = np.concatenate([table[table >= 0], further[further >= 0]])
        np.testing.assert_array_equal(np.sort(reached), np.arange(solver.patches.count))
    assert counts == sorted(set(counts))


def test_mean_albedo_is_weighted_by_area(launcher):
    """A voxel with a real sheet of area 1 and a synthetic one of area .5."""
    sheet = lit.rectangle((0.5, 0.53, 0.5), (0, 0, 0.5), (0.5, 0, 0))
    half = lit.rectangle((0.25, 0.55, 0.5), (0, 0, 0.5), (0.25, 0, 0))
    materials = [Material(base_color=c, ior=1.0) for c in ((0.6, 0.4, 0.2), (0.0, 1.0, 0.5))]
    scene = lit.scene_of(lit.mesh(sheet), lit.mesh(half, Role.SYNTHETIC, 1), materials=materials)
    device_scene = lit.upload(launcher, scene)
    voxels = lit.voxels_of(launcher, device_scene, 1)
    got = mean_albedo(launcher, device_scene, voxels, lit.unit_normals(launcher, device_scene)).numpy()
    np.testing.assert_allclose(got[0], [0.6, 0.4, 0.2], rtol=1e-4)
    np.testing.assert_allclose(got[1], [0.0, 1.0, 0.5], rtol=1e-4)

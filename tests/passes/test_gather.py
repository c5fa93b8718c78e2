"""Sparse gathering: what reconstruction may and may not mix, and what is done with the irradiance."""

from __future__ import annotations

from dataclasses import dataclass

import lit_scenes as lit
import numpy as np
import pytest
import warp as wp

from warp_dvct.kernels.radiosity import World, radiosity_at
from warp_dvct.launch import Launcher
from warp_dvct.passes.gather import Gatherer, SparseGather, gather_all, shade_indirect
from warp_dvct.passes.gbuffer import render_gbuffer
from warp_dvct.scene import Light, LightKind, LightRole, Role


@dataclass(frozen=True)
class Painted:
    """Stands for a gatherer: gives each point the value that a function of its place and normal has there."""

    value: object
    seed: int = 0
    cone: object = None

    def run(self, launcher, points, index, count, *_, **__):
        index = index.numpy()[:count]
        places, normals = points.position.numpy()[index].astype(float), points.normal_g.numpy()[index].astype(float)
        values = np.where((index >= 0)[:, None], self.value(places, normals)[:, None] * [1.0, 2.0, 4.0], 0)
        return (
            lit.launcher_vectors(launcher, np.pad(values, ((0, 1), (0, 0)))),
            lit.launcher_vectors(launcher, np.pad(values + 1, ((0, 1), (0, 0)))),
        )


def box_scene(turn=0.0, inserted=True):
    """A box on a floor before a wall, seen from above."""
    floor = lit.rectangle((0.5, 0.1, 0.5), (0, 0, 0.4), (0.4, 0, 0))
    wall = lit.rectangle((0.5, 0.5, 0.1), (0.4, 0, 0), (0, 0.4, 0))
    box = lit.cuboid((0.5, 0.25, 0.4), 0.15, turn)
    role = Role.SYNTHETIC if inserted else Role.REAL
    camera = lit.look_at((0.7, 0.75, 1.2), (0.5, 0.25, 0.35), half=0.45)
    return lit.scene_of(lit.mesh(floor), lit.mesh(wall), lit.mesh(box, role), camera=camera)


def seen(launcher, scene, width=75, height=61, samples=4):
    return render_gbuffer(launcher, lit.upload(launcher, scene), width, height, edge_samples=samples, behind=False)


def sparse(launcher, buffer, gatherer, role=Role.REAL, *, stride=4, radius=2, smoothing=2):
    """What is written for a role, and -1 where nothing is."""
    before, after = (launcher.full(buffer.count, wp.vec3(-1.0, -1.0, -1.0), wp.vec3) for _ in range(2))
    gather = SparseGather(launcher, buffer, role, gatherer, stride, radius, smoothing)
    gather.write(gather.blocks(), (before, after))
    return before.numpy()[: buffer.count].astype(float), after.numpy()[: buffer.count].astype(float)


@pytest.mark.parametrize("role", [Role.REAL, Role.SYNTHETIC])
@pytest.mark.parametrize("stride", [1, 2, 4, 7])
def test_a_constant_field_comes_back_and_every_point_is_filled(launcher, stride, role):
    """Also at the edge points, and in pixel counts that the stride does not divide; the other role is left alone, and
    the background gets 0."""
    buffer = seen(launcher, box_scene(20.0))
    assert buffer.count > 75 * 61
    mine = buffer.points.role.numpy()[: buffer.count] == role
    assert 100 < mine.sum() < buffer.count
    before, after = sparse(launcher, buffer, Painted(lambda p, n: np.ones(len(p))), role, stride=stride)
    np.testing.assert_allclose(before[mine], np.broadcast_to([1.0, 2.0, 4.0], (mine.sum(), 3)), rtol=1e-5)
    np.testing.assert_allclose(after[mine], np.broadcast_to([2.0, 3.0, 5.0], (mine.sum(), 3)), rtol=1e-5)
    background = buffer.points.role.numpy()[: buffer.count] == -1
    other = ~mine & ~background
    assert other.any()
    for irradiance in (before, after):
        assert (irradiance[other] == -1.0).all()
        assert not irradiance[background].any()


def surface_of(places, normals) -> np.ndarray:
    """A number per plane: of floor, wall, and each side of the box."""
    return 1 + np.round(normals @ [1.0, 2.0, 4.0], 3) + 10 * np.round((places * normals).sum(-1), 3)


@pytest.mark.parametrize("turn", [0.0, 30.0])
@pytest.mark.parametrize("inserted", [True, False])
@pytest.mark.parametrize("stride", [2, 4, 6])
def test_nothing_bleeds_over_corners_and_depth_edges(launcher, stride, inserted, turn):
    """Each plane has a value of its own and keeps it exactly: at 90 degree corners, and where one hides another."""
    buffer = seen(launcher, box_scene(turn, inserted))
    for role in (Role.REAL, Role.SYNTHETIC) if inserted else (Role.REAL,):
        mine = buffer.points.role.numpy()[: buffer.count] == role
        places, normals = (getattr(buffer.points, x).numpy()[: buffer.count][mine] for x in ("position", "normal_g"))
        own = surface_of(places.astype(float), normals.astype(float))
        assert len(np.unique(np.round(own, 2))) >= 2
        before, _ = sparse(launcher, buffer, Painted(surface_of), role, stride=stride)
        np.testing.assert_allclose(before[mine][:, 0], own, atol=0.02)


def test_a_step_between_parallel_planes_stays_sharp(launcher):
    """A slab half as high as the pixels between gather points are wide is another surface."""
    low = lit.rectangle((0.5, 0.1, 0.5), (0, 0, 0.4), (0.4, 0, 0))
    high = lit.rectangle((0.3, 0.18, 0.5), (0, 0, 0.4), (0.2, 0, 0))
    camera = lit.look_at((0.5, 1.5, 0.5), (0.5, 0.1, 0.5), half=0.3, up=(0, 0, -1))
    buffer = seen(launcher, lit.scene_of(lit.mesh(low), lit.mesh(high), camera=camera))
    heights = buffer.points.position.numpy()[: buffer.count, 1].astype(float)
    mine = buffer.points.role.numpy()[: buffer.count] == 0
    before, _ = sparse(launcher, buffer, Painted(lambda p, n: p[:, 1]), stride=4)
    np.testing.assert_allclose(before[mine][:, 0], heights[mine], atol=1e-3)


def test_a_smooth_field_is_reconstructed_closely(launcher):
    """A gradient over the floor: within 5 % of its range at stride 4, unbiased in the mean."""
    scene = lit.scene_of(
        lit.mesh(lit.rectangle((0.5, 0.1, 0.5), (0, 0, 2), (2, 0, 0))),
        camera=lit.look_at((0.5, 1.0, 0.5), (0.5, 0.1, 0.5), half=0.4, up=(0, 0, -1)),
    )
    buffer = seen(launcher, scene)
    x = buffer.points.position.numpy()[: buffer.count, 0].astype(float)
    for smoothing in (0, 2):
        got = sparse(launcher, buffer, Painted(lambda p, n: p[:, 0]), smoothing=smoothing)[0][:, 0]
        assert got.mean() == pytest.approx(x.mean(), abs=0.005 * np.ptp(x))
        inner = np.abs(x - 0.5) < 0.3 * np.ptp(x)
        assert np.abs(got - x)[inner].max() < 0.05 * np.ptp(x)


def test_isolated_points_are_gathered_themselves(launcher):
    """Slats thinner than a pixel at different heights: each has its own value, though many have no gathered pixel."""
    slats = [
        lit.rectangle((0.2 + 0.08 * k, 0.4 * k, 0.5), (0, 0, 0.4), (0.006, 0, 0)) for k in (0, 5, 2, 7, 4, 1, 6, 3)
    ]
    camera = lit.look_at((0.48, 30.0, 0.5), (0.48, 0.1, 0.5), half=0.42 / 30, up=(0, 0, -1))
    buffer = seen(launcher, lit.scene_of(*map(lit.mesh, slats), camera=camera), samples=0)
    mine = buffer.points.role.numpy()[: buffer.count] == 0
    heights = buffer.points.position.numpy()[: buffer.count, 1].astype(float)
    assert len(np.unique(np.round(heights[mine], 2))) == 8
    for stride in (4, 16):
        before, _ = sparse(launcher, buffer, Painted(lambda p, n: p[:, 1]), stride=stride, radius=1)
        np.testing.assert_allclose(before[mine][:, 0], heights[mine], atol=1e-3)


def furnace_view(launcher):
    room = lit.mesh(lit.room(0.4))
    ball = lit.mesh(lit.ball((0.5, 0.4, 0.5), 0.15), Role.SYNTHETIC)
    camera = lit.look_at((0.2, 0.7, 0.8), (0.5, 0.4, 0.5), half=0.7)
    world = lit.lit_world(
        launcher,
        lit.scene_of(room, ball, camera=camera),
        48,
        lambda _, v: lit.uniform_flux(launcher, v, (1.0, 2.0, 3.0)),
    )
    return world, render_gbuffer(launcher, world.device_scene, 60, 40, edge_samples=4, behind=True)


@pytest.mark.parametrize("cones", [0, 9])
def test_furnace_through_the_sparse_path(launcher, cones):
    world, buffer = furnace_view(launcher)
    gatherer = Gatherer(world.device_scene, world.world, 32, 0, cones, lit.cone_settings() if cones else None)
    before, after = (np.zeros((buffer.count, 3)) for _ in range(2))
    for role in (Role.REAL, Role.SYNTHETIC):
        found = sparse(launcher, buffer, gatherer, role)
        mine = (buffer.points.role.numpy()[: buffer.count] == role)[:, None]
        before, after = (np.where(mine, new, old) for new, old in zip(found, (before, after), strict=True))
    np.testing.assert_allclose(after, np.broadcast_to([1.0, 2.0, 3.0], after.shape), rtol=2e-3)
    real = buffer.points.role.numpy()[: buffer.count] == 0
    np.testing.assert_allclose(before[real], np.broadcast_to([1.0, 2.0, 3.0], before[real].shape), rtol=2e-3)


@wp.kernel
def _look_up(first: int, world: World, at: wp.vec3, footprint: float, found_out: wp.array(dtype=wp.vec3)):
    i = first + wp.tid()
    found_out[i] = radiosity_at(world, at, wp.vec3(0.0, 1.0, 0.0), footprint).after


def test_a_sliver_that_caught_a_whole_texel_does_not_shine(launcher):
    """The floor ends 3 % into its last voxels, whose flux is that of a texel of a quarter voxel; the ones before have
    so much less. Every ray that meets the sliver finds the floor's radiosity within 30 %, wide or narrow."""
    n, edge = 8, 0.03 / 8

    def flux_of(_, voxels):
        flux = lit.uniform_flux(launcher, voxels, np.ones(3)).numpy().reshape(-1, 12, 3)
        sliver = flux[:, 4:6].max((1, 2)) < 0.1
        assert sliver.sum() == n
        flux[sliver, 4:6] = 0.25
        flux[~sliver, 4:6] *= 1.0 - (0.25 - 0.03) / (~sliver).sum() * n
        return launcher.array(flux.reshape(-1, 3), wp.vec3)

    floor = lit.rectangle((0.25 + edge / 2, 0.3, 0.5), (0, 0, 0.5), (0.25 + edge / 2, 0, 0))
    world = lit.lit_world(launcher, lit.scene_of(lit.mesh(floor)), n, flux_of).world
    found = launcher.zeros(1, wp.vec3)
    for footprint in (0.01, 0.2, 0.9):
        launcher.launch(_look_up, 1, [world, wp.vec3(0.5 + edge / 2, 0.3, 0.5), footprint], [found])
        np.testing.assert_allclose(found.numpy(), 1.0, rtol=0.3)


def test_points_of_an_edge_pixel_share_its_rays_out(launcher):
    """Four points at one place, under a ceiling that covers a part of what they see: together they are a whole one."""
    ceiling = lit.mesh(lit.rectangle((0.37, 0.53, 0.41), (0.27, 0, 0.1), (0, 0, 0.33)))
    world = lit.lit_world(launcher, lit.scene_of(ceiling), 16, lambda _, v: lit.uniform_flux(launcher, v, np.ones(3)))
    index = launcher.array(np.arange(4, dtype=np.int32), wp.int32)
    points = lit.points_at(launcher, [[0.5, 0.1, 0.5]] * 4, (0, 1, 0))
    points.pixel = launcher.zeros(4, wp.vec2i)
    gatherer = Gatherer(world.device_scene, world.world, 64, 0, edge_samples=4)
    whole = gatherer.run(launcher, points, index, 4)[0].numpy()[0]
    assert 0.1 < whole[0] < 0.9
    points.slot = launcher.array(np.arange(4, dtype=np.int32), wp.int32)
    shares = gatherer.run(launcher, points, index, 4)[0].numpy()
    assert len(np.unique(shares[:, 0])) > 1
    np.testing.assert_allclose(shares.mean(0), whole, rtol=1e-5)


def test_points_of_index_minus_one_and_background_get_zero(launcher):
    world, _ = furnace_view(launcher)
    points = lit.points_at(launcher, [[0.5, 0.1, 0.5]] * 2, (0, 1, 0), role=[0, -1])
    index = launcher.array(np.array([0, -1, 1], np.int32), wp.int32)
    for cone, number in ((None, 0), (lit.cone_settings(), 9)):
        gatherer = Gatherer(world.device_scene, world.world, 16, 0, number, cone)
        for values in gatherer.run(launcher, points, index, 3):
            np.testing.assert_allclose(values.numpy()[:3], [[1, 2, 3], [0, 0, 0], [0, 0, 0]], rtol=1e-3)


def test_before_ignores_synthetic_surfaces_entirely(launcher):
    """With the ball replaced by another, or moved, before stays bit for bit what it was."""
    results = []
    for radius, middle in ((0.15, 0.4), (0.05, 0.6)):
        ball = lit.mesh(lit.ball((0.5, middle, 0.5), radius), Role.SYNTHETIC)
        scene = lit.scene_of(lit.mesh(lit.room(0.4)), ball)

        def flux(_, voxels):
            areas = lit.areas(voxels)
            areas[:, :, 1] += 2 * (areas[:, :, 1] - areas[:, :, 0])  # what is inserted glows three times as bright
            values = areas[..., None] * [1.0, 2.0, 3.0]
            return lit.launcher_vectors(launcher, values.reshape(-1, 3))

        world = lit.lit_world(launcher, scene, 48, flux)
        points = lit.points_at(
            launcher, np.random.default_rng(0).uniform(0.2, 0.8, (50, 3)) * [1, 0, 1] + [0, 0.1, 0], (0, 1, 0)
        )
        gatherer = Gatherer(world.device_scene, world.world, 32, 0)
        results.append([a.numpy()[:50] for a in gather_all(launcher, points, 50, gatherer)])
    np.testing.assert_array_equal(results[0][0], results[1][0])
    assert np.abs(results[0][1] - results[1][1]).max() > 0


SKY = np.random.default_rng(3).lognormal(0, 1.0, (16, 32, 3)).astype(np.float32)


def sky_irradiance(normal, rotation) -> np.ndarray:
    """Of the textured dome, texels interpolated, on a plane: brute force."""
    h, w = 256, 512
    theta, phi = (np.arange(h) + 0.5) / h * np.pi, (0.5 - (np.arange(w) + 0.5) / w) * 2 * np.pi
    sin = np.sin(theta)[:, None]
    d = np.stack([sin * np.sin(phi), np.cos(theta)[:, None] + 0 * phi, sin * np.cos(phi)], -1) @ rotation.T
    v, u = (np.arange(h) + 0.5) / h * 16 - 0.5, (np.arange(w) + 0.5) / w * 32 - 0.5
    y0, x0 = np.floor(v).astype(int), np.floor(u).astype(int)
    fy, fx = (v - y0)[:, None, None], (u - x0)[None, :, None]
    rows = [SKY[np.clip(y0 + k, 0, 15)].astype(float) for k in (0, 1)]
    rows = [r[:, x0 % 32] * (1 - fx) + r[:, (x0 + 1) % 32] * fx for r in rows]
    radiance = rows[0] * (1 - fy) + rows[1] * fy
    weight = np.maximum(0, d @ normal) * sin * (np.pi / h) * (2 * np.pi / w)
    return (radiance * weight[..., None]).sum((0, 1))


@pytest.mark.parametrize(("number", "tolerance"), [(0, 0.02), (9, 0.12), (36, 0.06)])
def test_irradiance_of_a_textured_sky(launcher, number, tolerance):
    """Escaped rays and cones read the rotated lat-long map; an added dome is in after alone."""
    dome = Light(LightKind.DOME, (1.0, 2.0, 3.0), texture=SKY, rotation=lit.turned(50.0))
    far = lit.mesh(lit.rectangle((0.5, -9.0, 0.5), (0, 0, 1e-3), (1e-3, 0, 0)))
    more = Light(LightKind.DOME, (0.5, 0.5, 0.5), role=LightRole.ADDED)
    world = lit.lit_world(
        launcher, lit.scene_of(far, lights=(dome, more)), 8, lambda _, v: lit.uniform_flux(launcher, v, np.zeros(3))
    )
    normals = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [0.6, 0.0, 0.8], [0.0, -0.8, 0.6]])
    repeat = 64
    points = lit.points_at(launcher, np.full((len(normals) * repeat, 3), 0.5), np.repeat(normals, repeat, 0))
    gatherer = Gatherer(world.device_scene, world.world, 256, 0, number, lit.cone_settings() if number else None)
    before, after = (
        a.numpy().reshape(-1, repeat, 3).mean(1) for a in gather_all(launcher, points, len(normals) * repeat, gatherer)
    )
    expected = np.array([sky_irradiance(n, lit.turned(50.0)) for n in normals]) * [1, 2, 3]
    np.testing.assert_allclose(before, expected, rtol=tolerance)
    np.testing.assert_allclose(after - before, 0.5 * np.pi, rtol=0.01)


def test_shade_indirect_reflects_irradiance(launcher):
    """albedo / pi times it: after on synthetic points, after - before on real ones; added to what is there."""
    color = np.array([0.5, 0.4, 0.3])
    points = lit.points_at(launcher, np.zeros((3, 3)), (0, 1, 0), role=[0, 1, -1], color=color)
    before = np.array([[1.0, 2, 3], [1, 1, 1], [5, 5, 5]])
    after = np.array([[2.0, 1, 3], [4, 5, 6], [9, 9, 9]])
    light, radiance = (launcher.full(3, wp.vec3(0.25, 0.25, 0.25), wp.vec3) for _ in range(2))
    irradiance = (lit.launcher_vectors(launcher, before), lit.launcher_vectors(launcher, after))
    shade_indirect(launcher, points, 3, irradiance, alpha_max=-1.0, light=light, before=radiance, with_before=True)
    expected = [(after[0] - before[0]) * color / np.pi, after[1] * color / np.pi, [0, 0, 0]]
    np.testing.assert_allclose(light.numpy(), np.array(expected) + 0.25, rtol=1e-5)
    np.testing.assert_allclose(
        radiance.numpy(), np.array([before[0] * color / np.pi, [0] * 3, [0] * 3]) + 0.25, rtol=1e-5
    )


def test_a_seed_decides_and_threads_do_not(launcher):
    open_scene = lit.scene_of(
        lit.mesh(lit.rectangle((0.5, 0.1, 0.5), (0, 0, 1), (1, 0, 0))),
        lights=(Light(LightKind.DOME, (1, 1, 1), texture=SKY),),
    )
    world = lit.lit_world(launcher, open_scene, 16, lambda _, v: lit.uniform_flux(launcher, v, np.zeros(3)))
    points = lit.points_at(launcher, np.random.default_rng(0).uniform(0.2, 0.8, (900, 3)), (0, 1, 0))

    def values(seed, threads):
        gatherer = Gatherer(world.device_scene, world.world, 8, seed)
        return gather_all(Launcher(str(launcher.device), threads), points, 900, gatherer)[1].numpy()

    np.testing.assert_array_equal(values(1, 1), values(1, 3))
    assert np.abs(values(1, 1) - values(2, 1)).max() > 0.01

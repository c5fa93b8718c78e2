"""Irradiance, albedo and light of scanned surfaces against closed forms and simulated truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from captures import nearest

from warp_dvct.capture.albedo import Spread, estimate_albedo, thinned, unique_edges
from warp_dvct.capture.fusion import FusedMesh, FusionOptions, fuse
from warp_dvct.capture.irradiance import Lighting, Receivers
from warp_dvct.capture.light_fit import ShadingModel, fit_fill, fit_light
from warp_dvct.capture.light_solver import (
    LIGHTEST,
    Solver,
    color_clusters,
    fibonacci_sphere,
    harmonics_of,
    nonnegative_light,
    tangents,
)
from warp_dvct.capture.reconstruct import ReconstructOptions, reconstruct
from warp_dvct.capture.source import CaptureFrames
from warp_dvct.errors import OptionError
from warp_dvct.probe import LUMINANCE
from warp_dvct.scene import Light, LightKind
from warp_dvct.usd.read import read_stage

SUN = Light(LightKind.DISTANT, (2.0, 1.5, 1.0), direction=(0.0, -0.8, -0.6))
SKY = Light(LightKind.DOME, (0.4, 0.5, 0.6))


def floor(color=(0.3, 0.2, 0.1), size: float = 2.0, cells: int = 40) -> FusedMesh:
    """A flat floor that faces up, all of one colour."""
    x, z = np.meshgrid(np.linspace(-size, size, cells + 1), np.linspace(-size, size, cells + 1))
    points = np.stack([x, np.zeros_like(x), z], -1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    a, b, c, d = corner, corner + 1, corner + cells + 1, corner + cells + 2
    triangles = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]).astype(np.int32)
    normals = np.broadcast_to(np.array([0, 1, 0], np.float32), points.shape)
    colors = np.broadcast_to(np.array(color, np.float32), points.shape)
    return FusedMesh(points, normals, colors, triangles, {}, 1, 1, 0)


def at_middle() -> Receivers:
    return Receivers(np.array([[0.0, 0.0, 0.0], [0.3, 0.0, -0.2]]), np.array([[0.0, 1.0, 0.0]] * 2), 0.005)


def test_irradiance_of_sun_and_sky_on_an_open_floor(launcher):
    lighting = Lighting(launcher, floor(), np.full((41 * 41, 3), 0.5), (SUN, SKY))
    np.testing.assert_allclose(lighting.direct(at_middle()), [[1.6, 1.2, 0.8]] * 2, rtol=1e-3)
    np.testing.assert_allclose(lighting.gathered(at_middle()), np.pi * np.array([[0.4, 0.5, 0.6]] * 2), rtol=1e-3)


def test_albedo_of_an_open_floor_is_exact(launcher):
    truth = np.array([0.5, 0.3, 0.2])
    seen = truth / np.pi * (np.array([1.6, 1.2, 0.8]) + np.pi * np.array([0.4, 0.5, 0.6]))
    estimate = estimate_albedo(launcher, floor(seen), (SUN, SKY), voxel=0.05)
    np.testing.assert_allclose(estimate.values, np.broadcast_to(truth, estimate.values.shape), rtol=0.01)
    assert estimate.bright == 0.0


def test_lights_that_are_too_dim_are_noticed_and_albedo_is_bounded(launcher):
    estimate = estimate_albedo(launcher, floor((5.0, 5.0, 5.0)), (SUN, SKY), voxel=0.05)
    assert estimate.bright == 1.0
    assert estimate.values.max() <= 0.95


def test_a_light_that_reaches_nothing_is_refused(launcher):
    below = replace(SUN, direction=(0.0, 1.0, 0.0))
    with pytest.raises(OptionError, match="none of the lights reaches the surface"):
        estimate_albedo(launcher, floor(), (below,), voxel=0.05)


def test_albedo_without_photographs_is_refused(launcher):
    with pytest.raises(OptionError, match="no photographs"):
        estimate_albedo(launcher, replace(floor(), colors=None), (SUN,), voxel=0.05)


@pytest.fixture(scope="module")
def room_mesh(room_capture) -> FusedMesh:
    return fuse(CaptureFrames(room_capture), FusionOptions(voxel=0.04))


def test_albedo_of_a_scanned_room_is_at_least_twice_as_good_as_the_camera_s_colour(launcher, room, room_mesh):
    """Issue of the paper's choice, albedo = camera colour; the scan misses walls, which the fill stands for."""
    distance, truth = nearest(room, room_mesh.points)
    good = distance < 0.02
    fill = fit_fill(launcher, room_mesh, room.lights, voxel=0.04)
    dome = Light(LightKind.DOME, tuple(float(c) for c in fill))  # type: ignore[arg-type]
    estimate = estimate_albedo(launcher, room_mesh, (*room.lights, dome), voxel=0.04)
    assert room_mesh.colors is not None
    of_color, ours = (np.abs(a - truth)[good].mean() for a in (room_mesh.colors, estimate.values))
    assert ours < 0.5 * of_color
    assert ours < 0.12


def test_the_fill_is_of_the_size_that_the_missing_walls_have(launcher, room, room_mesh):
    fill = fit_fill(launcher, room_mesh, room.lights, voxel=0.04)
    assert room_mesh.colors is not None
    assert (fill > 0.1 * room_mesh.colors.mean(0)).all()
    assert (fill < 1.5 * room_mesh.colors.mean(0)).all()


def test_spreading_keeps_constants_and_stays_on_its_side():
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [1, 0, 1]
    up, down = np.tile([0.0, 1.0, 0.0], (200, 1)), np.tile([0.0, -1.0, 0.0], (200, 1))
    both = Receivers(np.concatenate([points, points]), np.concatenate([up, down]), 0.0)
    spread = Spread.between(both, both, 1)
    np.testing.assert_allclose(spread(np.ones((400, 2))), 1.0)
    sides = np.repeat([1.0, 0.0], 200)[:, None]
    np.testing.assert_allclose(spread(sides)[:, 0], sides[:, 0], atol=1e-3)


def test_thinning_and_edges():
    points = np.array([[0.01, 0, 0], [0.02, 0, 0], [0.11, 0, 0], [-0.01, 0, 0]])
    assert sorted(thinned(points, 0.1)) == [0, 2, 3]
    assert unique_edges(np.array([[0, 1, 2], [2, 1, 3]])).tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]


def test_harmonics_are_orthonormal_and_those_of_the_kernel(launcher):
    d = fibonacci_sphere(20000)
    basis = harmonics_of(d)
    np.testing.assert_allclose(4.0 * np.pi * basis.T @ basis / len(d), np.eye(9), atol=2e-3)


@pytest.fixture(scope="module")
def model(launcher) -> ShadingModel:
    normals = np.array([[0.0, 1.0, 0.0], [0.6, 0.8, 0.0], [0.0, 0.8, -0.6]])
    at = Receivers(np.array([[0.0, 0.3, 0.0]] * 3), normals, 0.001)
    return ShadingModel(launcher, floor(size=0.05), at, 0)


def test_transfer_of_an_open_point_is_that_of_ramamoorthi(model):
    """Irradiance = sum A_l L_lm Y_lm(n), A = pi, 2 pi / 3, pi / 4; the small floor hides next to nothing."""
    expected = harmonics_of(np.array([[0.0, 1.0, 0.0], [0.6, 0.8, 0.0], [0.0, 0.8, -0.6]]))
    expected = expected * np.array([np.pi, *[2 * np.pi / 3] * 3, *[np.pi / 4] * 5])
    np.testing.assert_allclose(model.dome, expected, atol=0.03)
    assert model.open > 0.98


def test_the_tape_s_derivative_is_that_of_differences(model):
    toward = np.array([0.48, 0.8, 0.36])
    value, gradient = model.light(toward)
    np.testing.assert_allclose(value, [0.8, 0.928, 0.424], atol=1e-5)
    for side in tangents(toward):
        h = 1e-3
        there, back = (model.light(toward + s * h * side)[0] for s in (1.0, -1.0))
        np.testing.assert_allclose(gradient @ side, (there - back) / (2 * h), atol=1e-4)


def test_visibility_is_in_the_model(launcher):
    lid = floor(size=1.0)
    lid = replace(lid, points=lid.points + np.array([0, 0.5, 0], np.float32))
    at = Receivers(np.array([[0.0, 0.2, 0.0], [0.0, 0.8, 0.0]]), np.array([[0.0, 1.0, 0.0]] * 2), 0.0)
    hidden = ShadingModel(launcher, lid, at, 0)
    np.testing.assert_allclose(hidden.light(np.array([0.0, 1.0, 0.0]))[0], [0.0, 1.0], atol=1e-6)
    assert hidden.dome[0, 0] < 0.2 * hidden.dome[1, 0]


def test_the_solver_finds_light_and_albedo():
    """Of points some of which have something that shadows them: the shading of convex things alone is of degree 2, so
    that a dome explains a sun as well."""
    rng = np.random.default_rng(1)
    normals = fibonacci_sphere(1500)
    normals = normals[normals[:, 1] > -0.5]
    scale = np.array([np.pi, *[2 * np.pi / 3] * 3, *[np.pi / 4] * 5])
    dome = harmonics_of(normals) * scale
    truth = np.zeros((9, 3))
    truth[0], truth[1] = (1.5, 1.7, 2.2), (0.5, 0.6, 0.9)
    toward = np.array([0.5, 0.7, -0.51])
    toward /= np.linalg.norm(toward)
    blocked = fibonacci_sphere(len(normals))[rng.permutation(len(normals))]

    def light(d):
        cosine = (normals @ d) * (blocked @ d < 0.6)
        return np.maximum(cosine, 0.0), normals * (cosine > 0.0)[:, None]

    sun = light(toward)[0][:, None] * [3.0, 2.8, 2.5]
    albedo = np.array([[0.8, 0.8, 0.8], [0.6, 0.2, 0.1], [0.1, 0.3, 0.5]])[rng.integers(0, 3, len(normals))]
    seen = albedo / np.pi * (dome @ truth + sun)
    solver = Solver(seen, dome, light)
    tried = fibonacci_sphere(300)
    for _ in range(6):
        solver.start_from(tried, np.stack([light(d)[0] for d in tried], -1))
        solver.step(turn=False)
    for apart in (0.6, 0.4, 0.25):
        solver.regroup(apart)
        for _ in range(8):
            solver.step()
    assert np.degrees(np.arccos(solver.x.toward @ toward)) < 2.0
    share = solver.x.irradiance / (solver.x.irradiance + solver.x.harmonics[0])
    np.testing.assert_allclose(share, np.array([3.0, 2.8, 2.5]) / (np.array([3.0, 2.8, 2.5]) + truth[0]), atol=0.06)
    assert np.percentile(solver.x.albedo @ LUMINANCE, 99) == pytest.approx(LIGHTEST, rel=0.05)
    assert solver.residual() < 0.05


def test_a_dome_takes_no_light_away():
    normals = fibonacci_sphere(400)
    dome = harmonics_of(normals) * np.array([np.pi, *[2 * np.pi / 3] * 3, *[np.pi / 4] * 5])
    target = np.maximum(normals @ np.array([0.0, 1.0, 0.0]), 0.0) ** 8 - 0.2
    free = np.linalg.lstsq(dome, target, rcond=None)[0]
    bound = nonnegative_light(dome, target, 9)
    grid = harmonics_of(fibonacci_sphere(500))
    assert (grid @ free).min() < -0.1
    assert (grid @ bound).min() > 0.4 * (grid @ free).min()


def test_what_shading_does_not_tell_apart_has_one_colour():
    """Two lights that shade nearly alike, with noise in the colours: alone each channel splits them anew; drawn to what
    they are in grey they keep it. Lights that shading does tell apart keep their own colours."""
    rng = np.random.default_rng(4)
    shade = rng.uniform(0.5, 1.5, 400)
    alike = np.column_stack([shade, shade + 0.02 * rng.standard_normal(400)])
    grey = np.array([1.0, 0.5])

    def ratios(matrix, target, **drawn):
        found = [nonnegative_light(matrix, target[:, c], 1, **drawn) for c in range(3)]
        return np.array([light[1] / light[0] for light in found])

    noisy = (alike @ grey)[:, None] + 0.15 * rng.standard_normal((400, 3))
    assert np.ptp(ratios(alike, noisy)) > 0.3
    np.testing.assert_allclose(ratios(alike, noisy, prior=grey, trust=0.1), 0.5, rtol=0.05)
    apart = np.column_stack([shade, rng.uniform(0.0, 2.0, 400)])
    told = apart @ np.array([[1.0, 1.0, 1.0], [0.3, 0.5, 0.8]])
    np.testing.assert_allclose(ratios(apart, told, prior=grey, trust=0.002), [0.3, 0.5, 0.8], rtol=0.03)


def test_clusters_do_not_see_shading():
    rng = np.random.default_rng(0)
    paint = np.array([[0.5, 0.5, 0.5], [0.6, 0.1, 0.1]])[np.repeat([0, 1], 100)]
    label = color_clusters(paint * rng.uniform(0.1, 1.0, (200, 1)), 0, 0.25)
    assert len(set(label[:100])) == 1
    assert len(set(label[100:])) == 1
    assert label[0] != label[100]


@pytest.fixture(scope="module")
def yard_capture(yard, tmp_path_factory):
    from warp_dvct.capture.noise import KinectNoise
    from warp_dvct.capture.simulate import Simulation, simulate
    from warp_dvct.capture.stage import open_capture

    options = Simulation(frames=10, width=200, height=150, path="orbit", arc=120.0, noise=KinectNoise.only())
    return open_capture(simulate(yard, tmp_path_factory.mktemp("sunny"), options).capture)


def test_light_of_a_yard_is_estimated(launcher, yard, yard_capture):
    mesh = fuse(CaptureFrames(yard_capture), FusionOptions(voxel=0.03, far=6.0))
    fit = fit_light(launcher, mesh, voxel=0.03)
    lights = {x.kind: x for x in read_stage(yard, allow_empty_roles=True).lights}
    sun, sky = lights[LightKind.DISTANT], np.array(lights[LightKind.DOME].radiance)
    toward = -np.array(sun.direction)
    assert np.degrees(np.arccos(fit.toward @ toward)) < 10.0
    assert np.degrees(fit.spread) < 10.0
    # The scale is a convention; the share of the sun is found.
    power = np.array(sun.radiance) * np.pi * np.sin(0.5 * sun.angle) ** 2
    truth = power / (power + np.pi * sky)
    level = np.pi * 0.28209479 * fit.harmonics[0]
    share = fit.irradiance.mean() / (fit.irradiance.mean() + level.mean())
    assert share == pytest.approx(float(truth.mean()), abs=0.2)
    assert fit.condition < 300.0
    assert len(fit.singular_values) == 12
    assert fit.residual < 0.4


def test_a_bare_floor_tells_too_little_and_says_so(launcher):
    fit = fit_light(launcher, floor(), voxel=0.05)
    assert fit.condition > 1e3
    assert any("ill-conditioned" in line for line in fit.describe())


def test_a_closed_box_has_no_light_from_outside(launcher):
    side = floor(size=1.0, cells=12)
    points, triangles, normals = [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            turn = np.roll(np.eye(3), axis, axis=0)
            p = (side.points @ turn) + sign * turn[1]
            points.append(p)
            normals.append(np.broadcast_to(-sign * turn[1], p.shape))
            triangles.append((side.triangles if sign < 0 else side.triangles[:, ::-1]) + len(p) * len(triangles))
    box = FusedMesh(
        np.concatenate(points).astype(np.float32),
        np.concatenate(normals).astype(np.float32),
        # What lies on an edge of the box has no side on which it is inside: black is not looked at.
        np.where(np.sort(np.abs(np.concatenate(points)), -1)[:, 1:2] < 0.9, np.float32(0.3), np.float32(0.0)).repeat(
            3, 1
        ),
        np.concatenate(triangles).astype(np.int32),
        {},
        1,
        1,
        0,
    )
    with pytest.raises(OptionError, match="no light from outside reaches it"):
        fit_light(launcher, box, voxel=0.1)


def test_reconstruction_writes_estimated_lights_that_read_back(tmp_path, yard_capture):
    options = ReconstructOptions(FusionOptions(voxel=0.05, far=6.0), estimate_light=True)
    made = reconstruct(yard_capture, CaptureFrames(yard_capture), tmp_path / "scene.usda", options)
    assert any("condition number" in note for note in made.notes)
    read = read_stage(tmp_path / "scene.usda", allow_empty_roles=True)
    assert {x.kind for x in read.lights} == {LightKind.DOME, LightKind.DISTANT}
    sun = next(x for x in read.lights if x.kind == LightKind.DISTANT)
    assert -np.array(sun.direction) @ [-0.552, 0.669, 0.497] > np.cos(np.radians(15.0))
    from pxr import Usd

    stage = Usd.Stage.Open(str(tmp_path / "scene.usda"))
    kept = stage.GetPrimAtPath("/Capture/Lights").GetCustomData()["dvct"]
    assert kept["condition"] > 1.0
    assert len(kept["singularValues"]) == 12

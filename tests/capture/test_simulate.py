"""The simulated Kinect: its noise has the size that the sensor's papers say, and its truth is true."""

from __future__ import annotations

import json

import depth_scene as ds
import numpy as np
import pytest

from warp_dvct.capture import paths
from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.capture.noise import EFFECTS, KinectNoise, beside_jump
from warp_dvct.capture.simulate import Simulation, simulate
from warp_dvct.capture.stage import open_capture
from warp_dvct.errors import OptionError
from warp_dvct.usd_scenes import path as bundled

LENS = Intrinsics(200, 150, 183.0, 183.0, 99.5, 74.5)
FACING = np.broadcast_to(np.array([0.0, 0.0, -1.0]), (150, 200, 3))


def wall(z: float) -> np.ndarray:
    return np.full((150, 200), z, np.float32)


@pytest.mark.parametrize("z", [0.8, 1.7, 3.4])
def test_disparity_noise_grows_with_the_square_of_depth(z):
    measured = KinectNoise.only("disparity").apply(wall(z), FACING, LENS, 0, 0)
    expected = z * z / (585.0 * 0.075) / 6.0
    assert np.std(measured) == pytest.approx(expected, rel=0.05)
    assert np.median(measured) == pytest.approx(z, rel=0.002)


@pytest.mark.parametrize("z", [1.0, 3.5])
def test_quantization_steps(z):
    """Khoshelham: z^2 / (8 f b), 2.9 mm at 1 m and 34 mm at 3.5 m."""
    ramp = np.linspace(0.98 * z, 1.02 * z, 150 * 200).reshape(150, 200)
    measured = np.unique(KinectNoise.only("quantization").apply(ramp, FACING, LENS, 0, 0))
    assert np.median(np.diff(measured)) == pytest.approx(z * z / (8 * 585.0 * 0.075), rel=0.05)


def test_range_and_incidence_lose_pixels():
    assert (KinectNoise.only("range").apply(wall(0.4), FACING, LENS, 0, 0) == 0).all()
    assert (KinectNoise.only("range").apply(wall(4.1), FACING, LENS, 0, 0) == 0).all()
    assert (KinectNoise.only("range").apply(wall(2.0), FACING, LENS, 0, 0) == 2.0).all()
    rays = LENS.rays() / np.linalg.norm(LENS.rays(), axis=-1, keepdims=True)
    side = np.cross(rays, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    for degrees, share in ((70.0, 0.0), (77.5, 0.5), (82.0, 1.0)):
        a = np.radians(degrees)
        normal = -np.cos(a) * rays + np.sin(a) * side
        lost = KinectNoise.only("incidence").apply(wall(2.0), normal, LENS, 0, 0) == 0
        assert lost.mean() == pytest.approx(share, abs=0.02)


def test_jumps_lose_about_half_of_the_pixels_beside_them():
    depth = wall(3.0)
    depth[40:90, 60:120] = 1.5
    beside = beside_jump(depth, FACING, LENS)
    assert beside.sum() == 2 * (2 * (50 + 60)) + 4 - 4  # a ring within the block and one around it
    lost = KinectNoise.only("jumps").apply(depth, FACING, LENS, 0, 0) == 0
    assert not (lost & ~beside).any()
    assert lost[beside].mean() == pytest.approx(0.5, abs=0.1)


def test_a_slanted_plane_has_no_jumps():
    normal = np.array([0.9, 0.1, -0.42])
    normal /= np.linalg.norm(normal)
    depth = -2.0 / (LENS.rays() @ normal)
    depth = np.where((depth > 0) & (depth < 50), depth, 0.0)
    inner = beside_jump(depth, np.broadcast_to(normal, (150, 200, 3)), LENS)
    there = np.pad(depth, 1) > 0
    whole = np.all([there[dy : dy + 150, dx : dx + 200] for dy in range(3) for dx in range(3)], 0)
    assert whole[1:-1, 1:-1].sum() > 5000
    assert not inner[1:-1, 1:-1][whole[1:-1, 1:-1]].any()


def test_lateral_noise_moves_edges_and_nothing_else():
    depth = wall(3.0)
    depth[:, 100:] = 1.5
    measured = KinectNoise.only("lateral").apply(depth, FACING, LENS, 0, 0)
    assert set(np.unique(measured)) == {1.5, 3.0}
    wrong = measured != depth
    assert wrong[:, 97:103].any()
    assert not wrong[:, :95].any()


def test_effects_do_not_change_each_others_luck():
    depth = wall(2.0)
    alone = KinectNoise.only("disparity").apply(depth, FACING, LENS, 3, 5)
    both = KinectNoise.only("disparity", "range", "jumps").apply(depth, FACING, LENS, 3, 5)
    np.testing.assert_array_equal(alone, both)
    assert (KinectNoise.only("disparity").apply(depth, FACING, LENS, 3, 6) != alone).any()
    assert (KinectNoise.only().apply(depth, FACING, LENS, 3, 5) == depth).all()
    with pytest.raises(OptionError, match="no effect 'fog'"):
        KinectNoise.only("fog")
    assert KinectNoise.only(*EFFECTS) == KinectNoise()


def test_paths():
    start = paths.look_at(np.array([0.0, 1.0, 2.0]), np.zeros(3), ds.UP)
    arc = paths.orbit(start, np.sqrt(5.0), 5, np.radians(40.0))
    for pose in arc:
        np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
        np.testing.assert_allclose(np.cross(pose[:3, 2], -pose[:3, 3]), 0.0, atol=1e-12)
        assert np.linalg.norm(pose[:3, 3]) == pytest.approx(np.sqrt(5.0))
    np.testing.assert_allclose(arc[2], start, atol=1e-12)
    hand = paths.handheld(start, 2.0, 90, 7)
    np.testing.assert_allclose(hand[0], start, atol=1e-12)
    steps = np.linalg.norm(np.diff([p[:3, 3] for p in hand], axis=0), axis=-1)
    assert 1e-4 < np.median(steps) < 0.05
    assert np.ptp([p[:3, 3] for p in hand], axis=0).min() > 0.02


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sim")
    options = Simulation(frames=3, width=80, height=60, unregistered=True, seed=4)
    return simulate(bundled("room_area"), folder, options), options, folder


def test_capture_and_truth_belong_together(recorded):
    done, _, folder = recorded
    capture, truth = open_capture(done.capture), open_capture(done.truth)
    assert len(capture) == len(truth) == 3
    np.testing.assert_allclose(capture.rig.depth_to_color[:3, 3], [-0.025, 0, 0], atol=1e-9)
    for k in capture:
        np.testing.assert_allclose(capture.pose(k), truth.pose(k), atol=1e-12)
        measured, true = capture.depth(k), truth.depth(k)
        both = (measured > 0) & (true > 0)
        assert both.mean() > 0.7
        assert np.median(np.abs(measured - true)[both] / (true[both] ** 2 / (585 * 0.075) / 6)) == pytest.approx(
            0.7, abs=0.2
        )
    assert capture.color(0).std() > 10
    assert json.loads((folder / "simulation.json").read_text())["seed"] == 4


def test_true_depth_lies_on_the_reference_mesh(recorded):
    from pxr import Usd, UsdGeom

    done, *_ = recorded
    truth = open_capture(done.truth)
    stage = Usd.Stage.Open(str(done.truth))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Capture/mesh"))
    corners = np.array(mesh.GetPointsAttr().Get(), np.float64)[np.array(mesh.GetFaceVertexIndicesAttr().Get())]
    a, b, c = corners.reshape(-1, 3, 3).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    pose = truth.pose(1)
    points = (truth.rig.depth.rays() * truth.depth(1)[..., None])[::7, ::7].reshape(-1, 3)
    points = points @ pose[:3, :3].T + pose[:3, 3]
    # Of the triangle's planes, one is nearer than float32's rounding.
    distance = np.abs(((points[:, None] - a) * normal).sum(-1)).min(-1)
    assert distance.max() < 1e-4


def test_the_same_options_give_the_same_bytes(recorded, tmp_path):
    _, options, folder = recorded
    simulate(bundled("room_area"), tmp_path, options)
    for file in ("depth/00002.png", "color/00002.png", "truth/00002.exr", "capture.usda"):
        assert (tmp_path / file).read_bytes() == (folder / file).read_bytes(), file


def test_a_still_camera_is_no_path(tmp_path):
    with pytest.raises(OptionError, match="does not move"):
        simulate(bundled("room_area"), tmp_path, Simulation(frames=2, path="stage"))
    with pytest.raises(OptionError, match="0 frames"):
        simulate(bundled("room_area"), tmp_path, Simulation(frames=0))

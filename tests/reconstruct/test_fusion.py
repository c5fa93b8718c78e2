"""Fusion against the surface that the frames were rendered from."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from captures import nearest, real_triangles

from warp_dvct.capture import fusion
from warp_dvct.capture.frames import FrameList, RgbdFrame, Skipped
from warp_dvct.capture.fusion import (
    FusedMesh,
    FusionOptions,
    clean_depth,
    count_blocks,
    fuse,
    open3d_for_reconstruction,
)
from warp_dvct.capture.irradiance import Lighting, Receivers
from warp_dvct.capture.source import CaptureFrames
from warp_dvct.errors import DeviceError, FileError, OptionError

COARSE = FusionOptions(voxel=0.03)


@pytest.fixture(scope="module")
def frames(room_capture) -> FrameList:
    source = CaptureFrames(room_capture)
    return FrameList([source.frame(i) for i in range(len(source))])


def plane(distance: float = 1.0, size: tuple[int, int] = (60, 80)) -> RgbdFrame:
    """A wall that faces the camera at the world's origin."""
    K = np.array([[70.0, 0, 39.5], [0, 70.0, 29.5], [0, 0, 1]])
    color = np.full((*size, 3), (0.2, 0.4, 0.6), np.float32)
    return RgbdFrame("wall", np.full(size, distance, np.float32), color, K, np.eye(4))


def test_surface_lies_where_the_truth_is(frames, room):
    mesh = fuse(frames, COARSE)
    distance, _ = nearest(room, mesh.points)
    assert np.median(distance) < 0.001
    assert np.percentile(distance, 95) < 0.8 * COARSE.voxel
    assert mesh.frames == len(frames)
    assert not mesh.skipped


def test_noise_of_the_sensor_averages_out(noisy_capture, room):
    source = CaptureFrames(noisy_capture)
    plain = fuse(source, replace(COARSE, smooth=False, voxel=0.02))
    smooth = fuse(source, replace(COARSE, voxel=0.02))
    errors = [np.median(nearest(room, mesh.points)[0]) for mesh in (plain, smooth)]
    assert errors[1] < 0.006
    assert errors[1] < 0.8 * errors[0]


def test_triangles_and_normals_face_the_camera():
    mesh = fuse(FrameList([plane()]), FusionOptions(voxel=0.02))
    assert (mesh.normals[:, 2] < -0.9).mean() > 0.95
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    facing = np.cross(b - a, c - a)[:, 2]
    assert (facing <= 0.0).all()


def test_position_and_colour_of_a_wall_are_exact():
    mesh = fuse(FrameList([plane(1.237)]), FusionOptions(voxel=0.02))
    np.testing.assert_allclose(mesh.points[:, 2], 1.237, atol=1e-4)
    assert mesh.colors is not None
    np.testing.assert_allclose(mesh.colors, [[0.2, 0.4, 0.6]] * len(mesh.points), atol=2e-3)


def test_pixels_without_colour_do_not_darken_the_mean():
    wall = plane()
    assert wall.color is not None
    half = wall.color.copy()
    half[:, :40] = np.nan
    mesh = fuse(FrameList([wall, replace(wall, color=half)]), FusionOptions(voxel=0.02, weight=1))
    assert mesh.colors is not None
    assert mesh.colors.min() > 0.19


def test_a_floater_is_dropped_and_would_otherwise_be_there(frames, room):
    first = frames.frames[6]  # from the middle of the room
    depth = first.depth.copy()
    depth[40:64, 60:90] = 0.6
    dirty = FrameList([replace(first, depth=depth)])
    # Only this frame sees the place: that it is small is all that tells that it floats.
    kept = fuse(dirty, replace(COARSE, least_area=0.0))
    cleaned = fuse(dirty, COARSE)
    assert nearest(room, kept.points)[0].max() > 0.3
    assert nearest(room, cleaned.points)[0].max() < 0.1
    assert cleaned.dropped > 0
    # Frames that look through it take it away.
    several = FrameList([*dirty.frames, *frames.frames[3:6], *frames.frames[7:10]])
    assert nearest(room, fuse(several, replace(COARSE, least_area=0.0)).points)[0].max() < 0.1


def test_no_floater_casts_a_shadow(noisy_capture, room, launcher):
    """Light of the lamp on the true surface, 3 cm above it: where it arrives in the true room it does in the scan.

    Beside things of which the scan knows only the front, the scan is lighter, never darker.
    """
    mesh = fuse(CaptureFrames(noisy_capture), replace(COARSE, voxel=0.02))
    points, triangles, _ = real_triangles(room)
    corners = points[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=-1)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(area), 20000, p=area / area.sum())
    share = rng.dirichlet(np.ones(3), 20000)
    at = (corners[chosen] * share[..., None]).sum(1)
    normal = cross[chosen] / area[chosen][:, None]
    o3d = open3d_for_reconstruction(2)
    cast = o3d.t.geometry.RaycastingScene()
    cast.add_triangles(o3d.core.Tensor(mesh.points), o3d.core.Tensor(mesh.triangles.astype(np.uint32)))
    seen = cast.compute_distance(o3d.core.Tensor(at.astype(np.float32))).numpy() < 0.02
    receivers = Receivers(at[seen], normal[seen], 0.03)
    white = FusedMesh(points.astype(np.float32), np.zeros_like(points), None, triangles.astype(np.int32), {}, 1, 1, 0)
    hanging = np.array([[-0.15, 0.5, -0.3], [0.15, 0.5, -0.3], [0.0, 0.5, 0.0]], np.float32)
    floater = FusedMesh(
        np.concatenate([mesh.points, hanging]),
        np.concatenate([mesh.normals, np.zeros((3, 3), np.float32)]),
        None,
        np.concatenate([mesh.triangles, len(mesh.points) + np.array([[0, 2, 1]], np.int32)]),
        {},
        1,
        1,
        0,
    )
    true, ours, shadowed = (
        Lighting(launcher, m, np.full((len(m.points), 3), 0.5), room.lights).direct(receivers)[:, 0]
        for m in (white, mesh, floater)
    )
    lit = true > 0.2 * np.median(true)
    assert lit.sum() > 3000
    assert (ours < 0.8 * true)[lit].mean() < 0.003
    assert np.median(ours[lit] / true[lit]) == pytest.approx(1.0, abs=0.01)
    assert (shadowed < 0.8 * true)[lit].mean() > 0.006  # one of 30 cm would be found


def test_pixels_at_a_jump_of_depth_are_left_out():
    depth = np.full((40, 60), 2.0, np.float32)
    depth[:, 30:] = 1.0
    depth[:, 30] = 1.4  # a pixel that mixes both sides
    o3d = open3d_for_reconstruction(1)
    left = clean_depth(o3d, depth, FusionOptions())[..., 0]
    assert not left[5:-5, 30].any()
    np.testing.assert_allclose(left[5:-5, 5:27], 2.0, atol=1e-3)
    np.testing.assert_allclose(left[5:-5, 34:55], 1.0, atol=1e-3)


def test_a_slanted_plane_is_no_jump():
    v, u = np.mgrid[0:120, 0:160]
    depth = (1.0 / (0.35 + 0.004 * (v / 120.0) * 100 + 0.0005 * u)).astype(np.float32)
    left = clean_depth(open3d_for_reconstruction(1), depth, FusionOptions(far=10.0))[..., 0]
    assert (left[8:-8, 8:-8] > 0.0).all()
    np.testing.assert_allclose(left[8:-8, 8:-8], depth[8:-8, 8:-8], rtol=2e-3)


def test_invalid_depth_is_no_surface():
    wall = plane()
    depth = wall.depth.copy()
    depth[::12, ::12] = 0.0
    depth[30:40, 20:35] = 0.0
    mesh = fuse(FrameList([replace(wall, depth=depth)]), FusionOptions(voxel=0.02, smooth=False))
    assert (mesh.points[:, 2] > 0.9).all()


def test_blocks_are_counted_before_they_are_made(frames):
    counted = count_blocks(frames, COARSE, Skipped(), lambda share: None)
    grid = fusion.integrate(open3d_for_reconstruction(2), frames, COARSE, counted, Skipped(), lambda share: None)
    used = grid.hashmap().size()
    assert used <= counted * fusion.SPARE_BLOCKS
    assert counted < 1.5 * used


def test_what_does_not_fit_into_memory_is_refused_before_it_is_tried(frames, monkeypatch):
    monkeypatch.setattr(fusion.os, "sysconf", lambda name: 4096 if name == "SC_PAGE_SIZE" else 1000)
    with pytest.raises(DeviceError, match=r"give --voxel 0\.\d+ or more"):
        fuse(frames, COARSE)


class Damaged:
    """Frames of which some cannot be read."""

    def __init__(self, frames: FrameList, bad: set[int]) -> None:
        self.frames, self.bad, self.asked = frames, bad, []

    def __len__(self) -> int:
        return len(self.frames)

    def name(self, index: int) -> str:
        return f"frame {index}"

    def frame(self, index: int, *, color: bool = True) -> RgbdFrame:
        self.asked.append(index)
        if index in self.bad:
            raise FileError(f"frame {index}: depth 'x.png' is damaged; copy it again")
        return self.frames.frame(index)


def test_damaged_frames_are_left_out_and_said(frames):
    lost = replace(frames.frames[2], pose=None)
    empty = replace(frames.frames[3], depth=np.zeros_like(frames.frames[3].depth))
    some = FrameList([*frames.frames[:2], lost, empty, *frames.frames[4:]])
    source = Damaged(some, {1})
    mesh = fuse(source, COARSE)
    assert sorted(mesh.skipped) == [1, 2, 3]
    assert "frame 1" in mesh.skipped[1]
    assert "--track" in mesh.skipped[2]
    assert "no pixel has a depth" in mesh.skipped[3]
    assert mesh.frames == len(frames) - 3
    assert source.asked.count(1) == 1  # found bad once, it is not read again


def test_a_capture_without_a_usable_frame_is_an_error(frames):
    with pytest.raises(FileError, match="none of 12 frames can be used; the first: frame 0"):
        fuse(Damaged(frames, set(range(12))), COARSE)


def test_nothing_in_range_is_said():
    with pytest.raises(FileError, match=r"none of 1 frames can be used.*no pixel is between 0.1 and 0.2 m"):
        fuse(FrameList([plane()]), FusionOptions(voxel=0.02, far=0.2))


def test_without_open3d_the_extra_is_named(frames, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(OptionError, match=r"pip install 'warp-dvct\[reconstruct\]'"):
        fuse(frames, COARSE)


def test_holes_are_closed_and_triangles_decimated():
    wall = plane()
    depth = wall.depth.copy()
    depth[25:35, 35:45] = 0.0  # 14 cm across
    source = FrameList([replace(wall, depth=depth)])
    options = FusionOptions(voxel=0.02, smooth=False)
    open_, closed = fuse(source, options), fuse(source, replace(options, close_holes=0.3))
    assert _area(closed) > _area(open_) + 0.01
    few = fuse(source, replace(options, triangles=200))
    assert len(few.triangles) <= 200
    assert few.colors is not None
    np.testing.assert_allclose(few.points[:, 2], 1.0, atol=2e-3)
    assert _area(few) == pytest.approx(_area(open_), rel=0.05)


def _area(mesh) -> float:
    a, b, c = (mesh.points[mesh.triangles[:, k]].astype(float) for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum())


@pytest.mark.parametrize("wrong", [{"voxel": 0.0}, {"truncation": 0.5}, {"near": 2.0, "far": 1.0}, {"triangles": 2}])
def test_unusable_options_are_refused(wrong):
    with pytest.raises(OptionError, match="give"):
        FusionOptions(**wrong)


def test_a_surface_that_too_few_frames_saw_is_said():
    with pytest.raises(OptionError, match="no surface was seen by at least 3 of 1 frames"):
        fuse(FrameList([plane()]), FusionOptions(weight=3))


def test_colour_of_a_camera_beside_the_depth_camera_is_registered(tmp_path, room):
    from warp_dvct import usd_scenes
    from warp_dvct.capture.noise import KinectNoise
    from warp_dvct.capture.simulate import Simulation, simulate
    from warp_dvct.capture.stage import open_capture

    options = Simulation(
        frames=3, width=160, height=120, path="orbit", arc=5.0, noise=KinectNoise.only(), unregistered=True
    )
    capture = open_capture(simulate(usd_scenes.path("room_area"), tmp_path, options).capture)
    frame = CaptureFrames(capture).frame(1)
    assert frame.color is not None
    hidden = ~np.isfinite(frame.color).all(-1)
    assert 0.0 < hidden.mean() < 0.3
    # Red and green walls: colour must change where depth says that the wall begins.
    assert frame.pose is not None
    points = (capture.rig.depth.rays() * frame.depth[..., None]) @ frame.pose[:3, :3].T + frame.pose[:3, 3]
    seen = (frame.depth > 0) & ~hidden
    left = seen & (points[..., 0] < -1.79)
    back = seen & (points[..., 2] < -1.79) & (points[..., 0] > -1.7) & (points[..., 0] < 1.7)
    redness = frame.color[..., 0] / np.maximum(frame.color[..., 1], 1e-3)
    assert left.sum() > 100
    assert np.percentile(redness[left], 10) > 3.0
    assert np.percentile(redness[back], 90) < 3.0

"""Poses by odometry, by the model and by markers, against those that the pictures were made with."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from warp_dvct.capture.frames import FrameList
from warp_dvct.capture.fusion import FusionOptions
from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.capture.markers import find_markers, spot_on_marker, track_by_markers
from warp_dvct.capture.paths import look_at
from warp_dvct.capture.source import CaptureFrames
from warp_dvct.capture.stage import CaptureRig, FrameFiles, open_capture, write_capture
from warp_dvct.capture.tracking import track
from warp_dvct.errors import OptionError
from warp_dvct.image import srgb_to_linear, write_png

LENS = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5, (0.05, -0.1, 0.001, -0.0005))
SIZE = 0.1
UP = np.array([0.0, 1.0, 0.0])
# Marker to world: flat on a table at y = 0.7, one turned by 30 degrees.
TURN = np.radians(30.0)
TABLE = {
    3: np.array([[1.0, 0, 0, 0.0], [0, 0, 1.0, 0.7], [0, -1.0, 0, 0.0], [0, 0, 0, 1.0]]),
    7: np.array(
        [
            [np.cos(TURN), -np.sin(TURN), 0, 0.25],
            [0, 0, 1.0, 0.7],
            [-np.sin(TURN), -np.cos(TURN), 0, 0.05],
            [0, 0, 0, 1.0],
        ]
    ),
}


LINEAR = srgb_to_linear(np.arange(256) / 255.0)


@functools.cache
def rays_of(i: int, j: int) -> np.ndarray:
    """Directions through one of sixteen points of every pixel."""
    return replace(LENS, cx=LENS.cx - (i - 1.5) / 4, cy=LENS.cy - (j - 1.5) / 4).rays()


def render(pose: np.ndarray, markers: dict[int, np.ndarray], name: str = "DICT_4X4_50") -> np.ndarray:
    """What a camera sees of markers on a grey ground, by rays through sixteen points of every pixel."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    total = np.zeros((LENS.height, LENS.width))
    for i in range(4):
        for j in range(4):
            rays = rays_of(i, j) @ pose[:3, :3].T
            picture = np.full(total.shape, LINEAR[120])
            for number, placed in markers.items():
                code = cv2.aruco.generateImageMarker(dictionary, number, 60)
                code = np.pad(code, 10, constant_values=255)
                local = np.linalg.inv(placed)
                origin, direction = local[:3, :3] @ pose[:3, 3] + local[:3, 3], rays @ local[:3, :3].T
                hit = origin + direction * (-origin[2] / direction[..., 2])[..., None]
                u, v = (hit[..., 0] / SIZE + 0.5) * 60 + 10, (0.5 - hit[..., 1] / SIZE) * 60 + 10
                inside = (u >= 0) & (u < 80) & (v >= 0) & (v < 80) & (direction[..., 2] < 0)
                column, row = u[inside].astype(int), v[inside].astype(int)
                picture[inside] = LINEAR[code[row, column]]
            total += picture / 16.0
    codes = np.searchsorted(0.5 * (LINEAR[1:] + LINEAR[:-1]), total)  # pixels average light, not codes
    return np.repeat(codes.astype(np.uint8)[..., None], 3, 2)


def viewpoint(angle: float, distance: float = 0.8) -> np.ndarray:
    eye = np.array([0.1 + distance * np.sin(angle), 0.7 + 0.7 * distance, distance * np.cos(angle)])
    return look_at(eye, np.array([0.1, 0.7, 0.0]), UP)


@pytest.fixture(scope="module")
def marked(tmp_path_factory):
    """A capture of six frames: the last sees no marker, the third sees only the one that is turned."""
    folder = tmp_path_factory.mktemp("markers")
    files, poses = [], []
    for k in range(6):
        pose = viewpoint(-0.5 + 0.2 * k)
        shown = {0: TABLE, 2: {7: TABLE[7]}, 5: {}}.get(k, TABLE)
        write_png(folder / f"{k}.png", render(pose, shown))
        rays = LENS.rays() @ pose[:3, :3].T
        depth = (0.7 - pose[1, 3]) / rays[..., 1]
        depth = np.where((depth > 0.0) & (depth < 4.0), depth, 0.0)
        write_png(folder / f"d{k}.png", np.rint(depth * 1000).astype(np.uint16)[..., None])
        files.append(FrameFiles(str(folder / f"d{k}.png"), str(folder / f"{k}.png"), pose))
        poses.append(pose)
    write_capture(folder / "capture.usda", CaptureRig(LENS, LENS), files, world=np.eye(4))
    return open_capture(folder / "capture.usda"), poses


@pytest.mark.parametrize("name", ["DICT_4X4_50", "DICT_APRILTAG_36h11"])
def test_a_marker_is_found_with_its_pose(name):
    pose = viewpoint(0.3)
    found = find_markers(render(pose, TABLE, name), LENS, SIZE, name)
    assert [s.id for s in found] == [3, 7]
    for sighting in found:
        truth = np.linalg.inv(pose) @ TABLE[sighting.id]
        assert np.linalg.norm(sighting.pose[:3, 3] - truth[:3, 3]) < 0.001 * truth[2, 3]
        sideways = sighting.pose[:2, 3] / sighting.pose[2, 3] - truth[:2, 3] / truth[2, 3]
        assert np.abs(sideways).max() < 1e-3
        turn = sighting.pose[:3, :3].T @ truth[:3, :3]
        assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 2.0
        assert sighting.error < 0.5


def test_far_away_markers_are_not_believed():
    assert find_markers(render(viewpoint(0.3, 6.0), TABLE), LENS, SIZE) == []


def test_the_spot_on_a_marker(marked):
    capture, _ = marked
    spot = spot_on_marker(capture, 3, SIZE)
    np.testing.assert_allclose(spot.position[[0, 2]], 0.0, atol=0.001)
    np.testing.assert_allclose(spot.position[1], 0.7, atol=0.001)  # depth says where the table is
    assert spot.normal @ UP > np.cos(np.radians(2.0))
    assert spot.forward @ [0.0, 0.0, 1.0] > np.cos(np.radians(2.0))  # to the marker's lower edge


def test_a_marker_that_is_not_there_is_said_with_those_that_are(marked):
    with pytest.raises(OptionError, match=r"--marker 5 is in no frame.*that are seen: 3, 7\)"):
        spot_on_marker(marked[0], 5, SIZE)
    with pytest.raises(OptionError, match=r"no marker dictionary 'DICT_X'.*DICT_4X4_50"):
        spot_on_marker(marked[0], 3, SIZE, "DICT_X")


def test_tracking_by_markers(marked):
    capture, poses = marked
    found = track_by_markers(capture, SIZE)
    assert list(found.lost) == [5]
    assert "lost" in found.lost[5]
    assert found.poses[5] is None
    # The origin is one of the markers: only motions relative to the first frame compare.
    for k in range(1, 5):
        pose = found.poses[k]
        assert pose is not None
        assert found.poses[0] is not None
        move = np.linalg.inv(found.poses[0]) @ pose
        truth = np.linalg.inv(poses[0]) @ poses[k]
        assert np.linalg.norm(move[:3, 3] - truth[:3, 3]) < 0.002, k
    # Up is out of the table.
    assert found.poses[0] is not None
    np.testing.assert_allclose(found.poses[0][1, 3], 0.7 * 0.8, atol=0.002)


def test_without_opencv_the_extra_is_named(marked, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(OptionError, match=r"pip install 'warp-dvct\[markers\]'"):
        spot_on_marker(marked[0], 3, SIZE)


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> FrameList:
    """Eight frames of a hand-held camera in the bundled room with the block, 320 pixels across."""
    from warp_dvct import usd_scenes
    from warp_dvct.capture.noise import KinectNoise
    from warp_dvct.capture.simulate import Simulation, simulate

    options = Simulation(frames=8, width=320, height=240, path="orbit", arc=14.0, noise=KinectNoise.only())
    done = simulate(usd_scenes.path("colour_bleeding"), tmp_path_factory.mktemp("hand"), options)
    source = CaptureFrames(open_capture(done.capture))
    return FrameList([source.frame(i) for i in range(len(source))])


@pytest.mark.parametrize("tracker", ["odometry", "model"])
def test_tracking_follows_the_camera(frames, tracker):
    start = frames.frames[0].pose
    assert start is not None
    found = track(frames, tracker, start, FusionOptions(voxel=0.02))
    assert not found.lost
    path = 0.0
    for k, frame in enumerate(frames.frames):
        assert frame.pose is not None
        assert found.poses[k] is not None
        path += np.linalg.norm(frame.pose[:3, 3] - frames.frames[max(0, k - 1)].pose[:3, 3])  # type: ignore[index]
    off = np.linalg.norm(found.poses[-1][:3, 3] - frames.frames[-1].pose[:3, 3])  # type: ignore[index]
    assert path > 0.4
    assert off < 0.08 * path


def test_a_lost_frame_is_marked_and_the_next_is_found(frames):
    bad = list(frames.frames)
    noise = np.random.default_rng(0).uniform(0.5, 3.0, bad[3].depth.shape).astype(np.float32)
    bad[3] = replace(bad[3], depth=noise)
    start = bad[0].pose
    assert start is not None
    found = track(FrameList(bad), "odometry", start, FusionOptions(voxel=0.02))
    assert list(found.lost) == [3]
    assert found.poses[3] is None
    off = np.linalg.norm(found.poses[-1][:3, 3] - bad[-1].pose[:3, 3])  # type: ignore[index]
    assert off < 0.05


def test_an_unknown_tracker_is_refused(frames):
    with pytest.raises(OptionError, match="choose one of odometry, model"):
        track(frames, "magic", np.eye(4), FusionOptions())

"""Capture stages: what is written is what is opened, and what is wrong with one is said by the frame's name."""

from __future__ import annotations

import datasets as data
import numpy as np
import pytest

from warp_dvct.capture.intrinsics import FLIP, Intrinsics
from warp_dvct.capture.stage import CaptureRig, FrameFiles, open_capture, write_capture
from warp_dvct.errors import FileError, StageError
from warp_dvct.image import write_depth_exr

LENS = Intrinsics(data.WIDTH, data.HEIGHT, 60.0, 61.0, 30.0, 25.0)
COLOR = Intrinsics(data.WIDTH, data.HEIGHT, 55.0, 56.0, 33.0, 22.0, (0.1, -0.2, 0.001, 0.002, 0.01))
EXTRINSIC = np.eye(4)
EXTRINSIC[:3, :3] = data.pose(1)[:3, :3]
EXTRINSIC[:3, 3] = 0.025, 0.001, -0.002


@pytest.fixture
def frames(tmp_path):
    made = []
    for k in range(3):
        depth, color = tmp_path / f"d{k}.png", tmp_path / f"c{k}.png"
        data.write_depth(depth, data.depth_codes(k))
        data.write_photo(color, data.photo(k))
        made.append(FrameFiles(str(depth), str(color), data.pose(k) if k != 1 else None, timestamp=0.1 * k))
    return made


def written(tmp_path, frames, **rig):
    write_capture(tmp_path / "capture.usda", CaptureRig(LENS, COLOR, EXTRINSIC, **rig), frames)
    return open_capture(tmp_path / "capture.usda")


def test_everything_comes_back(tmp_path, frames):
    capture = written(tmp_path, frames, invalid=(0, 1500))
    assert capture.times == (0.0, 1.0, 2.0)
    for ours, theirs in ((LENS, capture.rig.depth), (COLOR, capture.rig.color)):
        np.testing.assert_allclose(theirs.K, ours.K, rtol=1e-6)
        np.testing.assert_allclose(theirs.distortion, ours.distortion, rtol=1e-6)
    np.testing.assert_allclose(capture.rig.depth_to_color, EXTRINSIC, atol=1e-9)
    assert capture.rig.unit == 0.001
    # The capture's world has y down; the stage's is y up.
    np.testing.assert_allclose(capture.pose(0), FLIP @ data.pose(0), atol=1e-9)
    np.testing.assert_allclose(capture.color_pose(2), FLIP @ data.pose(2) @ np.linalg.inv(EXTRINSIC), atol=1e-9)
    assert capture.pose(1) is None
    codes = data.depth_codes(0)
    expected = np.where(np.isin(codes, [0, 1500]), 0.0, codes / 1000.0)
    np.testing.assert_allclose(capture.depth(0), expected, rtol=1e-6)
    assert capture.depth(0).dtype == np.float32
    np.testing.assert_array_equal(capture.color(2), data.photo(2))
    assert capture.timestamp(2) == pytest.approx(0.2)


def test_usd_sees_the_same_cameras(tmp_path, frames):
    """A point that the pinhole projects to a pixel lies there in Gf.Camera's frustum, too."""
    from pxr import Gf, Usd, UsdGeom

    capture = written(tmp_path, frames)
    stage = Usd.Stage.Open(capture.path)
    for path, lens, pose in (
        (capture.depth_path, LENS, capture.pose(2)),
        (capture.color_path, COLOR, capture.color_pose(2)),
    ):
        frustum = UsdGeom.Camera(stage.GetPrimAtPath(path)).GetCamera(2.0).frustum
        pixel = np.array([7.0, 40.0])
        ray = np.array([(pixel[0] - lens.cx) / lens.fx, (pixel[1] - lens.cy) / lens.fy, 1.0])
        point = pose[:3, :3] @ (2.0 * ray) + pose[:3, 3]
        seen = (frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).Transform(Gf.Vec3d(*point))
        expected = [2 * (pixel[0] + 0.5) / lens.width - 1, 1 - 2 * (pixel[1] + 0.5) / lens.height]
        np.testing.assert_allclose(list(seen)[:2], expected, atol=1e-5)


def test_float_depth_may_hold_anything(tmp_path):
    values = np.full((data.HEIGHT, data.WIDTH), 1.25, np.float32)
    values[0, :4] = np.nan, np.inf, -1.0, 0.0
    write_depth_exr(tmp_path / "d.exr", values)
    write_capture(
        tmp_path / "c.usda", CaptureRig(LENS, unit=1.0), [FrameFiles(str(tmp_path / "d.exr"), None, np.eye(4))]
    )
    capture = open_capture(tmp_path / "c.usda")
    assert (capture.depth(0)[0, :4] == 0).all()
    assert capture.depth(0)[1, 1] == 1.25
    assert capture.color(0) is None
    assert capture.rig.color is None


def test_a_folder_moves_as_a_whole(tmp_path, frames):
    written(tmp_path, frames)
    moved = tmp_path.parent / f"{tmp_path.name} moved"
    tmp_path.rename(moved)
    assert open_capture(moved / "capture.usda").depth(0).max() > 1.0
    moved.rename(tmp_path)


def test_an_earlier_file_survives_a_failure(tmp_path, frames):
    written(tmp_path, frames)
    before = (tmp_path / "capture.usda").read_bytes()
    skewed = np.diag([1.0, 2.0, 1.0, 1.0])
    with pytest.raises(FileError, match=r"d0\.png.*not rigid"):
        write_capture(tmp_path / "capture.usda", CaptureRig(LENS), [FrameFiles(frames[0].depth, None, skewed)])
    with pytest.raises(FileError, match="no frames"):
        write_capture(tmp_path / "capture.usda", CaptureRig(LENS), [])
    assert (tmp_path / "capture.usda").read_bytes() == before
    assert not [f for f in tmp_path.iterdir() if f.name.startswith(".")]


def test_what_is_written_again_is_opened_anew(tmp_path, frames):
    first = written(tmp_path, frames)
    second = written(tmp_path, frames, unit=0.002)
    assert (first.rig.unit, second.rig.unit) == (0.001, 0.002)
    np.testing.assert_allclose(second.depth(0), 2.0 * first.depth(0), rtol=1e-6)


def test_bad_frames_are_named(tmp_path, frames):
    capture = written(tmp_path, frames)
    data.write_depth(tmp_path / "d0.png", np.full((4, 5), 1000, np.uint16))
    with pytest.raises(FileError, match=r"frame 0 of .*d0\.png' is 5 x 4 pixels but its camera has 64 x 48"):
        capture.depth(0)
    (tmp_path / "d1.png").write_bytes((tmp_path / "d1.png").read_bytes()[:-100])
    with pytest.raises(FileError, match=r"frame 1 of .*d1\.png' is damaged"):
        capture.depth(1)
    (tmp_path / "c2.png").unlink()
    with pytest.raises(FileError, match=r"frame 2 of .*c2\.png"):
        open_capture(tmp_path / "capture.usda").color(2)
    data.write_photo(tmp_path / "d2.png", data.photo(0))
    with pytest.raises(FileError, match="8 bits"):
        capture.depth(2)


def test_other_stages_are_no_captures(tmp_path):
    (tmp_path / "empty.usda").write_text("#usda 1.0\n")
    with pytest.raises(StageError, match=r"not a capture.*capture import"):
        open_capture(tmp_path / "empty.usda")
    with pytest.raises(StageError, match="does not exist"):
        open_capture(tmp_path / "none.usda")
    camera = 'def Camera "d"\n{\n    custom asset dvct:depth:file\n}\n'
    (tmp_path / "two.usda").write_text("#usda 1.0\n" + camera + camera.replace('"d"', '"e"'))
    with pytest.raises(StageError, match=r"several depth cameras.*/d, /e"):
        open_capture(tmp_path / "two.usda")
    with pytest.raises(FileError, match="no frames"):
        open_capture(tmp_path / "two.usda", camera="/d")

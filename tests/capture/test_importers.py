"""Datasets of every known format become the same capture; what is wrong with one is said."""

from __future__ import annotations

from pathlib import Path

import datasets as data
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from warp_dvct.capture.formats import associate
from warp_dvct.capture.importers import UPS, ImportOptions, import_capture, up_matrix
from warp_dvct.capture.stage import open_capture
from warp_dvct.errors import FileError, OptionError
from warp_dvct.image import write_png

SHARED = Path(__file__).parents[3] / "shared" / "data" / "captures"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"the captures in {SHARED} are not here")


def imported(source: Path, tmp_path: Path, **options):
    output = tmp_path / "capture.usda"
    done = import_capture(source, output, ImportOptions(**options))
    return done, open_capture(output)


@pytest.mark.parametrize("make", [data.redwood, data.scannet], ids=["redwood", "scannet"])
def test_depth_color_and_poses_arrive(make, tmp_path):
    done, capture = imported(make(tmp_path / "set"), tmp_path)
    assert (done.frames, done.posed, done.colored, done.up) == (3, 3, 3, "y")
    lens = capture.rig.depth
    np.testing.assert_allclose([lens.fx, lens.fy, lens.cx, lens.cy], [60, 61, 31, 24], rtol=1e-6)
    for k in capture:
        np.testing.assert_allclose(capture.depth(k), data.depth_codes(k) / 1000.0, rtol=1e-6)
        np.testing.assert_array_equal(capture.color(k), data.photo(k))
        np.testing.assert_allclose(capture.pose(k), data.pose(k), atol=1e-6)


def test_tum_goes_by_time_stamps(tmp_path):
    done, capture = imported(data.tum(tmp_path), tmp_path)
    assert (done.format, done.frames, done.posed) == ("tum", 2, 2)
    assert any("1 depth images have no photograph within 20 ms" in note for note in done.notes)
    np.testing.assert_array_equal(capture.color(1), data.photo(2))
    np.testing.assert_allclose(capture.depth(1), data.depth_codes(2) / 1000.0, rtol=1e-6)
    assert capture.timestamp(1) == pytest.approx(100.0 + 2 / 30.0, abs=1e-6)
    # Half a turn about y, in a world whose y points down as the cameras' does: that world is turned over.
    np.testing.assert_allclose(
        np.linalg.inv(capture.world) @ capture.pose(1),
        [[-1, 0, 0, 0.2], [0, 1, 0, 1], [0, 0, -1, 2], [0, 0, 0, 1]],
        atol=1e-9,
    )
    assert done.up == "-y"


@given(st.lists(st.floats(0, 10), max_size=20, unique=True), st.lists(st.floats(0, 10), max_size=20, unique=True))
def test_association_is_within_the_limit_and_one_to_one(a, b):
    a, b = sorted(a), sorted(b)
    found = associate(a, b, limit=0.5)
    assert all(abs(a[i] - b[j]) <= 0.5 for i, j in found.items())
    assert len(set(found.values())) == len(found)
    left = [i for i in range(len(a)) if i not in found]
    free = set(range(len(b))) - set(found.values())
    # Nothing is left that could still be paired with its nearest neighbours.
    for i in left:
        nearest = sorted(range(len(b)), key=lambda j: abs(b[j] - a[i]))[:1]
        assert not (nearest and nearest[0] in free and abs(b[nearest[0]] - a[i]) <= 0.5)


def test_seven_scenes_asks_for_the_extrinsic_and_knows_what_is_invalid(tmp_path):
    (tmp_path / "set").mkdir()
    folder = data.seven_scenes(tmp_path / "set")
    with pytest.raises(OptionError, match=r"not registered.*--color-extrinsic"):
        imported(folder, tmp_path)
    done, capture = imported(folder, tmp_path, color_extrinsic="kinect")
    assert (done.frames, done.posed) == (3, 2)
    assert any("frame 1" in note and "not finite" in note for note in done.notes)
    assert capture.pose(1) is None
    assert (capture.depth(0)[0, :5] == 0).all()
    np.testing.assert_allclose(capture.rig.depth_to_color[:3, 3], [-0.025, 0, 0], atol=1e-9)
    matrix = np.eye(4)
    matrix[:3, 3] = 0.1, 0.2, 0.3
    (tmp_path / "extrinsic.txt").write_text(data.text(matrix))
    _, capture = imported(folder, tmp_path, color_extrinsic=str(tmp_path / "extrinsic.txt"))
    np.testing.assert_allclose(capture.rig.depth_to_color, matrix, atol=1e-9)
    done, capture = imported(folder, tmp_path, color_extrinsic="none")
    assert (done.colored, capture.color_path) == (0, None)


def test_sens_is_unpacked(tmp_path):
    done, capture = imported(data.sens(tmp_path / "scene.sens"), tmp_path)
    assert (done.format, done.frames, done.posed, done.colored) == ("scannet", 3, 3, 3)
    np.testing.assert_allclose(capture.depth(2), data.depth_codes(2) / 1000.0, rtol=1e-6)
    np.testing.assert_array_equal(capture.color(2), data.photo(2))
    np.testing.assert_allclose(capture.pose(2), data.pose(2), atol=1e-6)
    np.testing.assert_allclose(capture.rig.depth_to_color[:3, 3], [0.03, 0, 0], atol=1e-7)
    assert capture.timestamp(2) == pytest.approx(0.066666)


def test_a_sens_that_breaks_off_gives_its_whole_frames(tmp_path):
    done, _ = imported(data.sens(tmp_path / "scene.sens", cut=10), tmp_path)
    assert done.frames == 2
    assert "breaks off in frame 2 of 3" in done.notes[0]


@pytest.mark.parametrize("content", [b"", b"\x04\0\0\0", b"\x09" + bytes(400)])
def test_what_is_no_sens_is_refused(content, tmp_path):
    (tmp_path / "scene.sens").write_bytes(content)
    with pytest.raises(FileError, match=r"scene\.sens"):
        imported(tmp_path / "scene.sens", tmp_path)


def test_a_single_pair_is_a_capture(tmp_path):
    data.write_depth(tmp_path / "set" / "a.png", data.depth_codes(0))
    data.write_photo(tmp_path / "set" / "b.png", data.photo(0))
    done, capture = imported(tmp_path / "set", tmp_path)
    assert (done.format, done.frames, done.colored) == ("pair", 1, 1)
    np.testing.assert_allclose(capture.pose(0)[:3, :3], np.diag([1, -1, -1]), atol=1e-9)


def test_a_wrong_unit_is_asked_for(tmp_path):
    folder = data.redwood(tmp_path / "set")
    for k in range(data.COUNT):
        data.write_depth(folder / "depth" / f"{k}.png", (data.depth_codes(k) * 10).astype(np.uint16))
    with pytest.raises(FileError, match=r"median depth is \d.*--depth-unit"):
        imported(folder, tmp_path)
    assert not (tmp_path / "capture.usda").exists()
    done, _ = imported(folder, tmp_path, depth_unit=0.0001)
    assert done.median_depth == pytest.approx(2.0, abs=0.1)


def test_damaged_frames_are_left_out_and_counted(tmp_path):
    folder = data.redwood(tmp_path / "set")
    broken = folder / "depth" / "1.png"
    broken.write_bytes(broken.read_bytes()[:-200])
    done, capture = imported(folder, tmp_path)
    assert (done.frames, len(done.skipped)) == (2, 1)
    assert "1.png" in done.skipped[0]
    np.testing.assert_allclose(capture.pose(1), data.pose(2), atol=1e-6)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: write_png(f / "depth" / "0.png", np.zeros((data.HEIGHT, data.WIDTH, 1), np.uint8)), "8 bits"),
        (lambda f: data.write_depth(f / "depth" / "0.png", np.full((5, 6), 2000, np.uint16)), "6 x 5"),
        (lambda f: data.write_depth(f / "depth" / "0.png", np.zeros((data.HEIGHT, data.WIDTH), np.uint16)), "empty"),
    ],
    ids=["8-bit", "other size", "empty"],
)
def test_frames_that_are_all_unsuitable_are_an_error(spoil, message, tmp_path):
    folder = data.redwood(tmp_path / "set")
    for k in (1, 2):
        for name in ("depth", "color"):
            (folder / name / f"{k}.png").unlink()
    spoil(folder)
    with pytest.raises(FileError, match=message):
        imported(folder, tmp_path)


def test_a_pose_that_is_not_rigid_is_taken_as_lost(tmp_path):
    folder = data.redwood(tmp_path / "set")
    log = (folder / "trajectory.log").read_text().splitlines()
    log[6] = "2 0 0 0"
    (folder / "trajectory.log").write_text("\n".join(log))
    done, capture = imported(folder, tmp_path)
    assert done.posed == 2
    assert capture.pose(1) is None
    assert "not rigid" in done.notes[0]


def test_other_mistakes_are_explained(tmp_path):
    with pytest.raises(FileError, match="not a folder"):
        imported(tmp_path / "nowhere", tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileError, match="fits no known format"):
        imported(tmp_path / "empty", tmp_path)
    folder = data.redwood(tmp_path / "set")
    with pytest.raises(OptionError, match="neither a file nor FX,FY,CX,CY"):
        imported(folder, tmp_path, intrinsics="nothing")
    (folder / "trajectory.log").write_text("0 0 1\n1 0 0\n")
    with pytest.raises(FileError, match=r"trajectory\.log', line 1"):
        imported(folder, tmp_path)
    with pytest.raises(FileError, match="folder"):
        import_capture(folder, tmp_path / "no" / "capture.usda")


@pytest.mark.parametrize("up", [u for u in UPS if u != "auto"])
def test_the_named_axis_becomes_up(up):
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up.startswith("-") else 1)
    matrix = up_matrix(up)[:3, :3]
    np.testing.assert_array_equal(matrix @ axis, [0, 1, 0])
    assert np.linalg.det(matrix) == pytest.approx(1.0)


@needs_shared
def test_redwood_sample(tmp_path):
    done, capture = imported(SHARED / "redwood", tmp_path)
    assert (done.format, done.frames, done.posed, done.up) == ("redwood", 5, 5, "y")
    assert 1.0 < done.median_depth < 3.0
    # Consecutive frames see the same room: points of one, moved to the next, have the depth that is measured there.
    a, b = capture.depth(0), capture.depth(1)
    lens = capture.rig.depth
    points = (lens.rays() * a[..., None])[a > 0]
    relative = np.linalg.inv(capture.pose(1)) @ capture.pose(0)
    points = points @ relative[:3, :3].T + relative[:3, 3]
    uv = np.rint(lens.project(points)).astype(int)
    inside = (uv >= 0).all(-1) & (uv < lens.size).all(-1)
    measured = b[uv[inside, 1], uv[inside, 0]]
    error = np.abs(measured - points[inside, 2])[measured > 0]
    assert np.median(error) < 0.01


@needs_shared
def test_tum_sample(tmp_path):
    done, capture = imported(SHARED / "tum_pair", tmp_path)
    assert (done.format, done.frames, done.colored) == ("pair", 1, 1)
    assert 1.0 < done.median_depth < 4.0
    assert capture.color(0).shape == (480, 640, 3)


@pytest.mark.parametrize(("depth", "color"), [("1", None), (None, "1"), ("0", "1")])
def test_poses_stay_with_their_frames_where_images_are_missing(tmp_path, depth, color):
    folder = data.redwood(tmp_path / "scan")
    for kind, name in (("depth", depth), ("color", color)):
        if name is not None:
            (folder / kind / f"{name}.png").unlink()
    done, capture = imported(folder, tmp_path)
    left = [k for k in range(data.COUNT) if str(k) not in (depth, color)]
    assert done.frames == len(left)
    assert sum(f"{name}.png" in note for note in done.notes for name in (depth, color) if name) >= 1
    for number, k in enumerate(left):
        np.testing.assert_allclose(capture.pose(number)[:3, 3], data.pose(k)[:3, 3], atol=1e-5)
        assert capture.depth_file(number).endswith(f"{k}.png")


def test_another_number_of_poses_than_of_frames(tmp_path):
    folder = data.redwood(tmp_path / "scan")
    for kind in ("depth", "color"):
        (folder / kind / "0.png").unlink()
    _, capture = imported(folder, tmp_path)
    np.testing.assert_allclose(capture.pose(0)[:3, 3], data.pose(1)[:3, 3], atol=1e-5)
    for kind in ("depth", "color"):
        (folder / kind / "1.png").rename(folder / kind / "77.png")
    with pytest.raises(FileError, match="has 3 poses for 2 frames"):
        imported(folder, tmp_path)

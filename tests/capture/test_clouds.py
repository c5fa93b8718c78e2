"""Organised UsdGeom.Points go back to depth images, with the camera that they were taken by."""

from __future__ import annotations

import depth_scene as ds
import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from warp_dvct.capture.importers import ImportOptions, import_capture
from warp_dvct.capture.intrinsics import FLIP
from warp_dvct.capture.stage import open_capture
from warp_dvct.errors import OptionError, StageError

LENS = ds.LENS


def written(path, launcher, *, usd_axes=True, frames=2):
    """The corner of the room as clouds in the camera's space, millimetres; with holes, colours and poses."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.001)
    UsdGeom.SetStageUpAxis(stage, "Y")
    prim = UsdGeom.Points.Define(stage, "/Cloud")
    place = prim.AddTransformOp()
    color = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray)
    color.SetInterpolation("vertex")
    poses, depths = ds.poses(frames), []
    for k, pose in enumerate(poses):
        depth, _ = ds.seen(launcher, ds.corner(), LENS, pose)
        depth[10:14, 20:30] = np.nan if k == 0 else 0.0
        depths.append(np.nan_to_num(depth))
        points = LENS.rays() * depth[..., None] * 1000.0
        local = pose.copy()
        if usd_axes:
            points, local = points * [1, -1, -1], pose @ FLIP
        local[:3, 3] *= 1000.0
        prim.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points.reshape(-1, 3).astype(np.float32)), float(k))
        place.Set(Gf.Matrix4d(local.T.tolist()), float(k))
        color.Set(Vt.Vec3fArray.FromNumpy(np.full((LENS.width * LENS.height, 3), 0.25, np.float32)), float(k))
    stage.GetRootLayer().Save()
    return poses, depths


@pytest.mark.parametrize("usd_axes", [True, False], ids=["usd axes", "opencv axes"])
def test_a_cloud_per_frame_becomes_a_capture(tmp_path, launcher, usd_axes):
    poses, depths = written(tmp_path / "cloud.usda", launcher, usd_axes=usd_axes)
    done = import_capture(tmp_path / "cloud.usda", tmp_path / "c.usda", ImportOptions(size=LENS.size))
    assert (done.format, done.frames, done.posed, done.colored) == ("points", 2, 2, 2)
    capture = open_capture(tmp_path / "c.usda")
    np.testing.assert_allclose(capture.rig.depth.K, LENS.K, rtol=1e-4)
    for k in capture:
        np.testing.assert_allclose(capture.depth(k), depths[k], rtol=1e-5)
        np.testing.assert_allclose(capture.pose(k), poses[k], atol=1e-6)
        assert (capture.color(k) == 137).all()  # sRGB of 0.25


def test_what_is_not_organised_is_said(tmp_path, launcher):
    written(tmp_path / "cloud.usda", launcher, frames=1)
    with pytest.raises(OptionError, match="give --size"):
        import_capture(tmp_path / "cloud.usda", tmp_path / "c.usda")
    with pytest.raises(StageError, match=r"19200 points are no 100 x 100; give --size"):
        import_capture(tmp_path / "cloud.usda", tmp_path / "c.usda", ImportOptions(size=(100, 100)))
    with pytest.raises(StageError, match="not those of a pinhole's pixels"):
        import_capture(tmp_path / "cloud.usda", tmp_path / "c.usda", ImportOptions(size=(120, 160)))
    (tmp_path / "none.usda").write_text("#usda 1.0\n")
    with pytest.raises(StageError, match=r"must have one Points prim.*none"):
        import_capture(tmp_path / "none.usda", tmp_path / "c.usda", ImportOptions(size=(2, 2)))
    assert not (tmp_path / "c.usda").exists()

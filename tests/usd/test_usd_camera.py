"""Cameras against Gf.Camera and Gf.Frustum, and how one is chosen."""

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdRender

from warp_dvct.errors import FileError, StageError


def assert_sees_like_gf(camera, usd_camera, metres=1.0):
    """Corners of the picture on the plane at distance 1 agree with those of Gf.Frustum."""
    frustum = usd_camera.GetCamera(Usd.TimeCode.Default()).frustum
    window = frustum.GetWindow()
    low, high = window.GetMin(), window.GetMax()
    assert (camera.tan_left, camera.tan_bottom) == pytest.approx(tuple(low), rel=1e-6)
    assert (camera.tan_right, camera.tan_top) == pytest.approx(tuple(high), rel=1e-6)
    near = frustum.nearFar.min
    eye = np.array(frustum.position)
    corners = np.array(frustum.ComputeCorners())[[0, 1, 2, 3]]  # left-bottom, right-bottom, left-top, right-top
    expected = (corners - eye) / near * metres + eye * metres
    u = [camera.tan_left, camera.tan_right, camera.tan_left, camera.tan_right]
    v = [camera.tan_bottom, camera.tan_bottom, camera.tan_top, camera.tan_top]
    plane = np.stack([u, v, [-1] * 4, [1] * 4], 1) * [metres, metres, metres, 1]
    np.testing.assert_allclose((plane @ camera.to_world.T)[:, :3], expected, atol=1e-5 * metres)


@pytest.mark.parametrize("scale", [(1, 1, 1), (2, 2, 2), (-1, 1, 1), (3, 3, -3)])
def test_frustum_equals_that_of_gf(build, scale):
    camera = UsdGeom.Camera(build.stage.GetPrimAtPath("/World/Camera"))
    camera.CreateFocalLengthAttr(35.0)
    camera.CreateHorizontalApertureAttr(36.0)
    camera.CreateVerticalApertureAttr(20.25)
    camera.CreateHorizontalApertureOffsetAttr(3.0)
    camera.CreateVerticalApertureOffsetAttr(-1.5)
    camera.AddTranslateOp().Set((1, 2, 3))
    camera.AddRotateXYZOp().Set((-20, 35, 10))
    camera.AddScaleOp().Set(scale)
    UsdGeom.Xform(build.stage.GetPrimAtPath("/World")).AddRotateYOp().Set(70)
    read = build.read().camera
    assert_sees_like_gf(read, camera)
    assert np.linalg.det(read.to_world[:3, :3]) == pytest.approx(1.0)
    assert read.aspect == pytest.approx(36.0 / 20.25)


def test_units_and_up_axis_move_the_camera(build):
    UsdGeom.SetStageMetersPerUnit(build.stage, 0.01)
    camera = UsdGeom.Camera(build.stage.GetPrimAtPath("/World/Camera"))
    camera.AddTranslateOp().Set((100, 200, 300))
    assert_sees_like_gf(build.read().camera, camera, metres=0.01)
    UsdGeom.SetStageUpAxis(build.stage, "Z")
    pose = build.read().camera.to_world
    np.testing.assert_allclose(pose[:3, 3], [1, 3, -2])
    np.testing.assert_allclose(pose[:3, 2], [0, 1, 0], atol=1e-12)  # its z axis was up, and still is


def test_only_an_authored_clipping_range_clips(build):
    camera = build.read().camera
    assert (camera.near, camera.far) == (0.0, float("inf"))
    UsdGeom.SetStageMetersPerUnit(build.stage, 0.01)
    usd = UsdGeom.Camera(build.stage.GetPrimAtPath("/World/Camera"))
    usd.CreateClippingRangeAttr(Gf.Vec2f(10, 5000))
    camera = build.read().camera
    assert (camera.near, camera.far) == pytest.approx((0.1, 50.0))


def test_several_cameras_are_listed_and_one_is_chosen_by_path_or_name(build):
    UsdGeom.Camera.Define(build.stage, "/World/Rig/Witness")
    with pytest.raises(StageError, match=r"several cameras; choose one by --camera: /World/Camera, /World/Rig/Witness"):
        build.read()
    assert build.read(camera="Witness").camera.path == "/World/Rig/Witness"
    assert build.read(camera="/World/Camera").camera.path == "/World/Camera"
    with pytest.raises(StageError, match=r"--camera Nobody is not a camera .*: /World/Camera, /World/Rig/Witness"):
        build.read(camera="Nobody")
    UsdGeom.Camera.Define(build.stage, "/World/Other/Witness")
    with pytest.raises(StageError, match=r"--camera Witness is the name of several cameras"):
        build.read(camera="Witness")


def test_a_stage_without_camera_is_refused(build):
    build.stage.RemovePrim("/World/Camera")
    with pytest.raises(StageError, match="has no camera; add a UsdGeomCamera"):
        build.read()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("projection", "orthographic", "an orthographic camera is not supported"),
        ("focalLength", 0.0, "focalLength is 0.0; it must be positive"),
        ("horizontalAperture", -1.0, "horizontalAperture is -1.0; it must be positive"),
        ("clippingRange", Gf.Vec2f(5, 5), r"clippingRange is \(5.0, 5.0\)"),
    ],
)
def test_cameras_that_cannot_be_used_are_named(build, name, value, message):
    build.stage.GetPrimAtPath("/World/Camera").GetAttribute(name).Set(value)
    with pytest.raises(StageError, match=f"/World/Camera: {message}"):
        build.read()


def test_what_a_pinhole_lacks_is_listed(build):
    prim = build.stage.GetPrimAtPath("/World/Camera")
    assert build.read().notices == ()
    camera = UsdGeom.Camera(prim)
    camera.CreateFStopAttr(2.8)
    camera.CreateFocusDistanceAttr(3.0)
    camera.CreateShutterCloseAttr(0.5)
    camera.CreateExposureAttr(1.0)
    prim.CreateAttribute("omni:lensdistortion:ftheta:k1", Sdf.ValueTypeNames.Float).Set(0.1)
    text = " ".join(n.message for n in build.read().notices)
    for word in ("depth of field", "motion blur", "exposure", "lens distortion"):
        assert word in text


def test_opencv_distortion_is_read(build):
    prim = build.stage.GetPrimAtPath("/World/Camera")
    for name, value in (("k1", 0.25), ("p2", -0.5)):
        prim.CreateAttribute(f"omni:lensdistortion:opencvPinhole:{name}", Sdf.ValueTypeNames.Float).Set(value)
    scene = build.read()
    assert scene.camera.distortion == (0.25, 0.0, 0.0, -0.5)
    assert scene.notices == ()
    prim.GetAttribute("omni:lensdistortion:opencvPinhole:k1").Set(float("nan"))
    with pytest.raises(StageError, match="must be finite"):
        build.read()


def test_plate_of_the_camera_follows_time_and_is_overridden(build, tmp_path):
    prim = build.stage.GetPrimAtPath("/World/Camera")
    files = [tmp_path / f"plate.{k}.png" for k in (1, 2, 3)]
    for file in files:
        file.write_bytes(b"")
    plate = prim.CreateAttribute("dvct:plate:file", Sdf.ValueTypeNames.Asset)
    plate.Set(Sdf.AssetPath(str(files[0])), 1.0)
    plate.Set(Sdf.AssetPath(str(files[1])), 2.0)
    assert build.read(time=1.0).plate == str(files[0])
    assert build.read(time=1.9).plate == str(files[0])
    assert build.read(time=2.0).plate == str(files[1])
    assert build.read(time=1.0, plate=str(files[2])).plate == str(files[2])
    with pytest.raises(FileError, match=r"plate 'nowhere.png' does not exist"):
        build.read(plate="nowhere.png")
    plate.Set(Sdf.AssetPath("lost.png"), 3.0)
    with pytest.raises(StageError, match=r"/World/Camera.dvct:plate:file: plate 'lost.png' does not exist"):
        build.read(time=3.0)


@pytest.mark.parametrize("name", ["horizontalApertureOffset", "verticalApertureOffset"])
def test_offsets_have_to_be_numbers(build, name):
    build.stage.GetPrimAtPath("/World/Camera").GetAttribute(name).Set(float("nan"))
    with pytest.raises(StageError, match=f"/World/Camera: {name} is nan; give a finite number"):
        build.read()


def settings_for(build, size, policy=None, on_product=True):
    """Render settings with one product of the stage's camera."""
    settings = UsdRender.Settings.Define(build.stage, "/Render/Settings")
    product = UsdRender.Product.Define(build.stage, "/Render/Product")
    build.stage.SetMetadata("renderSettingsPrimPath", "/Render/Settings")
    settings.CreateProductsRel().SetTargets([product.GetPath()])
    product.CreateCameraRel().SetTargets(["/World/Camera"])
    product.CreateResolutionAttr(Gf.Vec2i(*size))
    if policy:
        (product if on_product else settings).CreateAspectRatioConformPolicyAttr(policy)


@pytest.mark.parametrize("on_product", [True, False])
@pytest.mark.parametrize(
    ("size", "policy", "width", "height"),
    [
        ((1200, 800), None, 0.6, 0.4),  # the camera's own shape
        ((800, 800), None, 0.6, 0.6),
        ((1600, 800), "expandAperture", 0.8, 0.4),
        ((800, 800), "cropAperture", 0.4, 0.4),
        ((1600, 800), "cropAperture", 0.6, 0.3),
        ((800, 800), "adjustApertureWidth", 0.4, 0.4),
        ((1600, 800), "adjustApertureHeight", 0.6, 0.3),
    ],
)
def test_the_aperture_conforms_to_the_render_products_shape(build, size, policy, width, height, on_product):
    """About its middle, which offsets move; by default it is expanded, so that nothing is cut off."""
    camera = UsdGeom.Camera.Get(build.stage, "/World/Camera")
    camera.GetFocalLengthAttr().Set(40.0)
    camera.GetHorizontalApertureAttr().Set(24.0)
    camera.GetVerticalApertureAttr().Set(16.0)
    camera.GetHorizontalApertureOffsetAttr().Set(4.0)
    settings_for(build, size, policy, on_product)
    seen = build.read().camera
    assert (seen.tan_left, seen.tan_right) == pytest.approx((0.1 - width / 2, 0.1 + width / 2))
    assert (seen.tan_bottom, seen.tan_top) == pytest.approx((-height / 2, height / 2))
    assert build.read().notices == ()


def test_pixels_that_are_not_square_are_listed(build):
    settings_for(build, (800, 800), "adjustPixelAspectRatio")
    (notice,) = build.read().notices
    assert str(notice).startswith("/Render/Product: adjustPixelAspectRatio is not modelled")

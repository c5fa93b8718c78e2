"""``warp-dvct probe``: irradiance, directions and peaks survive every layout."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from pxr import Usd, UsdLux

from warp_dvct.cli import cli
from warp_dvct.device_scene import DeviceScene
from warp_dvct.errors import DvctError, OptionError
from warp_dvct.image import write_png, write_radiance
from warp_dvct.methods.path_tracing import path_trace
from warp_dvct.probe import (
    Lens,
    directions,
    extract_lights,
    horizontal_irradiance,
    lights_usda,
    to_latlong,
)
from warp_dvct.relighter import Relighter
from warp_dvct.scene import LightKind, Role
from warp_dvct.usd.read import read_stage

SUN = np.array([0.48, 0.6, -0.64])


def sky(d, sun=SUN, size=0.06):
    """Radiance from directions: a smooth sky with a small bright disc."""
    up = np.clip(d[..., 1:2], -1, 1)
    smooth = np.array([0.4, 0.5, 0.8]) + np.array([0.3, 0.2, -0.1]) * up + 0.2 * d[..., 0:1]
    disc = (d @ (sun / np.linalg.norm(sun)) > np.cos(size))[..., None]
    return smooth + disc * np.array([90.0, 80.0, 60.0])


def latlong_sky(height=256):
    y, x = np.mgrid[0:height, 0 : 2 * height]
    return sky(directions(height, 2 * height, y + 0.5, x + 0.5)).astype(np.float32)


def image_of(layout, size=512, lens=None):
    """What a camera records in a layout; nothing outside of its circle."""
    y, x = np.mgrid[0:size, 0:size] + 0.5
    u, v = 2 * x / size - 1, 1 - 2 * y / size
    radius = np.hypot(u, v)
    angle = {
        "mirrorball": 2 * np.arcsin(np.clip(radius, 0, 1)),
        "angular": np.pi * radius,
        "fisheye": 0.5 * (lens.fov if lens else np.pi) * radius,
    }[layout]
    right, top = np.sin(angle) * u / np.maximum(radius, 1e-9), np.sin(angle) * v / np.maximum(radius, 1e-9)
    axis = np.cos(angle)
    if layout != "fisheye":
        d = np.stack([right, top, axis], -1)
    elif lens.look == "up":
        d = np.stack([-right, axis, -top], -1)
    else:
        d = np.stack([right, top, -axis], -1)
    return (sky(d) * (radius <= 1)[..., None]).astype(np.float32)


def close(lights, expected=SUN):
    angle = np.degrees(np.arccos(np.clip(lights.peaks[0].toward @ (expected / np.linalg.norm(expected)), -1, 1)))
    return angle < 0.5


def test_a_peak_is_taken_out_and_the_horizontal_irradiance_kept():
    image = latlong_sky()
    lights = extract_lights(image)
    assert len(lights.peaks) == 1
    assert close(lights)
    assert np.degrees(lights.peaks[0].angle) == pytest.approx(np.degrees(0.12), rel=0.05)
    np.testing.assert_allclose(lights.peaks[0].radiance, [90, 80, 60], rtol=0.05)
    np.testing.assert_allclose(lights.horizontal[1], lights.horizontal[0], rtol=0.01)
    np.testing.assert_allclose(lights.horizontal[0], horizontal_irradiance(image), rtol=1e-6)
    assert lights.dome.max() < 2.0
    away = image.max(-1) < 2.0
    np.testing.assert_array_equal(lights.dome[away], image[away])


def test_horizontal_irradiance_of_known_skies():
    np.testing.assert_allclose(horizontal_irradiance(np.ones((32, 64, 3))), np.pi, rtol=1e-6)
    y, x = np.mgrid[0:128, 0:256]
    cosine = np.clip(directions(128, 256, y + 0.5, x + 0.5)[..., 1:2], 0, None).repeat(3, -1)
    np.testing.assert_allclose(horizontal_irradiance(cosine), 2 * np.pi / 3, rtol=1e-3)


@pytest.mark.parametrize("layout", ["mirrorball", "angular", "fisheye"])
def test_layouts_show_the_same_sky(layout):
    lens = Lens(2 * np.pi, 256.0) if layout == "fisheye" else None
    found = to_latlong(image_of(layout, lens=lens), layout, height=128, lens=lens)
    smooth = np.median(np.abs(found - latlong_sky(128)))
    assert smooth < 0.01
    assert close(extract_lights(found))
    np.testing.assert_allclose(horizontal_irradiance(found), horizontal_irradiance(latlong_sky(512)), rtol=0.02)


def test_a_fish_eye_shows_its_field_and_nothing_else():
    lens = Lens(np.radians(180), 256.0, look="forward")
    found = to_latlong(image_of("fisheye", lens=lens), "fisheye", height=64, lens=lens)
    y, x = np.mgrid[0:64, 0:128]
    behind = directions(64, 128, y + 0.5, x + 0.5)[..., 2] > 0.05
    assert (found[behind] == 0).all()
    front = directions(64, 128, y + 0.5, x + 0.5)[..., 2] < -0.05
    assert np.median(np.abs(found - latlong_sky(64))[front]) < 0.01


def test_a_large_window_and_an_even_sky_stay_in_the_dome():
    image = np.full((64, 128, 3), 0.5, np.float32)
    assert extract_lights(image).peaks == ()
    image[15:45, 30:80] = 9.0
    assert extract_lights(image).peaks == ()
    assert extract_lights(np.zeros((8, 16, 3), np.float32)).peaks == ()


def test_a_window_across_the_seam_is_one_peak():
    image = np.full((64, 128, 3), 0.2, np.float32)
    image[20:26, :4] = image[20:26, -4:] = 60.0
    lights = extract_lights(image)
    assert len(lights.peaks) == 1
    assert abs(lights.peaks[0].toward[0]) < 1e-6
    assert lights.peaks[0].toward[2] < 0
    np.testing.assert_allclose(lights.horizontal[1], lights.horizontal[0], rtol=0.01)


def run(*arguments):
    return CliRunner().invoke(cli, [str(a) for a in arguments], catch_exceptions=True)


@pytest.fixture
def probe_stage(tmp_path):
    """A stage whose light is what the command makes of the sky: a real floor and a synthetic box on it."""
    write_radiance(tmp_path / "sky.exr", latlong_sky(128))
    result = run("probe", tmp_path / "sky.exr", "-o", tmp_path / "lights.usda")
    assert result.exit_code == 0, result.output
    (tmp_path / "stage.usda").write_text("""#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "World"
{
    def "Lights" ( prepend references = @./lights.usda@ ) {}
    def Camera "Camera"
    {
        float2 clippingRange = (0.01, 100)
        float focalLength = 30
        float horizontalAperture = 20
        float verticalAperture = 20
        double3 xformOp:translate = (0, 4, 0)
        float xformOp:rotateX = -90
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
    }
    def Mesh "Floor"
    {
        token primvars:dvct:reality = "real"
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points = [(-3, 0, 3), (3, 0, 3), (3, 0, -3), (-3, 0, -3)]
        color3f[] primvars:displayColor = [(0.5, 0.5, 0.5)]
        uniform token subdivisionScheme = "none"
    }
    def Cube "Box"
    {
        token primvars:dvct:reality = "synthetic"
        double size = 0.3
        double3 xformOp:translate = (0, 0.15, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
""")
    return tmp_path / "stage.usda"


def test_every_method_lights_a_floor_as_the_image_says(launcher, probe_stage):
    scene = read_stage(probe_stage)
    kinds = {light.kind for light in scene.lights}
    assert kinds == {LightKind.DOME, LightKind.DISTANT}
    floor = [m for m in scene.meshes if m.role == Role.REAL]
    bare = replace(scene, meshes=tuple(floor))
    low, high = bare.bounds()
    uploaded = DeviceScene.upload(launcher, bare, (low + high) / 2, 1 / float((high - low).max()))
    truth = path_trace(launcher, uploaded, bare, 8, 8, samples=256, bounces=0).before.numpy().mean(0)
    expected = horizontal_irradiance(latlong_sky(128))
    ratio = truth / truth[0] / (expected / expected[0])
    np.testing.assert_allclose(ratio, 1.0, rtol=0.02)
    for method in ("instant-radiosity", "delta-cones"):
        layers = Relighter(bare, method=method, width=8, height=8, settings={"vpls.sky": 1024}).render()
        np.testing.assert_allclose(layers.plate.mean((0, 1)), truth, rtol=0.03)
    layers = Relighter(scene, method="instant-radiosity", width=32, height=32, settings={"bounces": 1}).render()
    assert layers.delta.min() < -0.05  # the sun casts the box's shadow


def test_the_probe_lights_as_bright_as_the_image_itself(launcher, probe_stage):
    """The path tracer under the image as a plain dome, and under what the command made of it: the same level."""
    scene = read_stage(probe_stage)
    dome = next(light for light in scene.lights if light.kind == LightKind.DOME)
    whole = replace(dome, texture=latlong_sky(128), radiance=(1.0, 1.0, 1.0))
    floor = tuple(m for m in scene.meshes if m.role == Role.REAL)
    levels = []
    for lights in ((whole,), scene.lights):
        bare = replace(scene, meshes=floor, lights=lights)
        low, high = bare.bounds()
        uploaded = DeviceScene.upload(launcher, bare, (low + high) / 2, 1 / float((high - low).max()))
        levels.append(path_trace(launcher, uploaded, bare, 16, 16, samples=256, bounces=0).before.numpy().mean(0))
    np.testing.assert_allclose(levels[1], levels[0], rtol=0.01)
    # A Lambert floor under irradiance E sends back albedo E / pi.
    np.testing.assert_allclose(levels[0], 0.5 * horizontal_irradiance(latlong_sky(128)) / np.pi, rtol=0.01)


def test_the_layer_is_valid_and_says_what_was_found(tmp_path):
    text = lights_usda(extract_lights(latlong_sky(64)), "a.exr", 'my "sky".exr')
    (tmp_path / "a.usda").write_text(text)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert UsdLux.DomeLight.Get(stage, "/Lights/Dome").GetTextureFormatAttr().Get() == "latlong"
    matrix = UsdLux.DistantLight.Get(stage, "/Lights/Peak1").ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    emitted = np.array(matrix.TransformDir((0, 0, -1)))
    np.testing.assert_allclose(-emitted, SUN / np.linalg.norm(SUN), atol=0.02)


def test_exposure_scales_and_ldr_is_linearised(tmp_path):
    write_png(tmp_path / "grey.png", np.full((32, 64, 3), 188, np.uint8))
    for stops, level in ((0, 0.503), (2, 2.01)):
        result = run("probe", tmp_path / "grey.png", "-o", tmp_path / "l.usda", "--exposure", stops)
        assert result.exit_code == 0, result.output
        kept = float(result.output.split("kept ")[1].split()[0])
        assert kept == pytest.approx(np.pi * level, rel=0.01)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "128 x 128. Crop or pad it"),
        (["--layout", "fisheye"], "--fov DEGREES and --radius PIXELS"),
        (["--layout", "fisheye", "--fov", "180"], "--fov DEGREES and --radius PIXELS"),
        (["--layout", "fisheye", "--fov", "400", "--radius", "60"], "--fov is 400"),
        (["--layout", "fisheye", "--fov", "180", "--radius", "-1"], "--radius is -1"),
    ],
)
def test_bad_images_are_refused(tmp_path, arguments, message):
    write_radiance(tmp_path / "square.exr", np.ones((128, 128, 3)))
    result = run("probe", tmp_path / "square.exr", "-o", tmp_path / "l.usda", *arguments)
    assert isinstance(result.exception, DvctError)
    assert message in str(result.exception)
    assert not (tmp_path / "l.usda").exists()
    assert not (tmp_path / "l.exr").exists()


def test_unreadable_and_unusable_images(tmp_path):
    result = run("probe", tmp_path / "none.exr", "-o", tmp_path / "l.usda")
    assert "image '" in str(result.exception)
    (tmp_path / "text.png").write_text("no image")
    result = run("probe", tmp_path / "text.png", "-o", tmp_path / "l.usda")
    assert "cannot be read" in str(result.exception)
    with pytest.raises(OptionError, match="NaN"):
        to_latlong(np.full((4, 8, 3), np.nan), "latlong")

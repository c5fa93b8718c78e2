"""Radiance, size and direction of UsdLux lights in the units that UsdLux gives them."""

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux

from warp_dvct.errors import StageError
from warp_dvct.scene import LightKind, LightRole
from warp_dvct.usd.domes import latlong_directions

PATH = "/World/Lamp"


def lamp(build, kind, api=None, **inputs):
    prim = build.stage.DefinePrim(PATH, kind)
    if api:
        prim.ApplyAPI(api)
    for name, value in inputs.items():
        attribute = prim.GetAttribute("inputs:" + name.replace("__", ":")) or prim.GetAttribute(name)
        assert attribute.Set(value), name
    return prim


def read(build):
    (light,) = [light for light in build.read().lights if light.path == PATH]
    return light


def test_radiance_is_intensity_exposure_and_color(build):
    lamp(build, "RectLight", intensity=3.0, exposure=2.0, color=(1.0, 0.5, 0.25))
    assert read(build).radiance == pytest.approx((12.0, 6.0, 3.0))


@pytest.mark.parametrize("kelvin", [1500.0, 3000.0, 6500.0, 9000.0])
def test_temperature_multiplies_by_the_blackbody_where_enabled(build, kelvin):
    prim = lamp(build, "SphereLight", intensity=2.0, colorTemperature=kelvin)
    assert read(build).radiance == pytest.approx((2.0, 2.0, 2.0))
    prim.GetAttribute("inputs:enableColorTemperature").Set(True)
    expected = 2.0 * np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin))
    assert read(build).radiance == pytest.approx(tuple(expected))
    # Unit luminance: a temperature changes the hue, not the brightness.
    assert np.dot(expected, [0.2126, 0.7152, 0.0722]) == pytest.approx(2.0, rel=1e-3)


@pytest.mark.parametrize(
    ("kind", "inputs", "area"),
    [
        ("RectLight", {"width": 2.0, "height": 3.0}, 6.0 * 2 * 3),
        ("DiskLight", {"radius": 1.5}, np.pi * 2.25 * 2 * 3),
        ("SphereLight", {"radius": 0.25}, None),
    ],
)
@pytest.mark.parametrize("metres", [1.0, 0.01])
def test_normalize_divides_by_the_scaled_area_in_scene_units(build, kind, inputs, area, metres):
    UsdGeom.SetStageMetersPerUnit(build.stage, metres)
    prim = lamp(build, kind, intensity=10.0, normalize=True, **inputs)
    scale = (2, 3, 1) if area else (2, 2, 2)
    area = area or 4 * np.pi * 0.5**2
    UsdGeom.Xformable(prim).AddScaleOp().Set(Gf.Vec3f(*scale))
    assert read(build).radiance[0] == pytest.approx(10.0 / area)


def test_rect_frame_under_a_transform(build):
    UsdGeom.SetStageMetersPerUnit(build.stage, 0.01)
    prim = lamp(build, "RectLight", width=200.0, height=50.0)
    UsdGeom.Xformable(prim).AddTranslateOp().Set((100, 200, 300))
    UsdGeom.Xformable(prim).AddRotateXOp().Set(-90.0)  # -z turns to -y
    light = read(build)
    assert light.kind == LightKind.RECT
    assert light.position == pytest.approx((1, 2, 3))
    assert light.axis_x == pytest.approx((1, 0, 0))
    assert light.axis_y == pytest.approx((0, 0, -0.25), abs=1e-12)
    assert light.direction == pytest.approx((0, -1, 0), abs=1e-12)


@pytest.mark.parametrize("scale", [(-1, 1, 1), (1, 1, -1), (2, 1, 1)])
def test_flat_lights_emit_along_minus_z_in_any_mirror(build, scale):
    prim = lamp(build, "DiskLight", radius=1.0)
    UsdGeom.Xformable(prim).AddScaleOp().Set(Gf.Vec3f(*scale))
    assert read(build).direction == pytest.approx((0, 0, -np.sign(scale[2])))


def test_sheared_rect_emits_along_its_normal(build):
    prim = lamp(build, "RectLight")
    shear = Gf.Matrix4d(1, 0, 0, 0, 0, 1, 0, 0, 0.7, 0, 1, 0, 0, 0, 0, 1)
    UsdGeom.Xformable(prim).AddTransformOp().Set(shear)
    assert read(build).direction == pytest.approx((0, 0, -1))


def test_sphere_radius_scales_and_uneven_scale_is_listed(build):
    prim = lamp(build, "SphereLight", radius=0.5)
    op = UsdGeom.Xformable(prim).AddScaleOp()
    op.Set(Gf.Vec3f(3, 3, 3))
    assert read(build).radius == pytest.approx(1.5)
    assert build.read().notices == ()
    op.Set(Gf.Vec3f(1, 8, 1))
    assert read(build).radius == pytest.approx(1.0)  # 0.5 * cube root of 8
    assert any(n.path == PATH and "unevenly scaled" in n.message for n in build.read().notices)


def test_a_point_light_has_the_intensity_of_the_sphere_it_stands_for(build):
    lamp(build, "SphereLight", radius=0.3, intensity=5.0, treatAsPoint=True)
    light = read(build)
    assert light.kind == LightKind.POINT
    assert light.radiance[0] == pytest.approx(5.0 * np.pi * 0.09)
    lamp(build, "SphereLight", radius=0.0, normalize=True)
    # Normalised: L = 5 / (4 pi r^2), I = pi r^2 L = 5 / 4, whatever the radius.
    assert read(build).radiance[0] == pytest.approx(1.25)


def test_normalized_point_and_sphere_agree_in_centimetres(build):
    UsdGeom.SetStageMetersPerUnit(build.stage, 0.01)
    lamp(build, "SphereLight", radius=20.0, intensity=5.0, normalize=True)
    sphere = read(build)
    lamp(build, "SphereLight", treatAsPoint=True)
    assert read(build).radiance[0] == pytest.approx(sphere.radiance[0] * np.pi * sphere.radius**2)


def test_spot_from_shaping(build):
    prim = lamp(build, "SphereLight", "ShapingAPI", **{"shaping__cone__angle": 25.0, "shaping__cone__softness": 0.4})
    UsdGeom.Xformable(prim).AddRotateYOp().Set(90.0)
    light = read(build)
    assert light.cone_angle == pytest.approx(np.radians(25.0))
    assert light.cone_softness == pytest.approx(0.4)
    assert light.direction == pytest.approx((-1, 0, 0), abs=1e-12)
    prim.GetAttribute("inputs:shaping:focus").Set(2.0)
    prim.GetAttribute("inputs:shaping:ies:file").Set(Sdf.AssetPath("lamp.ies"))
    text = " ".join(n.message for n in build.read().notices)
    assert "shaping:focus" in text
    assert "IES" in text


def test_without_shaping_a_sphere_shines_all_round(build):
    lamp(build, "SphereLight")
    assert read(build).cone_angle == pytest.approx(np.pi)


@pytest.mark.parametrize("degrees", [0.53, 20.0, 180.0])
def test_normalized_sun_gives_its_intensity_as_irradiance(build, degrees):
    lamp(build, "DistantLight", angle=degrees, intensity=7.0, normalize=True)
    light = read(build)
    half = np.linspace(0, np.radians(degrees) / 2, 200001)
    integrand = np.cos(half) * np.sin(half) * 2 * np.pi
    irradiance = light.radiance[0] * ((integrand[1:] + integrand[:-1]) * np.diff(half)).sum() / 2
    assert irradiance == pytest.approx(7.0, rel=1e-5)
    assert light.angle == pytest.approx(np.radians(degrees))


def test_parallel_sun_and_defaults(build):
    lamp(build, "DistantLight", angle=0.0, intensity=3.0)
    light = read(build)
    assert (light.angle, light.radiance[0]) == (0.0, 3.0)
    defaults = next(light for light in build.read().lights if light.path == "/World/Light")
    assert defaults.radiance[0] == 50000.0
    assert defaults.angle == pytest.approx(np.radians(0.53))
    assert defaults.direction == (0, 0, -1)


def write_latlong(path, function, height=32):
    oiio = pytest.importorskip("OpenImageIO")
    pixels = function(latlong_directions(height, 2 * height)).astype(np.float32)
    out = oiio.ImageOutput.create(str(path))
    out.open(str(path), oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "float"))
    out.write_image(pixels)
    out.close()
    return pixels


def test_lat_long_layout_is_that_of_usdlux():
    d = latlong_directions(180, 360)
    np.testing.assert_allclose(d[90, 180], [0, 0, 1], atol=0.02)  # centre
    np.testing.assert_allclose(d[90, 90], [1, 0, 0], atol=0.02)  # a quarter in from the left
    np.testing.assert_allclose(d[0, 10], [0, 1, 0], atol=0.02)  # top


def dome_colour(light, direction):
    """The dome's texel in a world direction, looked up the way a renderer does."""
    x, y, z = np.asarray(light.rotation).T @ np.asarray(direction, float)
    h, w = light.texture.shape[:2]
    u = 0.5 - np.arctan2(x, z) / (2 * np.pi)
    v = np.arccos(np.clip(y, -1, 1)) / np.pi
    return light.texture[min(int(v * h), h - 1), int(u * w) % w]


@pytest.mark.parametrize("kind", ["DomeLight", "DomeLight_1"])
def test_dome_texture_turns_with_the_light(build, tmp_path, kind):
    file = tmp_path / "sky.exr"
    write_latlong(file, lambda d: 0.5 + 0.5 * d)
    prim = lamp(build, kind, intensity=2.0, texture__file=Sdf.AssetPath(str(file)))
    np.testing.assert_allclose(dome_colour(read(build), (0.6, 0.64, 0.48)), [0.8, 0.82, 0.74], atol=0.06)
    UsdGeom.Xformable(prim).AddRotateYOp().Set(90.0)  # the light's +z now looks along world +x
    light = read(build)
    assert light.radiance == (2.0, 2.0, 2.0)
    np.testing.assert_allclose(dome_colour(light, (1, 0, 0)), [0.5, 0.5, 1.0], atol=0.06)


def test_domes_of_a_z_up_stage(build, tmp_path):
    file = tmp_path / "sky.exr"
    write_latlong(file, lambda d: 0.5 + 0.5 * d)
    UsdGeom.SetStageUpAxis(build.stage, "Z")
    # The older DomeLight has its pole along the light's +y, whatever the stage says; world y is the stage's z.
    lamp(build, "DomeLight", texture__file=Sdf.AssetPath(str(file)))
    np.testing.assert_allclose(dome_colour(read(build), (0, 0, -1)), [0.5, 1.0, 0.5], atol=0.06)
    build.stage.RemovePrim(PATH)
    lamp(build, "DomeLight_1", texture__file=Sdf.AssetPath(str(file)))
    np.testing.assert_allclose(dome_colour(read(build), (0, 1, 0)), [0.5, 1.0, 0.5], atol=0.06)
    np.testing.assert_allclose(dome_colour(read(build), (1, 0, 0)), [1.0, 0.5, 0.5], atol=0.06)


@pytest.mark.parametrize("layout", ["angular", "mirroredBall"])
def test_ball_maps_are_unrolled(build, tmp_path, layout):
    oiio = pytest.importorskip("OpenImageIO")
    n = 256
    v, u = np.meshgrid((np.arange(n) + 0.5) / n * 2 - 1, (np.arange(n) + 0.5) / n * 2 - 1, indexing="ij")
    radius = np.minimum(np.hypot(u, v), 1.0)
    angle = radius * np.pi if layout == "angular" else 2 * np.arcsin(radius)
    flat = np.maximum(np.hypot(u, v), 1e-9)
    image = np.stack([np.sin(angle) * u / flat, -np.sin(angle) * v / flat, np.cos(angle)], -1) * 0.5 + 0.5
    out = oiio.ImageOutput.create(str(tmp_path / "ball.exr"))
    out.open(str(tmp_path / "ball.exr"), oiio.ImageSpec(n, n, 3, "float"))
    out.write_image(image.astype(np.float32))
    out.close()
    lamp(build, "DomeLight", texture__file=Sdf.AssetPath(str(tmp_path / "ball.exr")), texture__format=layout)
    texture = read(build).texture
    directions = latlong_directions(*texture.shape[:2])
    away = directions[..., 2] > -0.95  # what lies exactly behind a ball is a single ring of pixels
    np.testing.assert_allclose(texture[away], (0.5 + 0.5 * directions)[away], atol=0.03)


def test_constant_dome_has_no_texture(build):
    lamp(build, "DomeLight", color=(0.1, 0.2, 0.3))
    light = read(build)
    assert light.kind == LightKind.DOME
    assert light.texture is None
    assert light.radiance == pytest.approx((0.1, 0.2, 0.3))
    np.testing.assert_allclose(light.rotation, np.eye(3))


def test_light_roles_are_inherited(build):
    lamp(build, "SphereLight")
    assert read(build).role == LightRole.PLATE
    build.tag(build.stage.GetPrimAtPath("/World"), "added", "dvct:lightRole")
    assert read(build).role == LightRole.ADDED
    build.tag(build.stage.GetPrimAtPath(PATH), "plate", "dvct:lightRole")
    assert read(build).role == LightRole.PLATE
    build.tag(build.stage.GetPrimAtPath(PATH), "both", "dvct:lightRole")
    with pytest.raises(
        StageError, match=r"/World/Lamp: primvars:dvct:lightRole is 'both'; it must be one of plate, added"
    ):
        build.read()


@pytest.mark.parametrize(
    ("kind", "inputs", "message"),
    [
        ("RectLight", {"width": 0.0}, "inputs:width is 0.0; give the light a positive size"),
        ("DiskLight", {"radius": -1.0}, "inputs:radius is -1.0"),
        ("SphereLight", {"radius": 0.0}, "inputs:radius is 0.0"),
        ("SphereLight", {"radius": 0.0, "treatAsPoint": True}, "radius is 0, so it has no power"),
        ("SphereLight", {"intensity": -1.0}, "is negative, not finite or beyond 1e\\+30"),
        ("SphereLight", {"intensity": 1e38, "exposure": 30.0}, "beyond 1e"),
        ("RectLight", {"color": (float("nan"), 1.0, 1.0)}, "is negative, not finite"),
        ("DistantLight", {"angle": -3.0}, "angle is -3.0; give 0 to 360"),
        ("DomeLight", {"texture__file": Sdf.AssetPath("no.exr")}, "texture 'no.exr' does not exist"),
    ],
)
def test_lights_that_cannot_be_used_are_named(build, kind, inputs, message):
    lamp(build, kind, **inputs)
    with pytest.raises(StageError, match=rf"{PATH}.*{message}"):
        build.read()


def test_a_stage_without_light_is_refused_but_a_dark_one_is_not(build):
    UsdGeom.Imageable(build.stage.GetPrimAtPath("/World/Light")).MakeInvisible()
    assert build.read().lights == ()
    build.stage.RemovePrim("/World/Light")
    with pytest.raises(StageError, match="has no light; add a UsdLux light"):
        build.read()
    build.stage.DefinePrim(PATH, "GeometryLight")
    with pytest.raises(StageError, match="no light of a supported type; /World/Lamp: a GeometryLight is not supported"):
        build.read()


def test_what_is_not_modelled_is_listed(build):
    prim = lamp(build, "RectLight", "ShadowAPI", diffuse=0.5)
    prim.GetAttribute("inputs:shadow:enable").Set(False)
    UsdLux.LightAPI(prim).GetLightLinkCollectionAPI().ExcludePath("/World/Room")
    UsdLux.LightAPI(prim).GetShadowLinkCollectionAPI().ExcludePath("/World/Room")
    build.stage.DefinePrim("/World/Tube", "GeometryLight")
    lit = UsdGeom.Cube.Define(build.stage, "/World/Glow")
    lit.GetPrim().ApplyAPI("MeshLightAPI")
    text = [str(n) for n in build.read().notices]
    for expected in (
        "/World/Lamp: light linking is not modelled",
        "/World/Lamp: shadow linking is not modelled",
        "/World/Lamp: inputs:diffuse",
        "/World/Lamp: inputs:shadow:enable",
        "/World/Tube: a GeometryLight is not supported",
        "/World/Glow: a mesh light",
    ):
        assert any(line.startswith(expected) for line in text), expected
    assert "/World/Glow" in [m.path for m in build.read().meshes]


@pytest.mark.parametrize("mirror", [1, -1])
def test_a_tube_is_a_prism_of_its_area_that_faces_outwards(build, mirror):
    """Along local x, round it, without caps: as bright from every side as the tube, to 6 %, and in the mean exactly."""
    prim = lamp(build, "CylinderLight", intensity=3.0, radius=0.2, length=4.0)
    UsdGeom.Xformable(prim).AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    UsdGeom.Xformable(prim).AddScaleOp().Set(Gf.Vec3f(mirror, 1, 1))
    tube = [x for x in build.read().lights if x.path.startswith(PATH)]
    assert {x.kind for x in tube} == {LightKind.RECT}
    assert {x.radiance for x in tube} == {(3.0, 3.0, 3.0)}
    areas = np.array([4 * np.linalg.norm(np.cross(x.axis_x, x.axis_y)) for x in tube])
    assert areas.sum() == pytest.approx(2 * np.pi * 0.2 * 4.0)
    normals, places = (np.array([getattr(x, name) for x in tube]) for name in ("direction", "position"))
    assert places.mean(0) == pytest.approx([1, 2, 3])
    assert np.einsum("fk,fk->f", normals, places - [1, 2, 3]) == pytest.approx(np.full(len(tube), 0.2), rel=0.06)
    angles = np.linspace(0, 2 * np.pi, 721)
    towards = np.stack([0 * angles, np.cos(angles), np.sin(angles)], -1)
    seen = (np.maximum(normals @ towards.T, 0) * areas[:, None]).sum(0)
    assert seen == pytest.approx(np.full(len(angles), 2 * 0.2 * 4.0), rel=0.06)
    assert seen[:-1].mean() == pytest.approx(2 * 0.2 * 4.0, rel=1e-4)


def test_what_a_tube_cannot_do_is_listed(build):
    prim = lamp(build, "CylinderLight", "ShapingAPI", treatAsLine=True, normalize=True, intensity=10.0, radius=0.5)
    assert build.read().lights[-1].radiance[0] == pytest.approx(10.0 / np.pi)
    text = " ".join(str(n) for n in build.read().notices)
    for expected in ("prism of 8 RectLights", "treatAsLine", "shaping of a CylinderLight"):
        assert expected in text
    prim.GetAttribute("inputs:radius").Set(0.0)
    with pytest.raises(StageError, match="/World/Lamp: inputs:radius is 0"):
        build.read()


def test_time_samples(build):
    prim = lamp(build, "SphereLight")
    intensity = prim.GetAttribute("inputs:intensity")
    intensity.Set(1.0, Usd.TimeCode(1))
    intensity.Set(3.0, Usd.TimeCode(3))

    def at(time):
        return next(light for light in build.read(time=time).lights if light.path == PATH).radiance[0]

    assert [at(1), at(2), at(3)] == [1.0, 2.0, 3.0]

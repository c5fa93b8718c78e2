"""UsdPreviewSurface, its textures and coordinates, subsets and display colours."""

import zipfile

import numpy as np
import OpenImageIO as oiio
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils

from warp_dvct.errors import StageError
from warp_dvct.scene import Wrap
from warp_dvct.usd.read import read_stage
from warp_dvct.usd.textures import srgb_to_linear


def write_image(path, pixels, kind="uint8"):
    pixels = np.asarray(pixels, kind if kind != "float" else np.float32)
    out = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    spec.attribute("oiio:UnassociatedAlpha", 1)  # store the channels as they are
    out.open(str(path), spec)
    out.write_image(pixels)
    out.close()
    return path


def textured(build, file, target="diffuseColor", output="rgb", varname="st", **inputs):
    """Bind a material whose ``target`` reads ``file`` to a quad with coordinates; returns (texture, reader) nodes."""
    mesh = UsdGeom.Mesh.Get(build.stage, "/World/Mesh") or build.quad()
    shader = build.material(bind=mesh) if not build.stage.GetPrimAtPath("/World/Looks/Mat") else None
    shader = shader or UsdShade.Shader.Get(build.stage, "/World/Looks/Mat/Surface")
    node = UsdShade.Shader.Define(build.stage, f"/World/Looks/Mat/{target}")
    node.CreateIdAttr("UsdUVTexture")
    if file is not None:
        node.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(str(file)))
    kinds = {"scale": "Float4", "bias": "Float4", "fallback": "Float4"}
    for name, value in inputs.items():
        node.CreateInput(name, getattr(Sdf.ValueTypeNames, kinds.get(name, "Token"))).Set(value)
    reader = UsdShade.Shader.Define(build.stage, f"/World/Looks/Mat/{target}Reader")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(varname)
    node.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    kind = Sdf.ValueTypeNames.Color3f if target.endswith("Color") else Sdf.ValueTypeNames.Float
    shader.CreateInput(target, kind).ConnectToSource(node.ConnectableAPI(), output)
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(varname, Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
    st.Set([(0, 0), (1, 0), (1, 1), (0, 1)])
    return node, reader


def material_of(scene, path="/World/Mesh"):
    (mesh,) = [m for m in scene.meshes if m.path == path]
    return mesh, scene.materials[mesh.materials[0]]


def pixels_of(build, which="base_color_texture"):
    scene = build.read()
    return scene.textures[getattr(material_of(scene)[1], which)].pixels


RAMP = np.array([[[0, 64, 128], [255, 32, 16]], [[10, 20, 30], [40, 50, 60]]], np.uint8)


def test_metallic_workflow(build):
    build.material(bind=build.quad(), diffuseColor=(0.1, 0.2, 0.3), metallic=0.25, roughness=0.75, ior=1.33)
    _, material = material_of(build.read())
    assert material.base_color == pytest.approx((0.1, 0.2, 0.3))
    assert (material.metallic, material.roughness, material.ior) == pytest.approx((0.25, 0.75, 1.33))
    assert material.specular_color is None
    assert material.name == "/World/Looks/Mat"


def test_specular_workflow_ignores_metallic(build):
    build.material(bind=build.quad(), useSpecularWorkflow=1, specularColor=(0.3, 0.2, 0.1), metallic=1.0)
    _, material = material_of(build.read())
    assert material.specular_color == pytest.approx((0.3, 0.2, 0.1))
    assert material.metallic == 0.0


def test_defaults_are_those_of_the_specification(build):
    build.material(bind=build.quad())
    _, material = material_of(build.read())
    assert material.base_color == (0.18, 0.18, 0.18)
    assert (material.metallic, material.roughness, material.ior) == (0.0, 0.5, 1.5)


def test_inputs_come_through_the_interface_of_the_material(build):
    shader = build.material(bind=build.quad())
    material = UsdShade.Material.Get(build.stage, "/World/Looks/Mat")
    public = material.CreateInput("tint", Sdf.ValueTypeNames.Color3f)
    public.Set((0.5, 0.25, 0.125))
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(public)
    assert material_of(build.read())[1].base_color == (0.5, 0.25, 0.125)


def test_eight_bit_colour_is_srgb_and_row_0_is_the_top(build, tmp_path):
    textured(build, write_image(tmp_path / "c.png", RAMP))
    np.testing.assert_allclose(pixels_of(build), srgb_to_linear(RAMP / 255.0), atol=1e-6)
    # IEC 61966-2-1: code value 64 is 0.0512695.
    assert pixels_of(build)[0, 0, 1] == pytest.approx(0.0512695, abs=1e-6)


@pytest.mark.parametrize(
    ("pixels", "kind", "space", "encoded"),
    [
        (RAMP, "uint8", "raw", False),
        (RAMP, "uint8", "sRGB", True),
        (RAMP[..., :1], "uint8", "auto", False),  # one channel holds data, not colour
        (RAMP[..., :1], "uint8", "sRGB", True),
        (RAMP / 255.0, "float", "auto", False),
        (RAMP / 255.0, "float", "sRGB", True),
    ],
)
def test_source_color_space(build, tmp_path, pixels, kind, space, encoded):
    file = tmp_path / ("c.png" if kind == "uint8" else "c.exr")
    textured(build, write_image(file, pixels, kind), sourceColorSpace=space)
    values = np.asarray(pixels, float) / (255.0 if kind == "uint8" else 1.0)
    expected = np.broadcast_to(srgb_to_linear(values) if encoded else values, (2, 2, 3))
    np.testing.assert_allclose(pixels_of(build), expected, atol=1e-6)


def test_sixteen_bit_images_are_linear(build, tmp_path):
    textured(build, write_image(tmp_path / "c.png", RAMP.astype(np.uint16) * 257, "uint16"))
    np.testing.assert_allclose(pixels_of(build), RAMP / 255.0, atol=1e-5)


def test_scale_and_bias_follow_the_transfer_function_and_results_are_clamped(build, tmp_path):
    file = write_image(tmp_path / "c.png", RAMP)
    textured(build, file, scale=Gf.Vec4f(0.5, 0.25, 2, 1), bias=Gf.Vec4f(0.1, 0, 0, 0))
    scene = build.read()
    expected = np.clip(srgb_to_linear(RAMP / 255.0) * [0.5, 0.25, 2] + [0.1, 0, 0], 0, 1)
    np.testing.assert_allclose(scene.textures[0].pixels, expected, atol=1e-6)
    assert scene.notices == ()


@pytest.mark.parametrize(("output", "channel"), [("r", 0), ("g", 1), ("b", 2), ("a", 3)])
def test_roughness_reads_one_channel(build, tmp_path, output, channel):
    rgba = np.concatenate([RAMP, 255 - RAMP[..., :1]], -1)
    textured(build, write_image(tmp_path / "c.png", rgba), "roughness", output, sourceColorSpace="raw")
    pixels = pixels_of(build, "roughness_texture")
    np.testing.assert_allclose(pixels, np.repeat(rgba[..., channel : channel + 1] / 255.0, 3, 2), atol=1e-6)


def test_wrap_modes(build, tmp_path):
    textured(build, write_image(tmp_path / "c.png", RAMP), wrapS="mirror", wrapT="clamp")
    texture = build.read().textures[0]
    assert (texture.wrap_s, texture.wrap_t) == (Wrap.MIRROR, Wrap.CLAMP)
    node = UsdShade.Shader.Get(build.stage, "/World/Looks/Mat/diffuseColor")
    node.GetInput("wrapS").Set("black")
    node.GetInput("wrapT").Set("repeat")
    texture = build.read().textures[0]
    assert (texture.wrap_s, texture.wrap_t) == (Wrap.BLACK, Wrap.REPEAT)


def test_coordinates_come_from_the_named_primvar(build, tmp_path):
    textured(build, write_image(tmp_path / "c.png", RAMP), varname="map1")
    mesh = build.one()
    np.testing.assert_allclose(mesh.corner_uvs, [[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]])


def test_transform2d_scales_then_turns_then_moves(build, tmp_path):
    node, reader = textured(build, write_image(tmp_path / "c.png", RAMP))
    outer, inner = (UsdShade.Shader.Define(build.stage, f"/World/Looks/Mat/T{k}") for k in (1, 2))
    for shader, values in ((outer, ((2, 3), 90.0, (0.5, 0.25))), (inner, ((1, 1), 0.0, (1, 0)))):
        shader.CreateIdAttr("UsdTransform2d")
        shader.CreateInput("scale", Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(*values[0]))
        shader.CreateInput("rotation", Sdf.ValueTypeNames.Float).Set(values[1])
        shader.CreateInput("translation", Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(*values[2]))
    inner.CreateInput("in", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    outer.CreateInput("in", Sdf.ValueTypeNames.Float2).ConnectToSource(inner.ConnectableAPI(), "result")
    node.GetInput("st").ConnectToSource(outer.ConnectableAPI(), "result")
    # (u, v) -> (u + 1, v) -> (2u + 2, 3v) -> (-3v, 2u + 2) -> (0.5 - 3v, 2.25 + 2u)
    expected = [[(0.5, 2.25), (0.5, 4.25), (-2.5, 4.25)], [(0.5, 2.25), (-2.5, 4.25), (-2.5, 2.25)]]
    np.testing.assert_allclose(build.one().corner_uvs, expected, atol=1e-6)


def test_coordinates_that_go_in_a_circle_are_refused(build, tmp_path):
    """Following them would never end."""
    textured(build, write_image(tmp_path / "c.png", np.full((2, 2, 3), 51)), "diffuseColor")
    nodes = [UsdShade.Shader.Define(build.stage, f"/World/Looks/Mat/Turn{k}") for k in range(2)]
    for node, other in (nodes, nodes[::-1]):
        node.CreateIdAttr("UsdTransform2d")
        node.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        node.CreateInput("in", Sdf.ValueTypeNames.Float2).ConnectToSource(other.ConnectableAPI(), "result")
    texture = next(p for p in build.stage.Traverse() if p.GetAttribute("info:id").Get() == "UsdUVTexture")
    UsdShade.Shader(texture).CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
        nodes[0].ConnectableAPI(), "result"
    )
    with pytest.raises(StageError, match="/World/Looks/Mat/Turn0: its input is its own output, through a circle"):
        build.read()


def test_missing_coordinates_use_the_fallback_of_the_reader_and_are_listed(build, tmp_path):
    _, reader = textured(build, write_image(tmp_path / "c.png", RAMP))
    build.stage.GetPrimAtPath("/World/Mesh").RemoveProperty("primvars:st")
    reader.CreateInput("fallback", Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(0.25, 0.75))
    scene = build.read()
    np.testing.assert_allclose(material_of(scene)[0].corner_uvs, np.broadcast_to([0.25, 0.75], (2, 3, 2)))
    assert any("no primvars:st" in n.message and n.path == "/World/Mesh" for n in scene.notices)


def test_gprims_have_coordinates_of_their_own(build, tmp_path):
    textured(build, write_image(tmp_path / "c.png", RAMP))
    ball = UsdGeom.Sphere.Define(build.stage, "/World/Ball")
    UsdShade.MaterialBindingAPI.Apply(ball.GetPrim()).Bind(UsdShade.Material.Get(build.stage, "/World/Looks/Mat"))
    scene = build.read()
    mesh, _ = material_of(scene, "/World/Ball")
    height = mesh.points[mesh.triangles][..., 2]
    np.testing.assert_allclose(mesh.corner_uvs[..., 1], np.arcsin(np.clip(height, -1, 1)) / np.pi + 0.5, atol=1e-3)
    assert scene.notices == ()


def test_one_texture_for_many_meshes_is_read_once(build, tmp_path):
    textured(build, write_image(tmp_path / "c.png", RAMP))
    other = build.quad("/World/Other")
    UsdShade.MaterialBindingAPI.Apply(other.GetPrim()).Bind(UsdShade.Material.Get(build.stage, "/World/Looks/Mat"))
    scene = build.read()
    assert len(scene.textures) == 1
    assert material_of(scene)[1] is material_of(scene, "/World/Other")[1]


def test_missing_and_damaged_files_name_prim_and_file(build, tmp_path):
    node, _ = textured(build, tmp_path / "lost.png")
    with pytest.raises(
        StageError, match=r"/World/Looks/Mat/diffuseColor.inputs:file: texture '.*lost.png' does not exist"
    ):
        build.read()
    (tmp_path / "text.png").write_text("this is no picture")
    node.GetInput("file").Set(Sdf.AssetPath(str(tmp_path / "text.png")))
    with pytest.raises(StageError, match=r"/World/Looks/Mat/diffuseColor: '.*text.png' cannot be read as an image"):
        build.read()
    noise = np.random.default_rng(1).integers(0, 255, (64, 64, 3))
    whole = write_image(tmp_path / "whole.png", noise).read_bytes()
    (tmp_path / "half.png").write_bytes(whole[: len(whole) // 2])
    node.GetInput("file").Set(Sdf.AssetPath(str(tmp_path / "half.png")))
    with pytest.raises(StageError, match=r"/World/Looks/Mat/diffuseColor: '.*half.png' is damaged"):
        build.read()


def test_a_texture_node_without_file_gives_its_fallback(build):
    textured(build, None, fallback=Gf.Vec4f(0.1, 0.2, 0.3, 1))
    scene = build.read()
    assert material_of(scene)[1].base_color == pytest.approx((0.1, 0.2, 0.3))
    assert scene.textures == ()
    assert any("without a file" in n.message for n in scene.notices)


def test_udim_tiles_become_one_image(build, tmp_path):
    for number, value in ((1001, 50), (1002, 100), (1011, 150)):
        write_image(tmp_path / f"skin.{number}.png", np.full((4, 4, 3), value))
    textured(build, tmp_path / "skin.<UDIM>.png", sourceColorSpace="raw")
    build.stage.GetPrimAtPath("/World/Mesh").GetAttribute("primvars:st").Set([(0, 0), (2, 0), (2, 2), (0, 2)])
    scene = build.read()
    mesh, material = material_of(scene)
    image = scene.textures[material.base_color_texture].pixels
    assert image.shape == (8, 8, 3)
    np.testing.assert_allclose(image[[7, 7, 0, 0], [0, 7, 0, 7], 0], np.array([50, 100, 150, 0]) / 255, atol=1e-6)
    np.testing.assert_allclose(mesh.corner_uvs[0], [(0, 0), (1, 0), (1, 1)])
    textured(build, tmp_path / "gone.<UDIM>.png")
    with pytest.raises(StageError, match=r"no tile of the texture '.*gone.<UDIM>.png' exists"):
        build.read()


def test_textures_inside_a_usdz_package(build, tmp_path):
    write_image(tmp_path / "c.png", RAMP)
    textured(build, "./c.png", sourceColorSpace="raw")
    build.stage.Export(str(tmp_path / "shot.usda"))
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "shot.usda"), str(tmp_path / "shot.usdz"))
    assert len(zipfile.ZipFile(tmp_path / "shot.usdz").namelist()) == 2
    scene = read_stage(tmp_path / "shot.usdz", allow_empty_roles=True)
    np.testing.assert_allclose(scene.textures[0].pixels, RAMP / 255.0, atol=1e-6)


def test_what_is_not_modelled_is_listed_once_and_means_stand_in(build, tmp_path):
    file = write_image(tmp_path / "c.png", np.full((2, 2, 3), 51))
    textured(build, file, "metallic", "r", sourceColorSpace="raw")
    shader = UsdShade.Shader.Get(build.stage, "/World/Looks/Mat/Surface")
    shader.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).Set((1, 0, 0))
    shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(0.5)
    shader.CreateInput("clearcoat", Sdf.ValueTypeNames.Float).Set(0.0)
    other = build.quad("/World/Other")
    UsdShade.MaterialBindingAPI.Apply(other.GetPrim()).Bind(UsdShade.Material.Get(build.stage, "/World/Looks/Mat"))
    scene = build.read()
    assert material_of(scene)[1].metallic == pytest.approx(0.2)
    assert sorted(n.message for n in scene.notices) == [
        "a texture on metallic is not supported; its mean is used",
        "emissiveColor is not modelled: it gives no light",
        "opacity is not modelled: drawn opaque",
    ]


def test_roughness_with_other_coordinates_falls_back_to_its_mean(build, tmp_path):
    file = write_image(tmp_path / "c.png", np.full((2, 2, 3), 51))
    textured(build, file, "diffuseColor")
    textured(build, file, "roughness", "g", varname="st2", sourceColorSpace="raw")
    scene = build.read()
    _, material = material_of(scene)
    assert material.roughness_texture is None
    assert material.roughness == pytest.approx(0.2)
    assert any("roughness uses other texture coordinates" in n.message for n in scene.notices)


def test_shaders_of_other_kinds_fall_back_to_the_display_colour(build):
    mesh = build.quad()
    shader = build.material(bind=mesh)
    shader.GetIdAttr().Set("ND_standard_surface_surfaceshader")
    mesh.CreateDisplayColorAttr([(0.2, 0.4, 0.6)])
    scene = build.read()
    assert material_of(scene)[1].base_color == pytest.approx((0.2, 0.4, 0.6))
    assert "'ND_standard_surface_surfaceshader' is not UsdPreviewSurface" in scene.notices[0].message


@pytest.mark.parametrize(
    ("name", "kind", "value", "told"),
    [
        ("diffuseColor", "String", "red", "diffuseColor is 'red', which is no colour; the default is used"),
        ("diffuseColor", "Float", 0.5, "diffuseColor is 0.5, which is no colour"),
        ("diffuseColor", "Color3f", (float("nan"), 0, 0), "which is no colour"),
        ("roughness", "Float", float("nan"), "roughness is nan, which is no finite number"),
        ("metallic", "Float", float("inf"), "metallic is inf, which is no finite number"),
        ("opacity", "Token", "half", "opacity is not modelled"),
    ],
)
def test_inputs_that_are_no_number_take_their_default_and_are_listed(build, name, kind, value, told):
    """A NaN would spread over the picture, a wrong type end in a traceback."""
    shader = build.material(bind=build.quad())
    shader.CreateInput(name, getattr(Sdf.ValueTypeNames, kind)).Set(value)
    scene = build.read()
    (notice,) = scene.notices
    assert told in str(notice)
    made = material_of(scene)[1]
    assert (made.base_color, made.roughness, made.metallic) == ((0.18, 0.18, 0.18), 0.5, 0.0)


def test_textures_and_transforms_with_nan_are_refused(build, tmp_path):
    pixels = np.full((2, 2, 3), np.nan, np.float32)
    texture, _ = textured(build, write_image(tmp_path / "c.exr", pixels, "float"), "diffuseColor")
    with pytest.raises(StageError, match=r"/World/Looks/Mat: the texture of diffuseColor, '.*c.exr', has NaN"):
        build.read()
    texture.GetInput("file").Set(Sdf.AssetPath(str(write_image(tmp_path / "d.png", np.full((2, 2, 3), 51)))))
    turn = UsdShade.Shader.Define(build.stage, "/World/Looks/Mat/Turn")
    turn.CreateIdAttr("UsdTransform2d")
    turn.CreateInput("rotation", Sdf.ValueTypeNames.Float).Set(float("nan"))
    turn.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    texture.GetInput("st").ConnectToSource(turn.ConnectableAPI(), "result")
    reader = UsdShade.Shader.Get(build.stage, "/World/Looks/Mat/diffuseColorReader")
    turn.CreateInput("in", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    with pytest.raises(StageError, match="/World/Looks/Mat/Turn: scale, rotation or translation is NaN"):
        build.read()


def test_an_unknown_wrap_mode_repeats_and_is_listed(build, tmp_path):
    textured(build, write_image(tmp_path / "c.png", np.full((2, 2, 3), 51)), "diffuseColor", wrapS="sideways")
    (notice,) = build.read().notices
    assert "wrapS is 'sideways', which is no wrap mode; repeated" in str(notice)


def test_a_binding_to_nothing_is_listed_where_it_is_authored(build):
    """As after a rename: without a word the object would be grey."""
    build.quad("/World/Group/Mesh").CreateDisplayColorAttr([(0.2, 0.4, 0.6)])
    api = UsdShade.MaterialBindingAPI.Apply(build.stage.GetPrimAtPath("/World/Group"))
    api.GetDirectBindingRel().SetTargets(["/World/Looks/Gone"])
    scene = build.read()
    assert str(scene.notices[0]).startswith("/World/Group: is bound to /World/Looks/Gone, which is no material")
    assert material_of(scene, "/World/Group/Mesh")[1].base_color == pytest.approx((0.2, 0.4, 0.6))


@pytest.mark.parametrize(
    ("values", "listed"), [([0.3], True), ([1.0, 1.0, 0.5, 1.0], True), ([1.0], False), ([], False)]
)
def test_display_opacity_is_listed_where_it_shows(build, values, listed):
    build.quad().CreateDisplayOpacityAttr(values)
    assert [n.message for n in build.read().notices] == ["displayOpacity is not modelled: drawn opaque"] * listed


def test_display_colour_of_unbound_geometry_is_a_matte_surface(build):
    build.quad().CreateDisplayColorAttr([(0.2, 0.4, 0.6)])
    UsdGeom.PrimvarsAPI(build.stage.GetPrimAtPath("/World")).CreatePrimvar(
        "displayColor", Sdf.ValueTypeNames.Color3fArray
    ).Set([(0.9, 0.8, 0.7)])
    build.quad("/World/Heir")
    scene = build.read()
    mesh, material = material_of(scene)
    assert material.base_color == pytest.approx((0.2, 0.4, 0.6))
    assert material.ior == 1.0  # no specular reflection
    assert mesh.corner_colors is None
    assert material_of(scene, "/World/Heir")[1].base_color == pytest.approx((0.9, 0.8, 0.7))


def test_display_colour_read_by_a_material(build):
    mesh = build.quad()
    shader = build.material(bind=mesh, roughness=0.3)
    reader = UsdShade.Shader.Define(build.stage, "/World/Looks/Mat/Reader")
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    reader.CreateInput("fallback", Sdf.ValueTypeNames.Float3).Set((0.5, 0.25, 0))
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(reader.ConnectableAPI(), "result")
    _, material = material_of(build.read())
    assert material.base_color == (0.5, 0.25, 0.0)
    color = mesh.CreateDisplayColorPrimvar("vertex")
    color.Set([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])
    mesh, material = material_of(build.read())
    assert material.base_color == (1.0, 1.0, 1.0)
    assert material.roughness == pytest.approx(0.3)
    np.testing.assert_array_equal(mesh.corner_colors[1], [(0, 0, 0), (0, 1, 0), (0, 0, 1)])


def test_subsets_take_their_materials_and_the_rest_that_of_the_mesh(build):
    mesh = build.mesh([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0)], [[0, 1, 2, 3], [1, 4, 2], [2, 4, 1]])
    build.material("/World/Looks/All", bind=mesh, diffuseColor=(0.1, 0.1, 0.1))
    build.material("/World/Looks/Part", diffuseColor=(0.9, 0.9, 0.9))
    subset = UsdGeom.Subset.CreateGeomSubset(mesh, "part", "face", [1], "materialBind")
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(UsdShade.Material.Get(build.stage, "/World/Looks/Part"))
    other = UsdGeom.Subset.CreateGeomSubset(mesh, "other", "face", [2], "selection")  # another family: no binding
    UsdShade.MaterialBindingAPI.Apply(other.GetPrim()).Bind(UsdShade.Material.Get(build.stage, "/World/Looks/Part"))
    scene = build.read()
    colors = [scene.materials[k].base_color[0] for k in material_of(scene)[0].materials]
    assert colors == pytest.approx([0.1, 0.1, 0.9, 0.1])
    subset.GetIndicesAttr().Set([3])
    with pytest.raises(StageError, match=r"/World/Mesh/part: indices has the face 3, but there are 3 faces"):
        build.read()


def test_only_textured_subsets_get_coordinates(build, tmp_path):
    textured(build, write_image(tmp_path / "c.png", RAMP))
    mesh = UsdGeom.Mesh(build.mesh([(0, 0, 0), (1, 0, 0), (1, 1, 0), (2, 0, 0)], [[0, 1, 2], [1, 3, 2]]))
    UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Set([(0.5, 0.5)] * 6)
    build.material("/World/Looks/Plain", diffuseColor=(0.9, 0.9, 0.9))
    subset = UsdGeom.Subset.CreateGeomSubset(mesh, "part", "face", [1], "materialBind")
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(UsdShade.Material.Get(build.stage, "/World/Looks/Plain"))
    scene = build.read()
    read, _ = material_of(scene)
    np.testing.assert_allclose(read.corner_uvs, [[(0.5, 0.5)] * 3, [(0, 0)] * 3])
    assert scene.materials[read.materials[1]].base_color_texture is None


def test_full_purpose_and_inherited_and_collection_bindings(build):
    mesh = build.quad()
    build.material("/World/Looks/World", diffuseColor=(0.1, 0.1, 0.1))
    build.material("/World/Looks/Full", diffuseColor=(0.2, 0.2, 0.2))
    world = UsdShade.MaterialBindingAPI.Apply(build.stage.GetPrimAtPath("/World"))
    world.Bind(UsdShade.Material.Get(build.stage, "/World/Looks/World"))
    assert material_of(build.read())[1].base_color[0] == pytest.approx(0.1)
    own = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
    own.Bind(UsdShade.Material.Get(build.stage, "/World/Looks/Full"), materialPurpose="full")
    assert material_of(build.read())[1].base_color[0] == pytest.approx(0.2)
    build.material("/World/Looks/Set", diffuseColor=(0.3, 0.3, 0.3))
    collection = Usd.CollectionAPI.Apply(build.stage.GetPrimAtPath("/World"), "chosen")
    collection.IncludePath("/World/Mesh")
    world.Bind(
        collection,
        UsdShade.Material.Get(build.stage, "/World/Looks/Set"),
        bindingStrength=UsdShade.Tokens.strongerThanDescendants,
        materialPurpose="full",
    )
    assert material_of(build.read())[1].base_color[0] == pytest.approx(0.3)

"""Opening stages, units, axes, time, visibility, purposes, notices and frame ranges."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel

from warp_dvct.errors import OptionError, StageError
from warp_dvct.scene import Role
from warp_dvct.usd.read import read_stage
from warp_dvct.usd.stage import frame_range, stage_frames

BUNNY = "warp/examples/assets/bunny.usd"
ASSETS = Path(__file__).parents[3] / "shared" / "data" / "usd"


def test_missing_and_corrupt_stages_name_the_file(tmp_path):
    with pytest.raises(StageError, match=r"stage '.*none.usda' does not exist"):
        read_stage(tmp_path / "none.usda")
    with pytest.raises(StageError, match=r"is a folder; give the .usd"):
        read_stage(tmp_path)
    for name, content in (
        ("bad.usda", b"hello"),
        ("bad.usdc", b"PXR-USDC" + bytes(40)),
        ("bad.png", b"x"),
        ("e.usd", b""),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(StageError, match=rf"stage '.*{name}' cannot be read"):
            read_stage(tmp_path / name)


def test_reading_a_bad_file_prints_nothing_of_its_own(tmp_path):
    (tmp_path / "shot.usda").write_text('#usda 1.0\ndef Xform "A" (references=@./nope.usd@</X>) {}\n')
    code = (
        "import sys; from warp_dvct.usd.read import read_stage; from warp_dvct.errors import StageError\n"
        "try: read_stage(sys.argv[1])\nexcept StageError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "shot.usda")], capture_output=True, text=True)
    assert "has no camera" in done.stdout
    assert done.stderr == ""


def test_importing_the_package_loads_no_usd():
    code = "import sys, warp_dvct, warp_dvct.scene, warp_dvct.usd.read; print('pxr' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"


@pytest.mark.parametrize("metres", [1.0, 0.01, 0.001, 1000.0])
def test_units_become_metres(build, metres):
    UsdGeom.SetStageMetersPerUnit(build.stage, metres)
    build.quad()
    np.testing.assert_allclose(np.ptp(build.one().points, axis=0), [2 * metres, metres, 0])


def test_units_that_are_not_positive_are_refused(build):
    build.stage.SetMetadata("metersPerUnit", 0.0)
    with pytest.raises(StageError, match=r"metersPerUnit is 0.0; it must be positive"):
        build.read()


def test_an_up_axis_that_usd_does_not_know_is_refused(build):
    build.stage.SetMetadata("upAxis", "X")
    with pytest.raises(StageError, match=r"upAxis is X; it must be Y or Z"):
        build.read()


def test_transforms_that_are_ordered_and_not_there_are_listed(build):
    """As after deleting one by hand; USD draws the prim without it and says nothing."""
    quad = UsdGeom.Xformable(build.quad())
    quad.AddTranslateOp().Set((1, 0, 0))
    quad.AddTranslateOp(opSuffix="pivot").Set((0, 1, 0))
    quad.AddTranslateOp(opSuffix="pivot", isInverseOp=True)
    assert build.read().notices == ()
    quad.GetXformOpOrderAttr().Set(["xformOp:translate", "xformOp:rotateY", "!invert!xformOp:scale"])
    told = [str(n) for n in build.read().notices]
    assert told == [
        "/World/Mesh: xformOpOrder names xformOp:rotateY, which is not there; left out",
        "/World/Mesh: xformOpOrder names xformOp:scale, which is not there; left out",
    ]


@pytest.mark.parametrize(("half", "listed"), [(1e6, False), (1e7, True)])
def test_a_ground_too_large_for_rays_is_listed(build, half, listed):
    """Its picture would be noise."""
    build.quad("/World/Ball")
    ground = build.mesh([(-half, 0, half), (half, 0, half), (half, 0, -half), (-half, 0, -half)], [[0, 1, 2, 3]])
    build.tag(ground, "real")
    told = [str(n) for n in build.read().notices]
    assert (
        told
        == ["/World/Mesh: is 1e+07 times as large as all synthetic objects: rays miss parts of it; cut it smaller"][
            : int(listed)
        ]
    )


def test_a_notice_is_one_line(build):
    """Composition errors of USD span several."""
    build.quad().GetPrim().GetReferences().AddInternalReference("/World")
    (told,) = build.read().notices
    assert "Cycle detected" in told.message
    assert "\n" not in str(told)


def test_a_z_up_stage_is_turned_not_mirrored(build, measure):
    UsdGeom.SetStageUpAxis(build.stage, "Z")
    build.mesh([(0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3)], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    mesh = build.one()
    np.testing.assert_allclose(mesh.points, [(0, 0, 0), (1, 0, 0), (0, 0, -2), (0, 3, 0)], atol=1e-12)
    assert measure.volume(mesh) == pytest.approx(1.0)


def test_transforms_multiply_and_a_reset_stack_starts_again(build):
    UsdGeom.Xform(build.stage.GetPrimAtPath("/World")).AddTranslateOp().Set((10, 0, 0))
    build.quad("/World/Group/Quad")
    UsdGeom.Xform.Define(build.stage, "/World/Group").AddRotateZOp().Set(90.0)
    # (2, 1) turned by 90 degrees is (-1, 2), then moved
    np.testing.assert_allclose(build.one("/World/Group/Quad").points[2], [9, 2, 0], atol=1e-6)
    quad = UsdGeom.Xformable(build.stage.GetPrimAtPath("/World/Group/Quad"))
    quad.AddTranslateOp().Set((0, 0, 5))
    quad.SetResetXformStack(True)
    np.testing.assert_allclose(build.one("/World/Group/Quad").points[2], [2, 1, 5], atol=1e-6)


def test_transforms_that_cannot_be_drawn(build):
    op = UsdGeom.Xformable(build.quad()).AddScaleOp()
    op.Set((1, 0, 1))
    scene = build.read()
    assert "/World/Mesh: scaled to zero along an axis; not drawn" in map(str, scene.notices)
    assert [m.path for m in scene.meshes] == ["/World/Room"]
    op.Set((1, float("nan"), 1))
    with pytest.raises(StageError, match=r"/World/Mesh: its transform has NaN or infinite values"):
        build.read()


def test_time_codes(build):
    op = UsdGeom.Xformable(build.quad()).AddTranslateOp()
    op.Set((1, 0, 0), 10.0)
    op.Set((3, 0, 0), 20.0)

    def x(time):
        return build.one(time=time).points[0, 0]

    assert [x(10), x(15), x(20), x(99)] == [1, 2, 3, 3]
    assert x(None) == 1  # the earliest, as usdrecord


def test_visibility_is_inherited_and_purposes_are_chosen(build):
    build.quad("/World/Group/Quad")
    group = UsdGeom.Xform.Define(build.stage, "/World/Group")
    group.CreateVisibilityAttr("invisible")
    UsdGeom.Imageable(build.stage.GetPrimAtPath("/World/Group/Quad")).CreateVisibilityAttr("inherited")
    assert [m.path for m in build.read().meshes] == ["/World/Room"]
    group.GetVisibilityAttr().Set("inherited")
    for purpose in ("default", "render", "proxy", "guide"):
        build.quad(f"/World/{purpose}/Quad")
        UsdGeom.Xform.Define(build.stage, f"/World/{purpose}").CreatePurposeAttr(purpose)
    paths = {m.path for m in build.read().meshes}
    assert {"/World/render/Quad", "/World/default/Quad", "/World/Group/Quad"} <= paths
    assert not {"/World/proxy/Quad", "/World/guide/Quad"} & paths
    paths = {m.path for m in build.read(purposes=("default", "proxy")).meshes}
    assert {"/World/proxy/Quad", "/World/default/Quad"} <= paths
    assert "/World/render/Quad" not in paths


def test_inactive_and_abstract_prims_are_not_drawn(build):
    build.quad("/World/Off").GetPrim().SetActive(False)
    build.stage.CreateClassPrim("/Class")
    build.quad("/Class/Quad")
    build.stage.OverridePrim("/World/Over")
    assert [m.path for m in build.read().meshes] == ["/World/Room"]


def test_variants_payloads_and_sublayers_are_read_as_composed(build, tmp_path):
    build.quad("/World/Thing/Quad")
    build.stage.Export(str(tmp_path / "asset.usda"))
    shot = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    prim = shot.DefinePrim("/Shot")
    prim.GetPayloads().AddPayload("./asset.usda", "/World")
    variants = prim.GetVariantSets().AddVariantSet("size")
    for name, scale in (("small", 1), ("large", 4)):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            UsdGeom.Xformable(shot.OverridePrim("/Shot/Thing/Quad")).AddScaleOp().Set(Gf.Vec3f(scale, 1, 1))
    UsdGeom.SetStageMetersPerUnit(shot, 1.0)
    shot.Save()
    (mesh,) = [m for m in read_stage(tmp_path / "shot.usda", allow_empty_roles=True).meshes if "Quad" in m.path]
    assert np.ptp(mesh.points[:, 0]) == pytest.approx(8.0)


def test_what_could_not_be_composed_is_listed_and_strict_refuses_it(build, tmp_path):
    for name, arc, target in (
        ("Ref", "GetReferences", "a.usd"),
        ("Mtlx", "GetReferences", "b.mtlx"),
        ("Pay", "GetPayloads", "c.usd"),
    ):
        prim = build.stage.DefinePrim(f"/World/{name}")
        arcs = getattr(prim, arc)()
        (arcs.AddReference if arc == "GetReferences" else arcs.AddPayload)(str(tmp_path / target))
    scene = build.read()
    for path, file in (("/World/Ref", "a.usd"), ("/World/Mtlx", "b.mtlx"), ("/World/Pay", "c.usd")):
        assert [n for n in scene.notices if n.path == path and file in n.message and "not composed" in n.message], path
    with pytest.raises(StageError, match=r"--strict, and this is not modelled: .*b.mtlx.*"):
        build.read(strict=True)


def test_an_error_also_names_the_file_that_did_not_load(build):
    build.stage.RemovePrim("/World/Room")
    build.quad()
    build.stage.DefinePrim("/World/Set").GetReferences().AddReference("/nowhere/set.usd")
    with pytest.raises(StageError, match=r"no geometry is real; .*\(/World/Set: not composed: .*set.usd"):
        build.read(allow_empty_roles=False)


def test_strict_accepts_a_stage_without_notices(build):
    build.quad()
    assert build.read(strict=True).notices == ()


def test_a_notice_comes_once_per_prim_however_often_it_is_instanced(build):
    build.mesh([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [[0, 1, 2]], "/Proto/Mesh", "bilinear")
    build.stage.GetPrimAtPath("/Proto").SetSpecifier(Sdf.SpecifierClass)
    for k in range(3):
        prim = build.stage.DefinePrim(f"/World/I{k}")
        prim.GetReferences().AddInternalReference("/Proto")
        prim.SetInstanceable(True)
    scene = build.read()
    assert len(scene.meshes) == 4
    assert [n.path for n in scene.notices] == ["/World/I0/Mesh"]


def test_skinned_meshes_are_drawn_at_rest_and_listed(build):
    UsdSkel.Root.Define(build.stage, "/World/Man")
    UsdSkel.Skeleton.Define(build.stage, "/World/Man/Skel")
    mesh = build.quad("/World/Man/Body")
    UsdSkel.BindingAPI.Apply(mesh.GetPrim()).CreateSkeletonRel().SetTargets(["/World/Man/Skel"])
    scene = build.read()
    assert "/World/Man/Body: UsdSkel deformation is not applied; drawn in its rest pose" in map(str, scene.notices)
    assert "/World/Man/Body" in [m.path for m in scene.meshes]


def test_an_empty_mesh_is_listed(build):
    UsdGeom.Mesh.Define(build.stage, "/World/Empty")
    assert "/World/Empty: has no faces or no points; nothing is drawn" in map(str, build.read().notices)


@pytest.mark.parametrize(
    ("spec", "frames"),
    [
        ("5", [5]),
        ("1:4", [1, 2, 3, 4]),
        ("1:10x2,20", [1, 3, 5, 7, 9, 20]),
        ("3:1", [3, 2, 1]),
        ("1:2x0.5", [1, 1.5, 2]),
        ("1:3, 2:4", [1, 2, 3, 4]),
        ("-2:0", [-2, -1, 0]),
    ],
)
def test_frame_specifications(spec, frames):
    assert stage_frames(spec) == frames


@pytest.mark.parametrize(
    "spec", ["", "a", "1:", "1,,2", "1:10x", "1:5x-1", "1:5x0", "1-5", "1:2:3", "nan", "0:1e9", "0:99999999"]
)
def test_frame_specifications_that_are_not_understood(spec):
    with pytest.raises(OptionError, match=r"--frames "):
        stage_frames(spec)


def test_frame_range_is_that_of_the_root_layer(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    stage.DefinePrim("/A").GetPayloads().AddPayload("./missing.usd")
    stage.Save()
    assert frame_range(tmp_path / "shot.usda") is None
    stage.SetStartTimeCode(101)
    stage.SetEndTimeCode(124)
    stage.SetFramesPerSecond(25)
    stage.Save()
    assert frame_range(tmp_path / "shot.usda") == (101, 124, 25)
    assert frame_range(stage) == (101, 124, 25)
    with pytest.raises(StageError, match="does not exist"):
        frame_range(tmp_path / "none.usda")


def test_the_bunny_of_the_warp_package(build, measure):
    import warp

    prim = build.stage.DefinePrim("/World/Bunny")
    prim.GetReferences().AddReference(str(Path(warp.__file__).parents[1] / BUNNY), "/root")
    scene = build.read(allow_empty_roles=False)
    mesh = next(m for m in scene.meshes if m.path == "/World/Bunny/bunny")
    assert mesh.role == Role.SYNTHETIC
    assert len(mesh.triangles) == 12200
    assert measure.volume(mesh) == pytest.approx(0.8758, rel=1e-3)
    agreement = np.einsum("tck,tk->tc", mesh.corner_normals, measure.face_normals(mesh))
    assert np.mean(agreement > 0.5) > 0.97


@pytest.mark.skipif(not ASSETS.is_dir(), reason="the asset set ../shared/data/usd is not on this machine")
@pytest.mark.parametrize(("variant", "textures"), [("Utah", 0), ("Fancy", 2)])
def test_the_teapot_asset(build, measure, variant, textures):
    prim = build.stage.DefinePrim("/World/Teapot")
    prim.GetReferences().AddReference(str(ASSETS / "Teapot" / "Teapot.usd"))
    prim.GetVariantSets().SetSelection("modelVariant", variant)
    scene = build.read(allow_empty_roles=False)
    (mesh,) = [m for m in scene.meshes if m.path.startswith("/World/Teapot")]
    low, high = mesh.points.min(0), mesh.points.max(0)
    np.testing.assert_allclose(low, prim.GetAttribute("extentsHint").Get()[0], atol=0.06)
    assert (high - low > 0.15).all()
    assert (high - low < 0.6).all()
    assert measure.volume(mesh) > 0
    assert len(scene.textures) == textures
    material = scene.materials[mesh.materials[0]]
    assert material.ior == pytest.approx(1.327)
    assert not any("control mesh" in n.message for n in scene.notices)
    (low,) = [m for m in build.read(complexity="low").meshes if m.path == mesh.path]
    assert len(mesh.triangles) > 15 * len(low.triangles)
    assert measure.volume(mesh) == pytest.approx(measure.volume(low), rel=0.05)
    if variant == "Utah":
        assert material.base_color == pytest.approx((0.325, 0.825, 0.0))
    else:
        assert mesh.corner_uvs is not None
        # The image is sRGB: its mean is darker once linear.
        assert 0.4 < scene.textures[material.base_color_texture].pixels.mean() < 0.65

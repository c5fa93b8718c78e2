"""Who is real: the order in which the sources of a role are asked."""

import pytest
from pxr import Sdf, Usd, UsdGeom, UsdRender

from warp_dvct.errors import StageError
from warp_dvct.scene import Role
from warp_dvct.usd.read import read_stage

PATH = "/World/Set/Thing"


def thing(build):
    return UsdGeom.Cube.Define(build.stage, PATH).GetPrim()


def matte(build, path, name="/Render/Pass"):
    render_pass = UsdRender.Pass.Define(build.stage, name).GetPrim()
    collection = Usd.CollectionAPI.Get(render_pass, "matte")
    collection.IncludePath(path)
    return collection


def real_collection(build, path):
    collection = Usd.CollectionAPI.Apply(build.stage.GetDefaultPrim(), "dvct:real")
    collection.IncludePath(path)
    return collection


def alias(build, name, kind, value, path=PATH):
    prim = build.stage.GetPrimAtPath(path)
    UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, kind).Set(value)


SOURCES = {
    "alias": lambda b: alias(b, "isMatteObject", Sdf.ValueTypeNames.Bool, True),
    "collection": lambda b: real_collection(b, "/World/Set"),
    "matte": lambda b: matte(b, "/World/Set"),
}


def test_nothing_said_is_synthetic(build):
    thing(build)
    assert build.one(PATH).role == Role.SYNTHETIC


@pytest.mark.parametrize("source", SOURCES)
def test_each_source_marks_as_real(build, source):
    thing(build)
    SOURCES[source](build)
    assert build.one(PATH).role == Role.REAL


@pytest.mark.parametrize("source", SOURCES)
def test_the_tag_beats_every_other_source_and_the_command_line_beats_the_tag(build, source):
    prim = thing(build)
    SOURCES[source](build)
    build.tag(prim, "synthetic")
    assert build.one(PATH).role == Role.SYNTHETIC
    assert build.one(PATH, real=[PATH]).role == Role.REAL
    build.tag(prim, "real")
    assert build.one(PATH, synthetic=["/World/Set"]).role == Role.SYNTHETIC


@pytest.mark.parametrize(
    ("name", "kind", "value", "role"),
    [
        ("isMatteObject", "Bool", False, Role.SYNTHETIC),
        ("arnold:matte", "Bool", True, Role.REAL),
        ("karma:object:holdoutmode", "Int", 1, Role.REAL),
        ("karma:object:holdoutmode", "Int", 0, Role.SYNTHETIC),
        ("karma:object:holdoutmode", "String", "matte", Role.REAL),
        ("karma:object:holdoutmode", "String", "none", Role.SYNTHETIC),
    ],
)
def test_switches_of_other_renderers_are_understood_and_inherited(build, name, kind, value, role):
    thing(build)
    alias(build, name, getattr(Sdf.ValueTypeNames, kind), value, "/World/Set")
    assert build.one(PATH).role == role


def test_tags_are_inherited_and_the_nearest_wins(build):
    prim = thing(build)
    build.tag(build.stage.GetPrimAtPath("/World"), "real")
    assert build.one(PATH).role == Role.REAL
    build.tag(build.stage.GetPrimAtPath("/World/Set"), "synthetic")
    assert build.one(PATH).role == Role.SYNTHETIC
    build.tag(prim, "real")
    assert build.one(PATH).role == Role.REAL


def test_ignored_prims_are_dropped_with_what_is_below(build):
    thing(build)
    build.tag(build.stage.GetPrimAtPath("/World/Set"), "ignore")
    assert PATH not in [m.path for m in build.read().meshes]
    assert build.one(PATH, synthetic=[PATH]).role == Role.SYNTHETIC


def test_the_deeper_path_of_the_command_line_wins(build):
    thing(build)
    assert build.one(PATH, real=["/World"], synthetic=[PATH]).role == Role.SYNTHETIC
    assert build.one(PATH, synthetic=["/World"], real=["/World/Set"]).role == Role.REAL


def test_paths_of_the_command_line_are_checked(build):
    thing(build)
    with pytest.raises(StageError, match=r"--real /World/Gone: there is no such prim"):
        build.read(real=["/World/Gone"])
    with pytest.raises(StageError, match=r"--synthetic 'Set' is not an absolute prim path"):
        build.read(synthetic=["Set"])
    with pytest.raises(StageError, match=r"/World/Set is given with --real and with --synthetic"):
        build.read(real=["/World/Set"], synthetic=["/World/Set"])


def test_collections_honour_excludes_and_expressions(build):
    thing(build)
    real_collection(build, "/World/Set").ExcludePath(PATH)
    assert build.one(PATH).role == Role.SYNTHETIC
    render_pass = UsdRender.Pass.Define(build.stage, "/Render/Pass").GetPrim()
    expression = Sdf.PathExpression("/World/Set//")
    Usd.CollectionAPI.Get(render_pass, "matte").CreateMembershipExpressionAttr(expression)
    assert build.one(PATH).role == Role.REAL


def test_several_render_passes_are_listed_and_one_can_be_chosen(build):
    thing(build)
    matte(build, "/World/Room", "/Render/A")
    matte(build, PATH, "/Render/B")
    UsdRender.Pass.Define(build.stage, "/Render/Empty")
    assert build.one(PATH).role == Role.SYNTHETIC
    assert [n.path for n in build.read().notices] == ["/Render/B"]
    assert build.one(PATH, render_pass="/Render/B").role == Role.REAL
    assert build.one(PATH, render_pass="/Render/Empty").role == Role.SYNTHETIC
    with pytest.raises(StageError, match="/World/Room is not a RenderPass"):
        build.read(render_pass="/World/Room")


def test_an_unknown_tag_is_refused(build):
    build.tag(thing(build), "virtual")
    expected = rf"{PATH}: primvars:dvct:reality is 'virtual'; it must be one of real, synthetic, ignore"
    with pytest.raises(StageError, match=expected):
        build.read()


def test_a_stage_without_one_of_the_roles_says_how_to_tag(build):
    with pytest.raises(StageError, match=r"no geometry is synthetic; author primvars:dvct:reality = \"synthetic\""):
        read_stage(build.stage)
    assert len(read_stage(build.stage, allow_empty_roles=True).meshes) == 1
    thing(build)
    assert len(read_stage(build.stage).meshes) == 2
    build.stage.RemovePrim("/World/Room")
    with pytest.raises(StageError, match=r"no geometry is real; author .* or pass --real PRIM_PATH.*matte"):
        read_stage(build.stage)


def test_a_capture_without_a_mesh_says_where_its_real_scene_comes_from(build):
    thing(build)
    build.stage.RemovePrim("/World/Room")
    build.stage.GetPrimAtPath("/World/Camera").CreateAttribute("dvct:depth:file", Sdf.ValueTypeNames.Asset)
    with pytest.raises(StageError, match=r"no geometry is real; the stage is a capture: give it as --real-from too"):
        read_stage(build.stage)


def test_invisible_synthetic_prims_are_an_empty_set_and_no_error(build):
    prim = thing(build)
    visibility = UsdGeom.Imageable(prim).CreateVisibilityAttr()
    visibility.Set("invisible", 1.0)
    visibility.Set("inherited", 2.0)
    hidden = read_stage(build.stage, time=1.0)
    assert hidden.bounds(Role.SYNTHETIC) is None
    assert [m.path for m in hidden.meshes] == ["/World/Room"]
    assert read_stage(build.stage, time=2.0).bounds(Role.SYNTHETIC) is not None

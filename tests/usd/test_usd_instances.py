"""Native instances and point instancers: places, roles, sharing."""

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom

import warp_dvct.usd.read as reader
from warp_dvct.errors import StageError
from warp_dvct.scene import Role


def library(build, path="/Library/Brick"):
    """A class with a unit cube in it, one unit to the right."""
    UsdGeom.Xform.Define(build.stage, path)
    build.stage.GetPrimAtPath("/Library").SetSpecifier(Sdf.SpecifierClass)
    box = UsdGeom.Cube.Define(build.stage, path + "/Box")
    box.CreateSizeAttr(1.0)
    box.AddTranslateOp().Set((1, 0, 0))
    return path


def instancer(build, positions, path="/World/Bricks", prototype=None, indices=None):
    points = UsdGeom.PointInstancer.Define(build.stage, path)
    points.CreatePositionsAttr([Gf.Vec3f(*p) for p in positions])
    points.CreateProtoIndicesAttr(indices or [0] * len(positions))
    points.CreatePrototypesRel().AddTarget(prototype or library(build))
    return points


def below(scene, path):
    return [m for m in scene.meshes if m.path.startswith(path)]


def centres(mesh, copies):
    return mesh.points.reshape(copies, -1, 3).mean(1)


def test_native_instances_stand_where_they_are_and_are_cut_once(build, monkeypatch):
    library(build)
    for k in range(5):
        prim = build.stage.DefinePrim(f"/World/Wall/B{k}", "Xform")
        prim.GetReferences().AddInternalReference("/Library/Brick")
        prim.SetInstanceable(True)
        UsdGeom.Xformable(prim).AddTranslateOp().Set((0, 2 * k, 0))
    cut = []
    original = reader.read_local
    monkeypatch.setattr(reader, "read_local", lambda prim, ctx: cut.append(prim) or original(prim, ctx))
    meshes = below(build.read(), "/World/Wall")
    assert [m.path for m in meshes] == [f"/World/Wall/B{k}/Box" for k in range(5)]
    np.testing.assert_allclose([m.points.mean(0) for m in meshes], [(1, 2 * k, 0) for k in range(5)])
    assert len(cut) == 2  # the brick and the room


def test_instances_have_roles_and_colours_of_their_own(build):
    library(build)
    for name, role, color in (("A", "real", (0.2, 0, 0)), ("B", "synthetic", (0, 0.2, 0))):
        prim = build.stage.DefinePrim(f"/World/Wall/{name}", "Xform")
        prim.GetReferences().AddInternalReference("/Library/Brick")
        prim.SetInstanceable(True)
        build.tag(prim, role)
        UsdGeom.PrimvarsAPI(prim).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray).Set([color])
    scene = build.read()
    a, b = below(scene, "/World/Wall")
    assert (a.role, b.role) == (Role.REAL, Role.SYNTHETIC)
    assert scene.materials[a.materials[0]].base_color == pytest.approx((0.2, 0, 0))
    assert scene.materials[b.materials[0]].base_color == pytest.approx((0, 0.2, 0))
    assert below(build.read(synthetic=["/World/Wall/A/Box"]), "/World/Wall/A")[0].role == Role.SYNTHETIC


def test_point_instances_apply_scale_orientation_position_and_the_prototypes_own_transform(build):
    points = instancer(build, [(0, 0, 0), (10, 0, 0), (0, 5, 0)])
    points.CreateScalesAttr([(1, 1, 1), (2, 2, 2), (1, 1, 1)])
    half = float(np.sqrt(0.5))
    points.CreateOrientationsAttr([Gf.Quath(1), Gf.Quath(1), Gf.Quath(half, Gf.Vec3h(0, 0, half))])
    UsdGeom.Xformable(points).AddTranslateOp().Set((0, 0, 7))
    prototype = UsdGeom.Xformable(build.stage.GetPrimAtPath("/Library/Brick"))
    prototype.AddTranslateOp().Set((1, 0, 0))  # the box stands at x = 2 of an instance
    (mesh,) = below(build.read(), "/World/Bricks")
    assert mesh.path == "/World/Bricks/Brick/Box"
    assert len(mesh.triangles) == 36
    np.testing.assert_allclose(centres(mesh, 3), [(2, 0, 7), (14, 0, 7), (0, 7, 7)], atol=2e-3)
    np.testing.assert_allclose(np.ptp(mesh.points.reshape(3, -1, 3), axis=1)[:2], [(1, 1, 1), (2, 2, 2)], atol=1e-6)


def test_mirrored_point_instances_keep_their_outside(build, measure):
    instancer(build, [(0, 0, 0), (5, 0, 0)]).CreateScalesAttr([(1, 1, 1), (-1, 1, 1)])
    (mesh,) = below(build.read(), "/World/Bricks")
    assert measure.volume(mesh) == pytest.approx(2.0)


def test_invisible_and_inactive_ids_are_left_out(build):
    points = instancer(build, [(k, 0, 0) for k in range(5)])
    points.CreateIdsAttr([10, 11, 12, 13, 14])
    points.CreateInvisibleIdsAttr([11])
    points.DeactivateId(13)
    (mesh,) = below(build.read(), "/World/Bricks")
    np.testing.assert_allclose(centres(mesh, 3)[:, 0], [1, 3, 5])
    points.GetInvisibleIdsAttr().Set([10, 11, 12, 14])
    assert below(build.read(allow_empty_roles=False), "/World/Bricks") == []


def test_nested_point_instancers_multiply(build):
    instancer(build, [(0, 0, 0), (0, 2, 0)], "/Library/Column")
    inner = build.stage.GetPrimAtPath("/Library/Column")
    instancer(build, [(0, 0, 0), (10, 0, 0), (20, 0, 0)], "/World/Field", prototype=inner.GetPath())
    (mesh,) = below(build.read(), "/World/Field")
    assert mesh.path == "/World/Field/Column/Brick/Box"
    found = sorted(map(tuple, np.round(centres(mesh, 6), 6)))
    assert found == [(x + 1.0, y, 0.0) for x in (0.0, 10.0, 20.0) for y in (0.0, 2.0)]


def test_an_instancer_inside_itself_is_refused(build):
    points = instancer(build, [(0, 0, 0)])
    points.GetPrototypesRel().SetTargets(["/World/Bricks"])
    with pytest.raises(StageError, match="nested more than 8 deep; is it its own prototype"):
        build.read()


def test_several_prototypes_are_chosen_by_index(build):
    points = instancer(build, [(0, 0, 0), (5, 0, 0), (9, 0, 0)], indices=[1, 0, 1])
    UsdGeom.Sphere.Define(build.stage, "/Library/Ball")
    points.GetPrototypesRel().AddTarget("/Library/Ball")
    box, ball = below(build.read(), "/World/Bricks")
    assert (box.path, ball.path) == ("/World/Bricks/Brick/Box", "/World/Bricks/Ball")
    np.testing.assert_allclose(box.points.mean(0), [6, 0, 0])
    np.testing.assert_allclose(centres(ball, 2), [(0, 0, 0), (9, 0, 0)], atol=1e-9)


def test_roles_of_instances_come_from_the_prototype_and_then_the_instancer(build):
    points = instancer(build, [(0, 0, 0)])
    build.tag(points, "real")
    assert below(build.read(), "/World/Bricks")[0].role == Role.REAL
    build.tag(build.stage.GetPrimAtPath("/Library/Brick/Box"), "synthetic")
    assert below(build.read(), "/World/Bricks")[0].role == Role.SYNTHETIC
    assert below(build.read(real=["/World/Bricks"]), "/World/Bricks")[0].role == Role.REAL


def test_a_collection_reaches_the_copies_through_the_instancer(build):
    instancer(build, [(0, 0, 0)])
    Usd.CollectionAPI.Apply(build.stage.GetDefaultPrim(), "dvct:real").IncludePath("/World/Bricks")
    assert below(build.read(), "/World/Bricks")[0].role == Role.REAL


def test_prototypes_below_the_instancer_are_not_drawn_by_themselves(build):
    build.stage.CreateClassPrim("/Library")
    points = instancer(build, [(0, 0, 0), (3, 0, 0)], prototype="/World/Bricks/Protos/Ball")
    UsdGeom.Sphere.Define(build.stage, "/World/Bricks/Protos/Ball")
    meshes = below(build.read(), "/World")
    assert [m.path for m in meshes] == ["/World/Room", f"{points.GetPath()}/Ball"]


def test_colours_per_instance_are_listed(build):
    points = instancer(build, [(0, 0, 0), (3, 0, 0)])
    color = UsdGeom.PrimvarsAPI(points).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "vertex")
    color.Set([(1, 0, 0), (0, 1, 0)])
    assert [(n.path, "per instance" in n.message) for n in build.read().notices] == [("/World/Bricks", True)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p.GetProtoIndicesAttr().Set([0, 1]), "protoIndices go up to 1, but it has 1 prototypes"),
        (lambda p: p.GetProtoIndicesAttr().Set([0]), "1 protoIndices, but positions"),
        (lambda p: p.GetPrototypesRel().SetTargets(["/Gone"]), "its prototype /Gone does not exist"),
        (
            lambda p: p.GetPositionsAttr().Set([(0, 0, 0), (0, float("nan"), 0)]),
            "NaN or infinite values in its positions",
        ),
    ],
)
def test_point_instancers_that_are_wrong_are_named(build, change, message):
    change(instancer(build, [(0, 0, 0), (1, 0, 0)]))
    with pytest.raises(StageError, match=rf"/World/Bricks: {message}"):
        build.read()


def test_lights_in_instances_are_multiplied(build):
    library(build)
    lamp = build.stage.DefinePrim("/Library/Brick/Lamp", "SphereLight")
    UsdGeom.Xformable(lamp).AddTranslateOp().Set((0, 1, 0))
    instancer(build, [(0, 0, 0), (4, 0, 0)], prototype="/Library/Brick")
    lights = [light for light in build.read().lights if light.path.startswith("/World/Bricks")]
    assert [light.position for light in lights] == [(0, 1, 0), (4, 1, 0)]
    assert [light.path for light in lights] == ["/World/Bricks/Brick/Lamp[0]", "/World/Bricks/Brick/Lamp[1]"]

"""UsdGeom.Points: what a scan's points become."""

import sys

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom

from warp_dvct.errors import StageError
from warp_dvct.scene import Role

PATH = "/World/Scan"


def sphere(count=2000, radius=1.0, seed=0):
    normals = np.random.default_rng(seed).standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals * radius, normals


def define(build, points, normals=None, widths=None, path=PATH):
    prim = UsdGeom.Points.Define(build.stage, path)
    prim.CreatePointsAttr([tuple(map(float, p)) for p in points])
    if normals is not None:
        prim.CreateNormalsAttr([tuple(map(float, n)) for n in normals])
    if widths is not None:
        prim.CreateWidthsAttr([float(w) for w in widths])
    return prim


def cloud(build, path=PATH, **options):
    (found,) = [c for c in build.read(**options).point_clouds if c.path == path]
    return found


def test_points_are_placed_in_the_world_in_metres(build):
    points, normals = sphere(50)
    prim = define(build, points, normals, np.linspace(0.1, 0.2, 50))
    build.tag(prim, "real")
    UsdGeom.SetStageMetersPerUnit(build.stage, 0.01)
    UsdGeom.SetStageUpAxis(build.stage, "Z")
    prim.AddTranslateOp().Set((1, 2, 3))
    found = cloud(build)
    local = points.astype(np.float32) + np.array((1, 2, 3))
    np.testing.assert_allclose(found.points, 0.01 * local[:, [0, 2, 1]] * (1, 1, -1), atol=1e-9)
    np.testing.assert_allclose(found.normals, normals[:, [0, 2, 1]] * (1, 1, -1), atol=1e-6)
    np.testing.assert_allclose(found.radii, 0.005 * np.linspace(0.1, 0.2, 50), rtol=1e-6)
    assert found.role == Role.REAL
    assert not found.double_sided
    low, high = build.read().bounds()
    assert (low <= found.points.min(0)).all()
    assert (high >= found.points.max(0)).all()


def test_discs_keep_the_area_of_a_stretched_surface(build):
    """A unit sphere's points under scales become an ellipsoid's, whose discs still add up to its area."""
    points, normals = sphere(20_000)
    prim = define(build, points, normals, np.full(20_000, 2 * np.sqrt(4 / 20_000)))
    prim.AddScaleOp().Set((1.0, 1.0, 3.0))
    found = cloud(build)
    e = np.sqrt(1 - 1 / 9)
    prolate = 2 * np.pi * (1 + 3 / e * np.arcsin(e))
    assert (np.pi * found.radii.astype(float) ** 2).sum() == pytest.approx(prolate, rel=0.01)
    gradient = found.points / (1, 1, 9)
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    np.testing.assert_allclose(found.normals, gradient, atol=1e-5)


def test_estimated_normals_and_radii_are_those_of_the_surface(build):
    pytest.importorskip("open3d")
    points, normals = sphere(20_000)
    define(build, points)
    found = cloud(build)
    assert found.double_sided
    assert np.abs(np.einsum("nk,nk->n", found.normals, normals)).min() > 0.995
    assert (np.pi * found.radii.astype(float) ** 2).sum() == pytest.approx(4 * np.pi, rel=0.01)


@pytest.mark.parametrize("missing", ["normals", "widths"])
def test_without_open3d_what_is_missing_is_named(build, monkeypatch, missing):
    points, normals = sphere(20)
    define(build, points, None if missing == "normals" else normals, None if missing == "widths" else [0.1])
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(StageError, match=rf"{PATH} has no {missing}: author {missing}, or .*warp-dvct\[reconstruct\]"):
        build.read()


def test_colours_come_from_primvars_or_a_material(build):
    points, normals = sphere(4)
    prim = define(build, points, normals, [0.1])
    colors = [(0.1, 0.2, 0.3), (0.4, 0.5, 0.6), (0.7, 0.8, 0.9), (1.0, 0.0, 0.5)]
    primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "vertex")
    primvar.Set(colors)
    scene = build.read()
    np.testing.assert_allclose(scene.point_clouds[0].colors, colors, atol=1e-6)
    np.testing.assert_allclose(scene.materials[scene.point_clouds[0].material].base_color, 1.0)
    build.material(bind=prim, diffuseColor=(0.3, 0.2, 0.1), roughness=0.4)
    scene = build.read()
    assert scene.point_clouds[0].colors is None
    material = scene.materials[scene.point_clouds[0].material]
    np.testing.assert_allclose((*material.base_color, material.roughness), (0.3, 0.2, 0.1, 0.4), atol=1e-6)


def test_time_samples_move_points(build):
    prim = define(build, [(0, 0, 0)], [(0, 0, 1)], [0.1])
    prim.GetPointsAttr().Set([(0, 0, 0)], 1)
    prim.GetPointsAttr().Set([(0, 4, 0), (1, 4, 0)], 5)
    prim.GetNormalsAttr().Set([(0, 0, 1)], 1)
    prim.GetNormalsAttr().Set([(0, 1, 0), (1, 0, 0)], 5)
    np.testing.assert_allclose(cloud(build, time=1).points, [(0, 0, 0)])
    found = cloud(build, time=5)
    np.testing.assert_allclose(found.points, [(0, 4, 0), (1, 4, 0)])
    np.testing.assert_allclose(found.normals, [(0, 1, 0), (1, 0, 0)])
    np.testing.assert_allclose(found.radii, 0.05)


def test_instances_copy_points(build):
    UsdGeom.Xform.Define(build.stage, "/World/Proto")
    define(build, [(1, 0, 0)], [(1, 0, 0)], [0.2], path="/World/Proto/Dots")
    instancer = UsdGeom.PointInstancer.Define(build.stage, "/World/Many")
    instancer.CreatePrototypesRel().SetTargets(["/World/Proto"])
    instancer.CreateProtoIndicesAttr([0, 0])
    instancer.CreatePositionsAttr([(0, 0, 0), (0, 5, 0)])
    instancer.CreateOrientationsAttr([Gf.Quath(1, 0, 0, 0), Gf.Quath(0, 0, 1, 0)])  # half a turn about y
    found = cloud(build, "/World/Many/Proto/Dots")
    np.testing.assert_allclose(found.points, [(1, 0, 0), (-1, 5, 0)], atol=1e-6)
    np.testing.assert_allclose(found.normals, [(1, 0, 0), (-1, 0, 0)], atol=1e-6)
    np.testing.assert_allclose(found.radii, 0.1)


def test_mirrored_points_keep_their_outside(build):
    points, normals = sphere(30)
    define(build, points, normals, [0.1]).AddScaleOp().Set((-1, 1, 1))
    found = cloud(build)
    np.testing.assert_allclose(found.normals, found.points, atol=1e-6)


def test_points_without_extent_or_normal_are_dropped_and_counted(build):
    define(build, np.eye(3), [(0, 0, 1), (0, 0, 0), (0, 1, 0)], [0.1, 0.1, 0.0])
    scene = build.read()
    assert len(scene.point_clouds[0].points) == 1
    assert f"{PATH}: 2 points of no width or without a normal dropped" in [str(n) for n in scene.notices]


def test_a_prim_without_points_is_noted(build):
    UsdGeom.Points.Define(build.stage, PATH)
    scene = build.read()
    assert scene.point_clouds == ()
    assert f"{PATH}: has no points; nothing is drawn" in [str(n) for n in scene.notices]


@pytest.mark.parametrize(
    ("points", "normals", "widths", "message"),
    [
        ([(0, 0, 0), (0, np.nan, 0)], [(0, 0, 1)], [0.1], r"1 of 2 points are NaN .*point 1"),
        ([(0, 0, 0), (0, 1, 0)], [(0, 0, 1), (np.inf, 0, 0)], [0.1], r"1 of 2 normals are NaN"),
        ([(0, 0, 0)] * 3, [(0, 0, 1)] * 2, [0.1], r"2 normals, but 3 points"),
        ([(0, 0, 0)] * 3, [(0, 0, 1)], [0.1] * 2, r"2 widths, but 3 points"),
        ([(0, 0, 0)], [(0, 0, 1)], [-0.1], r"widths go down to -0.1"),
        ([(0, 0, 0)], [(0, 0, 1)], None, r"a single point without a width"),
        ([(0, 0, 0)], None, [0.1], r"1 points without normals"),
    ],
)
def test_bad_points_are_refused(build, points, normals, widths, message):
    define(build, points, normals, widths)
    with pytest.raises(StageError, match=rf"{PATH}: {message}"):
        build.read()


def test_a_scan_counts_as_real_geometry(build):
    stage = Usd.Stage.CreateInMemory()
    scan = type(build)(stage, complete=False)
    UsdGeom.Camera.Define(stage, "/World/Camera")
    stage.DefinePrim("/World/Light", "DistantLight")
    UsdGeom.Cube.Define(stage, "/World/Box")
    scan.tag(define(scan, np.eye(3), np.eye(3), [0.1]), "real")
    assert [c.role for c in scan.read(allow_empty_roles=False).point_clouds] == [Role.REAL]

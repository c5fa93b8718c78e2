"""Subdivision surfaces against closed forms: limit positions, B-splines, creases, and primvars on them."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Sdf, UsdGeom

from warp_dvct.errors import OptionError, StageError
from warp_dvct.usd.subdivision import Creases, Level, Refinement

CUBE = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
CUBE_FACES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
OCTAHEDRON = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], float)
OCTAHEDRON_FACES = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]


def refinement(points, faces, levels, scheme="catmullClark", **creases):
    counts, indices = np.array([len(f) for f in faces]), np.array([i for f in faces for i in f])
    return Refinement(Level(len(points), counts, indices, scheme, Creases(**creases)), levels)


def grid(n, height):
    """A square of n x n quads over [0, n]², ``height`` ``[n + 1, n + 1]`` above each vertex; points and faces."""
    x, y = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    points = np.stack([x, y, height], -1).reshape(-1, 3).astype(float)
    at = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    return points, np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], -1).reshape(-1, 4).tolist()


@pytest.mark.parametrize("levels", [1, 2, 4])
def test_a_cubes_corners_end_half_way(levels):
    """Limit of a vertex with three faces: (9 v + 4 Σ edges + Σ diagonals) / 24 = v / 2, whatever the level."""
    points = refinement(CUBE, CUBE_FACES, levels).vertices(CUBE)
    np.testing.assert_allclose(points[:8], 0.5 * CUBE, atol=1e-12)


@pytest.mark.parametrize("scheme", ["catmullClark", "loop"])
def test_points_on_the_limit_do_not_move_when_refined_further(scheme):
    """Vertices of a level are vertices of the next, with the same limit: a wrong mask of either kind would show."""
    cage, faces = (CUBE, CUBE_FACES) if scheme == "catmullClark" else (OCTAHEDRON, OCTAHEDRON_FACES)
    cage = cage + 0.3 * np.random.default_rng(1).normal(size=cage.shape)
    # A closed crease: where one ends in a smooth surface, masks are those of the smooth rule, which is not exact.
    ring = {"catmullClark": [[0, 1], [1, 3], [3, 2], [2, 0]], "loop": [[0, 2], [2, 1], [1, 3], [3, 0]]}[scheme]
    sharp = {"edges": np.array(ring), "edge_sharpness": np.full(4, 10.0)}
    once, thrice = (refinement(cage, faces, n, scheme, **sharp).vertices(cage) for n in (1, 3))
    np.testing.assert_allclose(thrice[: len(once)], once, atol=1e-12)


def test_inside_a_grid_it_is_the_bicubic_b_spline():
    """Height at vertices and at the middle of edges: [1 4 1] / 6 and [1 23 23 1] / 48 of the cage, across and along."""
    height = np.random.default_rng(2).normal(size=(7, 7))
    cage, faces = grid(6, height)
    points = refinement(cage, faces, 1).vertices(cage)
    at = {(round(2 * p[0]), round(2 * p[1])): p[2] for p in points if 1 < p[0] < 5 and 1 < p[1] < 5}
    knot = np.array([1, 4, 1]) / 6
    middle = np.array([1, 23, 23, 1]) / 48
    assert at[6, 6] == pytest.approx(knot @ height[2:5, 2:5] @ knot, abs=1e-12)
    assert at[7, 6] == pytest.approx(middle @ height[2:6, 2:5] @ knot, abs=1e-12)
    assert at[7, 7] == pytest.approx(middle @ height[2:6, 2:6] @ middle, abs=1e-12)


@pytest.mark.parametrize(("sharp_corners", "corner"), [(True, (0, 0)), (False, (1 / 6, 1 / 6))])
def test_borders_are_cubic_b_splines_with_or_without_corners(sharp_corners, corner):
    """A flat sheet stays flat and keeps its straight sides; without sharp corners they are rounded: (1 4 1) / 6."""
    cage, faces = grid(3, np.zeros((4, 4)))
    points = refinement(cage, faces, 2, sharp_corners=sharp_corners).vertices(cage)
    assert (points[:, 2] == 0).all()
    assert points[:, :2].min() == pytest.approx(0.0, abs=1e-12)
    assert points[0, :2] == pytest.approx(corner, abs=1e-12)


def test_sharp_edges_keep_a_cube_and_semi_sharp_ones_are_between():
    edges = np.array([[a, b] for a in range(8) for b in range(a + 1, 8) if (CUBE[a] != CUBE[b]).sum() == 1])

    def reach(sharpness):
        creases = {"edges": edges, "edge_sharpness": np.full(12, sharpness)}
        return refinement(CUBE, CUBE_FACES, 3, **creases).vertices(CUBE)

    assert np.abs(reach(10.0)).max(1) == pytest.approx(np.ones(386), abs=1e-12)
    extents = [np.linalg.norm(reach(s)[0]) for s in (0.0, 0.5, 1.0, 2.0, 10.0)]
    assert extents == sorted(extents)
    assert len(set(np.round(extents, 6))) == 5


def test_a_sharp_vertex_stays():
    points = refinement(CUBE, CUBE_FACES, 2, corners=np.array([7]), corner_sharpness=np.array([10.0])).vertices(CUBE)
    np.testing.assert_allclose(points[7], CUBE[7], atol=1e-12)
    assert np.abs(points[0]).max() < 0.6


def test_a_stage_of_a_cube_is_a_round_thing(build, measure):
    """Outwards, smooth, smaller than its cage; a level more adds what lies between the surface and its flat faces."""
    build.mesh(CUBE, CUBE_FACES, scheme="catmullClark")
    coarse, fine, finer = (build.one(complexity=c) for c in ("medium", "high", "veryhigh"))
    assert [len(m.triangles) for m in (coarse, fine, finer)] == [48, 192, 768]
    assert 0 < measure.volume(coarse) < measure.volume(fine) < measure.volume(finer) < 8
    assert measure.volume(fine) == pytest.approx(measure.volume(finer), rel=0.06)
    toward = fine.points[fine.triangles] / np.linalg.norm(fine.points[fine.triangles], axis=-1, keepdims=True)
    assert (np.einsum("tck,tck->tc", toward, fine.corner_normals) > 0.9).all()
    assert build.read().notices == ()
    (low,) = build.read(complexity="low").notices
    assert "drawn as its control mesh" in low.message
    with pytest.raises(OptionError, match="complexity is 'ultra'"):
        build.read(complexity="ultra")


def test_primvars_follow_the_surface(build):
    """A vertex primvar that is the position itself stays it; a faceVarying one stays linear over each face."""
    mesh = build.mesh(CUBE, CUBE_FACES, scheme="catmullClark")
    api = UsdGeom.PrimvarsAPI(mesh)
    kinds = Sdf.ValueTypeNames
    api.CreatePrimvar("displayColor", kinds.Color3fArray, "vertex").Set([tuple(0.5 + 0.5 * p) for p in CUBE])
    found = build.one()
    np.testing.assert_allclose(found.corner_colors, 0.5 + 0.5 * found.points[found.triangles], atol=1e-6)
    square = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    api.CreatePrimvar("displayColor", kinds.Color3fArray, "faceVarying").Set(square * 6)
    values = build.one().corner_colors
    assert set(np.unique(np.round(4 * values))) <= {0.0, 1.0, 2.0, 3.0, 4.0}
    areas = np.cross(values[:, 1] - values[:, 0], values[:, 2] - values[:, 0])[:, 2] / 2
    assert areas == pytest.approx(np.full(192, 1 / 32), abs=1e-6)
    api.CreatePrimvar("displayColor", kinds.Color3fArray, "uniform").Set([(k / 8, 0, 0) for k in range(6)])
    assert np.bincount(np.round(8 * build.one().corner_colors[:, 0, 0]).astype(int)).tolist() == [32] * 6


def test_loop_takes_triangles_alone(build, measure):
    build.mesh(OCTAHEDRON, OCTAHEDRON_FACES, "/World/Gem", "loop")
    build.mesh(CUBE, CUBE_FACES, "/World/Box", "loop")
    assert len(build.one("/World/Gem").triangles) == 8 * 16
    assert measure.volume(build.one("/World/Gem")) > 0
    assert len(build.one("/World/Box").triangles) == 12
    (told,) = build.read().notices
    assert str(told).startswith("/World/Box: subdivisionScheme is loop, but it has faces that are no triangles")


def test_holes_subsets_and_orientation(build, measure):
    mesh = build.mesh(CUBE, CUBE_FACES, scheme="catmullClark")
    mesh.CreateHoleIndicesAttr([1])
    assert len(build.one().triangles) == 160
    mesh.GetHoleIndicesAttr().Set([])
    mesh.CreateOrientationAttr("leftHanded")
    assert measure.volume(build.one()) < 0
    other = build.material("/World/Looks/Red", diffuseColor=(0.9, 0.1, 0.1)).GetPrim().GetParent()
    subset = UsdGeom.Subset.Define(build.stage, "/World/Mesh/Front")
    subset.CreateElementTypeAttr("face")
    subset.CreateFamilyNameAttr("materialBind")
    subset.CreateIndicesAttr([0, 3])
    subset.GetPrim().ApplyAPI("MaterialBindingAPI")
    subset.GetPrim().CreateRelationship("material:binding").SetTargets([other.GetPath()])
    assert sorted(np.unique(build.one().materials, return_counts=True)[1]) == [64, 128]


def test_a_mesh_that_is_fine_already_is_refined_less_and_listed(build, monkeypatch):
    monkeypatch.setattr("warp_dvct.usd.refine.MOST_FACES", 50)
    build.mesh(CUBE, CUBE_FACES, scheme="catmullClark")
    assert len(build.one().triangles) == 48
    (told,) = build.read().notices
    assert "refined 1 of 2 times" in told.message
    monkeypatch.setattr("warp_dvct.usd.refine.MOST_FACES", 20)
    assert len(build.one().triangles) == 12


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("creaseIndices", [0, 99], "creaseIndices has the index 99"),
        ("creaseLengths", [3], "creaseLengths add up to 3, but there are 2"),
        ("creaseSharpnesses", [1.0, 2.0, 3.0], "creaseSharpnesses has 3 values for 1 creases"),
        ("creaseSharpnesses", [float("nan")], "NaN"),
        ("cornerIndices", [-1], "cornerIndices has the index -1"),
        ("cornerSharpnesses", [1.0], "cornerSharpnesses has 1 values for 0 corners"),
    ],
)
def test_creases_that_do_not_fit_are_refused(build, name, values, message):
    mesh = build.mesh(CUBE, CUBE_FACES, scheme="catmullClark").GetPrim()
    for other, given in (("creaseIndices", [0, 1]), ("creaseLengths", [2]), ("creaseSharpnesses", [2.0])):
        mesh.GetAttribute(other).Set(given)
    mesh.GetAttribute(name).Set(values)
    with pytest.raises(StageError, match=message):
        build.read()

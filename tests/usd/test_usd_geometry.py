"""Polygons, holes, orientation, primvars and normals of meshes."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from pxr import Sdf, UsdGeom

from warp_dvct.errors import StageError
from warp_dvct.usd.triangulate import clip_ears, triangulate

L_SHAPE = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0)]
CUBE_POINTS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
CUBE_FACES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def covers(points, triangles, probe):
    """How many triangles hold a point of the xy plane."""
    a, b, c = (np.asarray(points, float)[triangles[:, k], :2] for k in range(3))

    def side(p, q):
        return (q - p)[:, 0] * (probe - p)[:, 1] - (q - p)[:, 1] * (probe - p)[:, 0]

    return int(((side(a, b) > 0) & (side(b, c) > 0) & (side(c, a) > 0)).sum())


@pytest.mark.parametrize("start", range(6))
def test_concave_polygon_is_cut_exactly_from_any_first_corner(build, measure, start):
    corners = [(start + k) % 6 for k in range(6)]
    build.mesh(L_SHAPE, [corners])
    mesh = build.one()
    assert len(mesh.triangles) == 4
    assert measure.areas(mesh).sum() == pytest.approx(3.0, rel=1e-12)
    np.testing.assert_allclose(measure.face_normals(mesh), np.tile([0, 0, 1], (4, 1)), atol=1e-12)


def test_concave_quads_are_not_fanned_across_their_reflex_corner(build, measure):
    build.mesh([(0, 0, 0), (2, 0, 0), (0.5, 0.5, 0), (0, 2, 0)], [[0, 1, 2, 3], [3, 2, 1, 0], [1, 2, 3, 0]])
    mesh = build.one()
    # The arrow's area is 1, in either winding and from either start.
    assert measure.areas(mesh).reshape(3, 2).sum(1) == pytest.approx([1.0, 1.0, 1.0])
    np.testing.assert_array_equal(np.sign(measure.face_normals(mesh)[:, 2]), [1, 1, -1, -1, 1, 1])


def test_a_hole_joined_by_a_doubled_edge_stays_empty():
    outer = [(0, 0, 0), (4, 0, 0), (4, 4, 0), (0, 4, 0)]
    inner = [(1, 1, 0), (1, 3, 0), (3, 3, 0), (3, 1, 0)]
    polygon = np.array([*outer, outer[0], *inner, inner[0]], float)
    triangles, crossed = clip_ears(polygon)
    p = polygon[triangles]
    area = 0.5 * np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 2]
    assert not crossed
    assert (area >= 0).all()
    assert area.sum() == pytest.approx(12.0)
    assert covers(polygon, triangles, np.array([2.0, 2.1])) == 0
    assert covers(polygon, triangles, np.array([0.51, 2.1])) == 1


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0.1, 1.0), min_size=5, max_size=24), st.integers(0, 2**31))
def test_star_polygons_in_any_plane_keep_area_and_winding(radii, seed):
    n = len(radii)
    angle = np.arange(n) / n * 2 * np.pi
    flat = np.stack([np.cos(angle), np.sin(angle)], 1) * np.array(radii)[:, None]
    basis = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    points = flat @ basis[:2]
    cut = triangulate(points, np.array([n]), np.arange(n), np.ones(1, bool))
    p = points[cut.corners]
    vectors = 0.5 * np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normal = np.cross(basis[0], basis[1])
    shoelace = 0.5 * (flat[:, 0] * np.roll(flat[:, 1], -1) - flat[:, 1] * np.roll(flat[:, 0], -1)).sum()
    assert len(cut.corners) == n - 2
    assert (vectors @ normal >= -1e-9).all()
    assert (vectors @ normal).sum() == pytest.approx(shoelace, rel=1e-9)


def test_triangles_follow_the_order_of_faces_of_mixed_size(build):
    mesh = build.mesh([*L_SHAPE, (3, 0, 0), (3, 1, 0)], [[0, 1, 2], [1, 6, 7, 2], [0, 1, 2, 3, 4, 5], [1, 6, 7]])
    color = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "uniform")
    color.Set([(0.1, 0, 0), (0.2, 0, 0), (0.3, 0, 0), (0.4, 0, 0)])
    colors = build.one().corner_colors[:, 0, 0]
    np.testing.assert_allclose(colors, [0.1, 0.2, 0.2, 0.3, 0.3, 0.3, 0.3, 0.4], rtol=1e-6)


def test_hole_indices_leave_faces_out(build, measure):
    build.mesh(CUBE_POINTS, CUBE_FACES).CreateHoleIndicesAttr([1, 4])
    assert measure.areas(build.one()).sum() == pytest.approx(4.0)


def test_hole_index_out_of_range_names_the_prim(build):
    build.quad().CreateHoleIndicesAttr([1])
    with pytest.raises(StageError, match=r"/World/Mesh: holeIndices go up to 1, but there are 1 faces"):
        build.read()


def test_orientation_and_mirroring_keep_the_outside_outside(build, measure):
    build.mesh(CUBE_POINTS, CUBE_FACES)
    assert measure.volume(build.one()) == pytest.approx(1.0)
    left = build.mesh(CUBE_POINTS, [face[::-1] for face in CUBE_FACES], "/World/Left")
    left.CreateOrientationAttr("leftHanded")
    assert measure.volume(build.one("/World/Left")) == pytest.approx(1.0)
    mirrored = build.mesh(CUBE_POINTS, CUBE_FACES, "/World/Mirrored")
    mirrored.AddScaleOp().Set((-2, 1, 1))
    assert measure.volume(build.one("/World/Mirrored")) == pytest.approx(2.0)


def test_double_sided_is_read(build):
    build.quad().CreateDoubleSidedAttr(True)
    assert build.one().double_sided
    build.quad("/World/Single")
    assert not build.one("/World/Single").double_sided


def corner_primvar(build, name, kind, interpolation, values, indices=None):
    mesh = build.mesh([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0)], [[0, 1, 2, 3], [1, 4, 2]])
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(name, kind, interpolation)
    primvar.Set(values)
    if indices is not None:
        primvar.SetIndices(indices)
    return build.one()


@pytest.mark.parametrize(
    ("interpolation", "values", "indices", "expected"),
    [
        ("uniform", [0.1, 0.2], None, [[0.1] * 3, [0.1] * 3, [0.2] * 3]),
        ("vertex", [0.0, 0.1, 0.2, 0.3, 0.4], None, [[0.0, 0.1, 0.2], [0.0, 0.2, 0.3], [0.1, 0.4, 0.2]]),
        ("varying", [0.0, 0.1, 0.2, 0.3, 0.4], None, [[0.0, 0.1, 0.2], [0.0, 0.2, 0.3], [0.1, 0.4, 0.2]]),
        ("faceVarying", [0.0, 0.1, 0.2, 0.3, 0.5, 0.6, 0.7], None, [[0.0, 0.1, 0.2], [0.0, 0.2, 0.3], [0.5, 0.6, 0.7]]),
        ("faceVarying", [0.9, 0.8], [0, 1, 0, 1, 1, 0, 1], [[0.9, 0.8, 0.9], [0.9, 0.9, 0.8], [0.8, 0.9, 0.8]]),
        ("uniform", [0.9, 0.8], [1, 0], [[0.8] * 3, [0.8] * 3, [0.9] * 3]),
    ],
)
def test_every_interpolation_reaches_the_corners(build, interpolation, values, indices, expected):
    kind = Sdf.ValueTypeNames.Color3fArray
    mesh = corner_primvar(build, "displayColor", kind, interpolation, [(v, 0, 1) for v in values], indices)
    np.testing.assert_allclose(mesh.corner_colors[..., 0], expected, rtol=1e-6)
    np.testing.assert_array_equal(mesh.corner_colors[..., 2], 1.0)


def test_primvar_index_out_of_range_names_prim_and_index(build):
    kind = Sdf.ValueTypeNames.Color3fArray
    with pytest.raises(
        StageError, match=r"/World/Mesh.primvars:displayColor:indices has the index 7, outside of its 2"
    ):
        corner_primvar(build, "displayColor", kind, "uniform", [(0, 0, 0), (1, 1, 1)], [0, 7])


def test_a_primvar_of_the_wrong_length_is_listed_and_left_out(build):
    corner_primvar(build, "displayColor", Sdf.ValueTypeNames.Color3fArray, "vertex", [(1, 0, 0), (0, 1, 0)])
    scene = build.read()
    assert [m.corner_colors for m in scene.meshes if m.path == "/World/Mesh"] == [None]
    assert any("2 values, which does not fit 'vertex'" in n.message for n in scene.notices)


def test_degenerate_triangles_are_dropped_and_counted(build):
    build.mesh(
        [(0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0), (1, 0, 0)], [[0, 1, 2], [0, 1, 3], [0, 1, 1], [2, 1, 4], [0, 1]]
    )
    scene = build.read()
    (mesh,) = [m for m in scene.meshes if m.path == "/World/Mesh"]
    assert len(mesh.triangles) == 1
    assert "/World/Mesh: 4 degenerate triangles dropped" in map(str, scene.notices)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_points_that_are_no_numbers_name_prim_and_point(build, bad):
    build.mesh([(0, 0, 0), (1, 0, 0), (0, bad, 0)], [[0, 1, 2]])
    with pytest.raises(StageError, match=r"/World/Mesh: 1 of 3 points are NaN or infinite \(the first is point 2\)"):
        build.read()


@pytest.mark.parametrize("index", [-1, 3])
def test_face_index_out_of_range_names_prim_and_index(build, index):
    build.mesh([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [[0, 1, index]])
    with pytest.raises(
        StageError, match=rf"/World/Mesh: faceVertexIndices has the index {index}, but there are 3 points"
    ):
        build.read()


def test_counts_that_do_not_add_up_name_the_prim(build):
    build.quad().CreateFaceVertexCountsAttr([3])
    with pytest.raises(StageError, match=r"/World/Mesh: faceVertexCounts add up to 3, but there are 4"):
        build.read()


def test_normals_primvar_wins_over_the_attribute_and_turns_with_the_prim(build):
    mesh = build.quad()
    mesh.CreateNormalsAttr([(0, 0, 1)] * 4)
    mesh.SetNormalsInterpolation("vertex")
    np.testing.assert_allclose(build.one().corner_normals, np.tile([0, 0, 1], (2, 3, 1)), atol=1e-7)
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, "uniform")
    primvar.Set([(0, 3, 4)])
    np.testing.assert_allclose(build.one().corner_normals, np.tile([0, 0.6, 0.8], (2, 3, 1)), atol=1e-7)
    # Normals transform by the inverse transpose: scaling y by 2 halves the y component before normalising.
    mesh.AddScaleOp().Set((1, 2, 1))
    expected = np.array([0, 0.3, 0.8]) / np.hypot(0.3, 0.8)
    np.testing.assert_allclose(build.one().corner_normals, np.tile(expected, (2, 3, 1)), atol=1e-6)


def test_polygon_meshes_without_normals_are_faceted(build):
    build.mesh(CUBE_POINTS, CUBE_FACES)
    assert build.one().corner_normals is None


def test_the_rim_of_a_capped_tube_is_an_edge_between_a_round_side_and_a_flat_cap(build, measure):
    """Were normals at the rim those of single faces, the side would show as many flat strips."""
    n = 24
    angle = np.arange(n) / n * 2 * np.pi
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    points = np.concatenate([ring, ring + np.array([0, 0, 1])])
    sides = [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
    build.mesh(points, [*sides, [n + k for k in range(n)]], scheme="catmullClark")
    tube = build.one(complexity="low")
    cap = measure.face_normals(tube)[:, 2] > 0.5
    np.testing.assert_allclose(tube.corner_normals[cap], np.broadcast_to([0, 0, 1], (n - 2, 3, 3)), atol=1e-6)
    corners = tube.points[tube.triangles][~cap] * [1, 1, 0]
    assert (np.einsum("tck,tck->tc", corners, tube.corner_normals[~cap]) > np.cos(np.radians(5))).all()


def test_control_meshes_are_listed_and_smooth_but_keep_hard_edges(build, measure):
    n = 24
    angle = np.arange(n) / n * 2 * np.pi
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    points = np.concatenate([ring, ring + np.array([0, 0, 1])])
    sides = [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
    build.mesh(points, sides, "/World/Tube", "catmullClark")
    build.mesh(CUBE_POINTS, CUBE_FACES, "/World/Box", "catmullClark")
    scene = build.read(complexity="low")
    tube, box = (next(m for m in scene.meshes if m.path == p) for p in ("/World/Tube", "/World/Box"))
    corners = tube.points[tube.triangles]
    radial = corners * [1, 1, 0] / np.linalg.norm(corners[..., :2], axis=-1, keepdims=True)
    assert (np.einsum("tck,tck->tc", radial, tube.corner_normals) > np.cos(np.radians(5))).all()
    np.testing.assert_allclose(box.corner_normals, np.repeat(measure.face_normals(box)[:, None], 3, 1), atol=1e-6)
    told = {n.path for n in scene.notices if "control mesh" in n.message}
    assert told == {"/World/Tube", "/World/Box"}

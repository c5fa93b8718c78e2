"""Intrinsic shapes: sizes, axes, normals, texture coordinates."""

import numpy as np
import pytest

from warp_dvct.errors import StageError

SHAPES = {
    "Cube": ({"size": 3.0}, 54.0, 27.0),
    "Sphere": ({"radius": 2.0}, 16 * np.pi, 32 / 3 * np.pi),
    "Cylinder": ({"radius": 1.5, "height": 4.0}, 16.5 * np.pi, 9 * np.pi),
    "Cylinder_1": (
        {"radiusBottom": 2.0, "radiusTop": 1.0, "height": 3.0},
        np.pi * (5 + 3 * np.sqrt(10)),
        7 * np.pi,
    ),
    "Cone": ({"radius": 3.0, "height": 4.0}, 24 * np.pi, 12 * np.pi),
    "Capsule": ({"radius": 1.0, "height": 2.0}, 8 * np.pi, 2 * np.pi + 4 / 3 * np.pi),
    "Capsule_1": ({"radiusBottom": 1.0, "radiusTop": 1.0, "height": 2.0}, 8 * np.pi, 2 * np.pi + 4 / 3 * np.pi),
}


def define(build, kind, **values):
    prim = build.stage.DefinePrim("/World/Shape", kind)
    for name, value in values.items():
        prim.GetAttribute(name).Set(value)
    return prim


@pytest.mark.parametrize("kind", SHAPES)
def test_area_and_volume_are_those_of_the_true_shape(build, measure, kind):
    values, area, volume = SHAPES[kind]
    define(build, kind, **values)
    mesh = build.one("/World/Shape")
    assert measure.areas(mesh).sum() == pytest.approx(area, rel=1.5e-3)
    assert measure.volume(mesh) == pytest.approx(volume, rel=2.5e-3)
    # Closed: every edge is met once in each direction.
    edges = np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]], mesh.triangles[:, [2, 0]]])
    forward = {tuple(e) for e in edges.tolist()}
    assert len(forward) == len(edges)
    assert forward == {(b, a) for a, b in forward}


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_the_axis_turns_the_shape_without_mirroring_it(build, measure, kind, axis):
    along = None if kind in ("Cube", "Sphere") else "XYZ".index(axis)
    values, _, volume = SHAPES[kind]
    define(build, kind, **values, **({} if along is None else {"axis": axis}))
    mesh = build.one("/World/Shape")
    assert measure.volume(mesh) == pytest.approx(volume, rel=2.5e-3)
    extent = np.ptp(mesh.points, axis=0)
    if along is not None:
        height = values["height"] + (2 * values.get("radius", 1.0) if kind.startswith("Capsule") else 0.0)
        assert extent[along] == pytest.approx(height)
    if kind in ("Cone", "Cylinder_1"):  # the narrow end points along +axis
        radius = np.linalg.norm(np.delete(mesh.points, along, 1), axis=1)
        top = mesh.points[:, along] > 0
        assert radius[top].max() < radius[~top].max() - 0.5


def test_sphere_normals_are_exact(build):
    define(build, "Sphere", radius=2.0)
    mesh = build.one("/World/Shape")
    np.testing.assert_allclose(mesh.corner_normals, mesh.points[mesh.triangles] / 2.0, atol=1e-6)


def test_cone_normals_stand_on_its_side(build, measure):
    define(build, "Cone", radius=3.0, height=4.0)
    mesh = build.one("/World/Shape")
    side = measure.face_normals(mesh)[:, 2] > -0.5
    # Half opening angle atan(3/4): the normal rises by it.
    np.testing.assert_allclose(mesh.corner_normals[side][..., 2], 0.6, atol=1e-6)
    agreement = np.einsum("tck,tk->tc", mesh.corner_normals, measure.face_normals(mesh))
    assert agreement.min() > np.cos(np.radians(3.0))


@pytest.mark.parametrize(
    ("axis", "normal", "extent"),
    [("X", (1, 0, 0), (0, 3, 2)), ("Y", (0, 1, 0), (2, 0, 3)), ("Z", (0, 0, 1), (2, 3, 0))],
)
def test_plane_lies_as_its_schema_says(build, measure, axis, normal, extent):
    define(build, "Plane", width=2.0, length=3.0, axis=axis)
    mesh = build.one("/World/Shape")
    np.testing.assert_allclose(measure.face_normals(mesh), [normal, normal], atol=1e-12)
    np.testing.assert_allclose(np.ptp(mesh.points, axis=0), extent)
    assert mesh.double_sided


def test_left_handed_gprims_are_seen_from_inside(build, measure):
    prim = define(build, "Sphere", radius=1.0)
    prim.GetAttribute("orientation").Set("leftHanded")
    mesh = build.one("/World/Shape")
    assert measure.volume(mesh) < 0
    np.testing.assert_allclose(mesh.corner_normals, -mesh.points[mesh.triangles], atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        ("Sphere", "radius", 0.0),
        ("Cube", "size", -1.0),
        ("Cone", "height", float("nan")),
        ("Plane", "width", 0.0),
        ("Capsule", "radius", -2.0),
    ],
)
def test_sizes_that_are_not_positive_name_prim_and_attribute(build, kind, name, value):
    define(build, kind, **{name: value})
    with pytest.raises(StageError, match=rf"/World/Shape: {name} is {value}; give the {kind} a positive size"):
        build.read()


def test_unsupported_surfaces_are_listed(build):
    define(build, "BasisCurves")
    build.stage.DefinePrim("/World/Patch", "NurbsPatch")
    notices = [str(n) for n in build.read().notices]
    assert "/World/Shape: a BasisCurves is not supported and not drawn" in notices
    assert "/World/Patch: a NurbsPatch is not supported and not drawn" in notices

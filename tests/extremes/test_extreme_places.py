"""The same picture wherever the scene lies, however large it is and whichever way it is turned."""

from __future__ import annotations

from pathlib import Path

import lit_scenes as lit
import numpy as np
import pytest
from extreme_scenes import METHODS, assert_same, moved, numbers, room
from hypothesis import given, settings
from hypothesis import strategies as st

FEW = settings(max_examples=4, deadline=None, database=None, derandomize=True)


@pytest.mark.parametrize("method", METHODS)
@FEW
@given(exponent=st.one_of(st.sampled_from([-6.0, 6.0]), st.floats(-6.0, 6.0)))
def test_scale_of_the_scene(method, exponent):
    """From a micrometre to a thousand kilometres, to 1e-4 of the mean: the host moves it to volume space in double."""
    usual, other = numbers(room(), method), numbers(moved(room(), 10.0**exponent), method)
    assert_same(other.picture, usual.picture, mean=1e-4)
    assert_same(other.delta, usual.delta, mean=1e-3)
    seen = usual.layers.depth * 10.0**exponent
    np.testing.assert_allclose(other.layers.depth, seen, rtol=1e-4)


@pytest.mark.parametrize("method", METHODS)
@FEW
@given(shift=st.tuples(*[st.sampled_from([-1e7, 0.0, 1e4, 1e7])] * 3))
def test_origin_far_away(method, shift):
    """Up to 10 000 km: 1 % of the mean, most of it from walls that lie in the plane between two voxels and, by one
    rounding of a double, fall to the other. ``P`` is 32-bit, so out there it is good to a metre; ``depth`` is not."""
    usual, other = numbers(room(), method), numbers(moved(room(), shift=shift), method)
    assert_same(other.picture, usual.picture, mean=2e-3)
    assert_same(other.delta, usual.delta, mean=1e-2)
    np.testing.assert_allclose(other.layers.depth, usual.layers.depth, rtol=1e-5)


ENOUGH = {
    "samples": 96,
    "gather.rays": 64,
    "gather.object_rays": 64,
    "shadows.samples": 16,
    "vpls.count": 256,
    "vpls.further": 96,
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("degrees", [45.0, 137.0])
def test_rotation_of_the_stage(method, degrees):
    """About no axis of the volume. Voxels, VPLs and random numbers then fall elsewhere: the picture's mean stays within
    4 %, its pixels within 8 % in the mean (12 % with VPLs)."""
    usual, other = (
        numbers(moved(room(), turn=turn), method, **{"volume.resolution": 64, "volume.coarse": 48, **ENOUGH})
        for turn in (np.eye(3), lit.turned(degrees))
    )
    assert other.picture.mean() == pytest.approx(usual.picture.mean(), rel=0.04)
    assert_same(other.picture, usual.picture, mean=0.12 if method in ("ism", "vpl-rays") else 0.08)


STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = {metres}
    upAxis = "Y"
)
def Xform "World"
{{
    double3 xformOp:translate = ({shift}, {shift}, {shift})
    float3 xformOp:scale = ({scale}, {scale}, {scale})
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    def Mesh "Floor"
    {{
        token primvars:dvct:reality = "real"
        uniform token subdivisionScheme = "none"
        point3f[] points = [(-3, 0, 3), (3, 0, 3), (3, 0, -3), (-3, 0, -3)]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
    }}
    def Cube "Box"
    {{
        double size = 1
        double3 xformOp:translate = (0.2, 0.5, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def SphereLight "Lamp"
    {{
        float inputs:intensity = 300
        float inputs:radius = 0.4
        double3 xformOp:translate = (1.5, 3, 1)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def Camera "Camera"
    {{
        float focalLength = 20
        float horizontalAperture = 20
        float verticalAperture = 15
        double3 xformOp:translate = (0, 1.5, 5)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
}}
"""


FAR_APART = [(1e-6, 1, 0), (1e6, 1, 0), (1, 1e6, 0), (1, 1, 1e7)]
MORE_CHANGES = [(1, 1e-6, 0), (1e-3, 1e3, 0)]


@pytest.mark.parametrize(
    ("method", "metres", "scale", "shift"),
    [(method, *change) for method in ("rays", "vpl-rays", "cones", "ism", "path") for change in FAR_APART]
    + [(method, *change) for method in ("rays", "vpl-rays") for change in MORE_CHANGES],
)
def test_units_and_transforms_of_a_stage(tmp_path: Path, method, metres, scale, shift):
    """``metersPerUnit`` and the root's scale from 1e-6 to 1e6, and its translation by 1e7 m: the same picture."""
    pictures = []
    for number, values in enumerate([(1, 1, 0), (metres, scale, shift)]):
        file = tmp_path / f"{number}.usda"
        file.write_text(STAGE.format(metres=values[0], scale=values[1], shift=values[2]))
        pictures.append(numbers(str(file), method, height=None).picture)
    assert pictures[0].mean() > 0.05
    assert_same(pictures[1], pictures[0], mean=2e-3)

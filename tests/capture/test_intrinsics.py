"""Lenses: OpenCV is the oracle of distortion; the renderer's camera and the pinhole agree."""

from __future__ import annotations

import numpy as np
import pytest

from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.errors import OptionError
from warp_dvct.lens import distort, undistort

FIVE = (0.26, -0.95, -0.005, 0.0026, 1.16)  # of freiburg1 in the TUM benchmark
TWELVE = (0.3, -0.1, 0.001, -0.002, 0.05, 0.2, 0.03, 0.01, 0.002, -0.001, 0.003, 0.0005)


@pytest.mark.parametrize("coefficients", [FIVE, TWELVE], ids=["5", "12"])
def test_projection_is_opencvs(coefficients):
    cv2 = pytest.importorskip("cv2")
    lens = Intrinsics(640, 480, 517.0, 516.0, 318.6, 255.3, coefficients)
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-0.7, 0.7, 200), rng.uniform(-0.5, 0.5, 200), np.ones(200)], -1) * 2.5
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.K, np.array(coefficients))
    np.testing.assert_allclose(lens.project(points), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("coefficients", [(), FIVE, TWELVE], ids=["0", "5", "12"])
def test_rays_project_back_to_their_pixels(coefficients):
    lens = Intrinsics(64, 48, 58.0, 57.0, 30.0, 25.0, coefficients)
    v, u = np.indices((48, 64))
    np.testing.assert_allclose(lens.project(lens.rays()), np.stack([u, v], -1), atol=1e-4)


def test_where_a_lens_folds_back_there_is_no_direction():
    x = np.linspace(0.0, 2.0, 50)
    u, _ = undistort(x, np.zeros(50), (-0.4,))
    found = np.isfinite(u)
    assert found[:10].all()
    assert not found[-1]
    np.testing.assert_allclose(distort(u[found], np.zeros(found.sum()), (-0.4,))[0], x[found], atol=1e-6)


def test_the_scene_camera_sees_pixels_where_the_pinhole_does():
    lens = Intrinsics(64, 48, 58.0, 57.0, 30.0, 25.0)
    camera = lens.scene_camera(np.eye(4))
    back = Intrinsics.of_scene_camera(camera, 64, 48)
    np.testing.assert_allclose(back.K, lens.K, rtol=1e-12)
    # The renderer's ray through the centre of pixel (u, v), as kernels.geometry.camera_ray makes it.
    u, v = 5, 40
    x = camera.tan_left + (camera.tan_right - camera.tan_left) * (u + 0.5) / 64
    y = camera.tan_top + (camera.tan_bottom - camera.tan_top) * (v + 0.5) / 48
    direction = camera.to_world[:3, :3] @ [x, y, -1.0]
    np.testing.assert_allclose(direction, lens.rays()[v, u], atol=1e-12)


@pytest.mark.parametrize("numbers", [(0, 9, 1, 1, 0, 0), (9, 9, -1, 1, 0, 0), (9, 9, 1, np.nan, 0, 0)])
def test_impossible_lenses_are_refused(numbers):
    with pytest.raises(OptionError, match="intrinsics"):
        Intrinsics(*numbers)

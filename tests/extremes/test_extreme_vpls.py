"""A VPL on the shaded point, and as near to it as floats go."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest
import warp as wp
from extreme_scenes import numbers, room

from warp_dvct.launch import Launcher
from warp_dvct.passes.ism import ray_sight
from warp_dvct.passes.vpl_shading import VplLight, light_points
from warp_dvct.passes.vpls import new_vpls

DISTANCES = np.array([0.0, 1e-38, 1e-12, 1e-9, 1e-7, 1e-6, 1e-5, 1e-3, 0.1, 1.0])


def irradiance(launcher: Launcher, spread: float) -> np.ndarray:
    """Of a point that looks up, by a VPL of flux 1 that looks down from each distance alone: ``[distances]``."""
    scene = lit.upload(launcher, lit.scene_of(lit.mesh(lit.rectangle((0.5, -9, 0.5), (1, 0, 0), (0, 0, 1)))))
    points = lit.points_at(launcher, [(0.5, 0.0, 0.5)], [(0.0, 1.0, 0.0)])
    result = []
    for distance in DISTANCES:
        vpls = new_vpls(launcher, 1)
        vpls.position = launcher.array(np.array([[0.5, distance, 0.5]], np.float32), wp.vec3)
        vpls.normal = launcher.array(np.array([[0, -1, 0]], np.float32), wp.vec3)
        vpls.flux = launcher.full(1, wp.vec3(1.0, 1.0, 1.0), wp.vec3)
        vpls.real = launcher.full(1, 1, wp.int32)
        vpls.spread = launcher.full(1, spread, wp.float32)
        source = VplLight(scene, vpls, ray_sight(launcher), 1, True)
        before, after = light_points(launcher, points, 1, source)
        assert (before.numpy() == after.numpy()).all()
        result.append(before.numpy()[0, 0])
    return np.array(result, float)


@pytest.mark.parametrize("spread", [0.0, 1e-6, 0.05])
def test_light_of_a_vpl_at_any_distance(spread):
    """1 / (pi (d² + R²)) beyond the 2e-6 by which rays start off the surface; finite and bounded below that."""
    light = irradiance(Launcher("cpu", 1, check=True), spread)
    assert np.isfinite(light).all()
    assert light.max() <= 1.0 / (np.pi * max(1e-12, spread**2))
    far = DISTANCES >= 1e-3
    np.testing.assert_allclose(light[far], 1.0 / (np.pi * (DISTANCES[far] ** 2 + spread**2)), rtol=5e-3)


@pytest.mark.parametrize("method", ["ism", "vpl-rays"])
def test_points_instead_of_discs_stay_finite(method):
    """``vpls.clamp=0`` makes VPLs points: bright specks near them, but no infinity; the mean is within a half."""
    usual, points = (numbers(room(), method, **{"vpls.clamp": c, "vpls.tiles": 1}).before.mean() for c in (0.5, 0.0))
    assert points == pytest.approx(usual, rel=0.5)

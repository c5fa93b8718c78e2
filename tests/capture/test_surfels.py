"""Unorganised clouds in pictures: seen, shaded and shading by every method as the surface that they were drawn from."""

from __future__ import annotations

from dataclasses import replace

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct.relighter import Relighter
from warp_dvct.scene import Light, LightKind, PointCloud, Role
from warp_dvct.surfels import GROW, surfel_mesh, with_surfels

LIGHT = Light(LightKind.SPHERE, (8.0, 8.0, 8.0), position=(0.5, 0.85, 0.5), radius=0.05)
CENTER, RADIUS = np.array([0.5, 0.35, 0.45]), 0.14


def scanned_ball(count: int = 4000) -> PointCloud:
    """Points at random on a ball; each stands for its share of the area."""
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    radii = np.full(count, np.sqrt(4.0 * RADIUS**2 / count), np.float32)
    return PointCloud(CENTER + RADIUS * normal, normal.astype(np.float32), radii, Role.SYNTHETIC, path="/Scan")


def scenes():
    """The room with the ball as a cloud, and as a mesh."""
    camera = lit.look_at((0.5, 0.5, 0.88), (0.5, 0.35, 0.3), half=0.8, aspect=4 / 3)
    cloud = lit.scene_of(lit.mesh(lit.room()), lights=(LIGHT,), camera=camera)
    mesh = lit.scene_of(
        lit.mesh(lit.room()), lit.mesh(lit.ball(CENTER, RADIUS), Role.SYNTHETIC), lights=(LIGHT,), camera=camera
    )
    return replace(cloud, point_clouds=(scanned_ball(),)), mesh


def test_a_square_has_the_area_and_normal_of_its_disc():
    cloud = scanned_ball(50)
    mesh = surfel_mesh(replace(cloud, colors=np.linspace(0, 1, 150).reshape(50, 3).astype(np.float32)))
    cross = lit.cross_of(mesh.points[mesh.triangles])
    area = 0.5 * np.linalg.norm(cross, axis=-1).reshape(50, 2).sum(-1)
    np.testing.assert_allclose(area, np.pi * (GROW * cloud.radii) ** 2, rtol=1e-5)
    normal = cross / np.linalg.norm(cross, axis=-1, keepdims=True)
    np.testing.assert_allclose(normal[::2], cloud.normals, atol=1e-5)
    np.testing.assert_allclose(mesh.points.reshape(50, 4, 3).mean(1), cloud.points, atol=1e-12)
    assert mesh.corner_colors.shape == (100, 3, 3)
    assert (mesh.corner_colors[7] == mesh.corner_colors[6]).all()


def test_a_scene_without_clouds_stays_as_it_is():
    _, mesh = scenes()
    assert with_surfels(mesh) is mesh


@pytest.mark.parametrize("method", ["delta-cones", "instant-radiosity", "path-trace"])
def test_a_scanned_ball_looks_like_the_ball(method):
    settings = {"samples": 16, "bounces": 1} if method == "path-trace" else {"bounces": 1}
    options = {"width": 80, "height": 60, "quality": "draft", "method": method, "settings": settings}
    cloud, mesh = (Relighter(scene, **options).render() for scene in scenes())
    # Squares stand out by less than their size at the ball's rim.
    assert cloud.mask_synthetic.sum() == pytest.approx(mesh.mask_synthetic.sum(), rel=0.08)
    both = (cloud.mask_synthetic == 1) & (mesh.mask_synthetic == 1)
    assert both.sum() > 0.85 * (mesh.mask_synthetic == 1).sum()
    assert np.median((cloud.normal * mesh.normal).sum(-1)[both]) > 0.99
    lit_by = [layers.rgba[..., :3][both].mean() for layers in (cloud, mesh)]
    assert lit_by[0] == pytest.approx(lit_by[1], rel=0.15)
    shadow = (
        (mesh.delta.mean(-1) < 0.3 * mesh.delta.mean(-1).min())
        & (mesh.mask_synthetic == 0)
        & (cloud.mask_synthetic == 0)
    )
    assert shadow.sum() > 30
    assert cloud.delta[shadow].mean() == pytest.approx(mesh.delta[shadow].mean(), rel=0.25)

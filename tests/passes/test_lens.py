"""A lens that bends: the rendering goes through it, the photograph stays as it is."""

from __future__ import annotations

from dataclasses import replace

import lit_scenes as lit
import numpy as np
import pytest
import warp as wp

from warp_dvct.capture.intrinsics import FLIP, Intrinsics
from warp_dvct.errors import StageError
from warp_dvct.layers import Radiance
from warp_dvct.passes.lens import LensView
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Light, LightKind, Role

BARREL = (-0.25, 0.05, 0.002, -0.003)
CUSHION = (0.05, 0.01)
LIGHT = Light(LightKind.SPHERE, (8.0, 8.0, 8.0), position=(0.5, 0.85, 0.5), radius=0.05)


def scene(distortion=()):
    camera = replace(lit.look_at((0.5, 0.5, 0.85), (0.5, 0.4, 0.3), half=0.9, aspect=4 / 3), distortion=distortion)
    ball = lit.mesh(lit.ball((0.55, 0.3, 0.35), 0.1), Role.SYNTHETIC)
    return lit.scene_of(lit.mesh(lit.room()), ball, lights=(LIGHT,), camera=camera)


@pytest.mark.parametrize("distortion", [BARREL, CUSHION], ids=["barrel", "cushion"])
@pytest.mark.parametrize("method", ["delta-cones", "instant-radiosity", "path-trace"])
def test_every_surface_is_seen_where_opencv_projects_it(method, distortion):
    settings = {"samples": 1} if method == "path-trace" else {"bounces": 1}
    where = scene(distortion)
    layers = Relighter(where, width=80, height=60, method=method, quality="draft", settings=settings).render()
    lens = Intrinsics.of_scene_camera(where.camera, 80, 60)
    inverse = np.linalg.inv(where.camera.to_world @ FLIP)
    pixels = lens.project(layers.position @ inverse[:3, :3].T + inverse[:3, 3])
    v, u = np.indices((60, 80))
    seen = np.isfinite(layers.depth)
    assert seen.mean() > 0.99
    # The nearest pixel of the straight picture is at most 0.71 of its pixels away, which a cushion makes larger.
    assert np.abs(pixels - np.stack([u, v], -1))[seen].max() < 1.0


def test_the_photograph_is_not_resampled():
    plate = np.random.default_rng(0).random((60, 80, 3)).astype(np.float16).astype(np.float32)
    layers = Relighter(scene(BARREL), width=80, height=60, quality="draft").render(plate)
    np.testing.assert_array_equal(layers.plate, plate)
    same = (layers.delta == 0).all(-1) & (layers.mask_synthetic == 0)
    np.testing.assert_array_equal(layers.comp[same], plate[same])
    over = layers.rgba[..., :3] + (1 - layers.rgba[..., 3:]) * (plate * layers.shadow + layers.added)
    np.testing.assert_allclose(layers.comp, over, atol=2e-3)


def test_a_lens_without_coefficients_changes_nothing():
    assert LensView.of(scene((0.0, 0.0)).camera, 80, 60) is None
    almost = Relighter(scene((1e-9,)), width=80, height=60, quality="draft").render()
    straight = Relighter(scene(), width=80, height=60, quality="draft").render()
    np.testing.assert_allclose(almost.depth, straight.depth, rtol=1e-4)
    assert almost.mask_synthetic.sum() == pytest.approx(straight.mask_synthetic.sum(), rel=0.02)
    assert np.abs(almost.comp - straight.comp).mean() < 0.02


def test_resampling_is_its_twin(launcher):
    """Bilinear means and nearest surfaces in NumPy."""
    view = LensView.of(scene(BARREL).camera, 24, 18)
    assert view is not None
    rng = np.random.default_rng(1)
    count = view.drawn_width * view.drawn_height

    def random(width):
        return rng.random((count, width) if width > 1 else count).astype(np.float32)

    names = {"delta": 3, "synthetic": 4, "mask_real": 1, "albedo": 3, "normal": 3, "position": 3, "depth": 1}
    kinds = {1: wp.float32, 3: wp.vec3, 4: wp.vec4}
    host = {name: random(width) for name, width in names.items()}
    arrays = {name: launcher.array(host[name], kinds[width]) for name, width in names.items()}
    bent = view.bend(launcher, Radiance(view.drawn_width, view.drawn_height, before=None, **arrays))
    assert bent.before is None
    x, y = view.place.astype(np.float32).astype(np.float64).T
    assert x.min() >= 0.0
    for name in names:
        image = host[name].reshape(view.drawn_height, view.drawn_width, -1).astype(np.float64)
        if name in ("delta", "synthetic", "mask_real"):
            i, j = np.floor(x).astype(int), np.floor(y).astype(int)
            a, b = (x - i)[:, None], (y - j)[:, None]
            top = image[j, i] * (1 - a) + image[j, i + 1] * a
            expected = top * (1 - b) + (image[j + 1, i] * (1 - a) + image[j + 1, i + 1] * a) * b
        else:
            expected = image[np.floor(y + 0.5).astype(int), np.floor(x + 0.5).astype(int)]
        np.testing.assert_allclose(getattr(bent, name).numpy().reshape(expected.shape), expected, rtol=2e-5, atol=2e-6)


def test_a_fish_eye_is_refused():
    with pytest.raises(StageError, match="fish-eye"):
        LensView.of(scene((0.1, 0.0, 0.0, 0.0, 0.0, 0.5)).camera, 80, 60)

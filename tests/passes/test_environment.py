"""The prefiltered dome: energy through rotation and filtering, directions, roles."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct.passes.environment import build_environment
from warp_dvct.scene import Light, LightKind, LightRole

Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # a quarter turn about x: what stages with upAxis Z have
ABOUT_Y = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])


def band(height: int) -> np.ndarray:
    """Solid angle of the texels per row of a lat-long map twice as wide as high."""
    edges = np.cos(np.linspace(0, np.pi, height + 1))
    return (edges[:-1] - edges[1:])[:, None, None] * np.pi / height


def levels(env, name="before") -> list[np.ndarray]:
    texels, starts = getattr(env, name).numpy().astype(float), env.level_first.numpy()
    sizes = [(max(env.height >> k, 1), max(env.width >> k, 1)) for k in range(env.levels)]
    return [texels[a : a + h * w].reshape(h, w, 3) for a, (h, w) in zip(starts, sizes, strict=True)]


def dome(**more) -> Light:
    return Light(LightKind.DOME, more.pop("radiance", (1.0, 1.0, 1.0)), **more)


def power(image) -> np.ndarray:
    return (image * band(image.shape[0])).sum((0, 1)) * 2 * image.shape[0] / image.shape[1]


@pytest.mark.parametrize("rotation", [np.eye(3), ABOUT_Y, Z_UP, lit.turned(37.0)], ids=["none", "y", "z-up", "tilted"])
def test_a_sun_of_one_texel_keeps_its_energy(launcher, rotation):
    """Wherever it is and however the dome is turned: within 6 %, and 2 % on average, of what its texel sends."""
    rng = np.random.default_rng(0)
    kept = []
    for _ in range(8):
        texture = np.zeros((64, 128, 3), np.float32)
        y, x = rng.integers(6, 58), rng.integers(0, 128)
        texture[y, x] = (100.0, 200.0, 300.0)
        env = build_environment(launcher, (dome(texture=texture, rotation=rotation),))
        kept.append(power(levels(env)[0]) / power(texture.astype(float)))
    np.testing.assert_allclose(kept, 1.0, atol=0.06)
    assert np.mean(kept) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("rotation", [np.eye(3), ABOUT_Y, Z_UP, lit.turned(37.0)], ids=["none", "y", "z-up", "tilted"])
def test_the_sun_stays_where_it_shines_from(launcher, rotation):
    """Image centre = +Z, a quarter in from the left = +X, top = +Y, in the dome's space; then turned to the world."""
    for (y, x), local in (((32, 64), (0, 0, 1)), ((32, 32), (1, 0, 0)), ((1, 5), (0, 1, 0)), ((32, 0), (0, 0, -1))):
        texture = np.zeros((64, 128, 3), np.float32)
        texture[max(y - 1, 0) : y + 1, np.arange(x - 1, x + 1) % 128] = 1.0
        if y < 8:
            texture[:2] = 1.0
        image = levels(build_environment(launcher, (dome(texture=texture, rotation=rotation),)))[0]
        theta = (np.arange(64) + 0.5) / 64 * np.pi
        phi = (0.5 - (np.arange(128) + 0.5) / 128) * 2 * np.pi
        sin = np.sin(theta)[:, None]
        directions = np.stack([sin * np.sin(phi), np.cos(theta)[:, None] + 0 * phi, sin * np.cos(phi)], -1)
        mean = (image[..., :1] * band(64) * directions).sum((0, 1))
        np.testing.assert_allclose(mean / np.linalg.norm(mean), rotation @ local, atol=0.03)


def test_every_level_keeps_the_mean_radiance(launcher):
    texture = np.random.default_rng(1).lognormal(0, 2, (32, 64, 3)).astype(np.float32)
    chain = levels(build_environment(launcher, (dome(texture=texture, radiance=(1.0, 2.0, 3.0)),)))
    assert chain[0].shape == (32, 64, 3)
    assert chain[-1].shape[0] == 1
    for image in chain:
        np.testing.assert_allclose(power(image), power(texture * [1.0, 2.0, 3.0]), rtol=1e-4)


def test_domes_add_up_and_added_ones_are_in_after_alone(launcher):
    env = build_environment(
        launcher,
        (dome(radiance=(1, 2, 3)), dome(radiance=(10, 10, 10), role=LightRole.ADDED), dome(radiance=(4, 4, 4))),
    )
    np.testing.assert_allclose(env.before.numpy(), np.broadcast_to([5, 6, 7], (*env.before.shape, 3)), rtol=1e-6)
    np.testing.assert_allclose(env.after.numpy(), np.broadcast_to([15, 16, 17], (*env.after.shape, 3)), rtol=1e-6)


def test_large_and_odd_textures(launcher):
    """They are averaged to at most 1024 texels, and any size works."""
    for height, width in ((3, 5), (1, 1), (17, 100), (700, 1400)):
        texture = np.random.default_rng(2).uniform(0.5, 1.5, (height, width, 3)).astype(np.float32)
        chain = levels(build_environment(launcher, (dome(texture=texture, rotation=Z_UP),)))
        assert chain[0].shape[1] <= 1024
        np.testing.assert_allclose(power(chain[0]), power(texture), rtol=0.1)
        assert np.isfinite(chain[-1]).all()


def test_no_dome_has_no_levels(launcher):
    assert build_environment(launcher, (Light(LightKind.POINT, (1, 1, 1)),)).levels == 0

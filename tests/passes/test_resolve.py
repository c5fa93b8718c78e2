"""G-buffer and resolve: what pixels see, anti-aliased coverage, and the layers in world space."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct.device_scene import DeviceScene
from warp_dvct.passes.environment import build_environment
from warp_dvct.passes.gbuffer import render_gbuffer
from warp_dvct.passes.resolve import resolve
from warp_dvct.scene import Camera, Light, LightKind, Material, Role

SKY = np.array([4.0, 5.0, 6.0])


def facing(half=0.5, aspect=1.0) -> Camera:
    """Looks along -z from (0, 0, 1): the plane z = 0 fills ``half`` to each side of the picture's middle."""
    return lit.look_at((0, 0, 1), (0, 0, 0), half=half, aspect=aspect)


def resolved(
    launcher, scene, width, height, *, samples, light=1.0, before=10.0, behind=20.0, origin=(0, 0, 0), scale=1.0
):
    """Resolve constant values at the shading points: ``light``, ``before``, and ``behind`` synthetic ones."""
    device_scene = DeviceScene.upload(launcher, scene, np.array(origin, float), scale)
    buffer = render_gbuffer(launcher, device_scene, width, height, edge_samples=samples, behind=True)

    def constant(value, count):
        return lit.launcher_vectors(launcher, np.full((max(1, count), 3), value))

    radiance = resolve(
        launcher,
        device_scene,
        buffer,
        build_environment(launcher, scene.lights),
        light=constant(light, buffer.count),
        before=constant(before, buffer.count),
        behind_before=constant(behind, buffer.behind_count),
        with_before=True,
    )
    shape = (height, width, -1)
    names = ("before", "delta", "synthetic", "albedo", "normal", "position")
    out = {n: getattr(radiance, n).numpy().reshape(shape).astype(float) for n in names}
    return out | {
        n: getattr(radiance, n).numpy().reshape(height, width).astype(float) for n in ("depth", "mask_real")
    }, buffer


def half_plane(angle: float, offset: float, role=Role.SYNTHETIC, size=4.0):
    """The half of the plane z = 0 below a line turned by ``angle``, ``offset`` along its normal."""
    along, across = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
    return lit.mesh(lit.rectangle(across * (offset - size), along * size, across * size), role), across


def covered(across, offset, width, height) -> np.ndarray:
    """Share of each pixel below the line, by 64 x 64 places in it."""
    fine = (np.arange(64) + 0.5) / 64
    x = (np.arange(width)[:, None] + fine).ravel() / width - 0.5
    y = 0.5 - (np.arange(height)[:, None] + fine).ravel() / height
    below = across[0] * x[None, :] + across[1] * y[:, None] < offset
    return below.reshape(height, 64, width, 64).mean((1, 3))


@pytest.mark.parametrize("samples", [4, 16, 64])
@pytest.mark.parametrize("angle", [0.0, 0.35, 2.0])
def test_coverage_of_a_half_plane(launcher, samples, angle):
    """Every pixel is within 1.3 / sqrt(samples) / 2 of the area that is covered, all together within 1 %."""
    mesh, across = half_plane(angle, 0.013)
    out, buffer = resolved(launcher, lit.scene_of(mesh, camera=facing()), 32, 32, samples=samples)
    expected = covered(across, 0.013, 32, 32)
    error = out["synthetic"][..., 3] - expected
    assert np.abs(error).max() < 0.65 / np.sqrt(samples)
    assert abs(error.mean()) < 0.01 / np.sqrt(samples)
    edge = (expected > 0) & (expected < 1)
    assert np.sqrt((error[edge] ** 2).mean()) < 0.6 / samples**0.75
    assert buffer.count < 32 * 32 + samples * 32 * 7, "only the edge's pixels and their neighbours are sampled more"
    assert not out["mask_real"].any()


def test_no_antialiasing_is_the_pixels_centre(launcher):
    mesh, across = half_plane(0.35, 0.013)
    out, buffer = resolved(launcher, lit.scene_of(mesh, camera=facing()), 24, 24, samples=0)
    assert buffer.count == 24 * 24
    x = (np.arange(24) + 0.5) / 24 - 0.5
    below = across[0] * x[None, :] - across[1] * x[:, None] < 0.013
    np.testing.assert_array_equal(out["synthetic"][..., 3], below)


def test_delta_synthetic_and_before_share_a_pixel(launcher):
    """A synthetic half plane before a real wall before the sky: each part of a pixel weighs by its coverage."""
    near, _ = half_plane(0.35, -0.05)
    wall = lit.mesh(lit.rectangle((0, 0.6, -0.2), (4, 0, 0), (0, 1, 0)))  # above y = -.4
    sky = Light(LightKind.DOME, tuple(SKY))
    scene = lit.scene_of(wall, near, lights=(sky,), camera=facing())
    out, _ = resolved(launcher, scene, 32, 32, samples=16)
    alpha, real = out["synthetic"][..., 3], out["mask_real"]
    assert ((alpha > 0) & (real > 0)).any()
    np.testing.assert_allclose(out["synthetic"][..., :3], np.repeat(alpha[..., None], 3, -1), atol=1e-6)
    np.testing.assert_allclose(out["delta"], np.repeat(real[..., None], 3, -1), atol=1e-6)
    assert (alpha + real <= 1 + 1e-6).all()
    # Behind the object: the wall where it is there, else the sky.
    y = 0.5 - (np.arange(32) + 0.5) / 32
    wall_there = y * 1.2 > -0.4 + 0.03
    sky_there = y * 1.2 < -0.4 - 0.03
    inside = alpha == 1
    hidden_wall, hidden_sky = inside & wall_there[:, None], inside & sky_there[:, None]
    assert hidden_wall.any()
    assert hidden_sky.any()
    np.testing.assert_allclose(out["before"][hidden_wall], 20.0)
    np.testing.assert_allclose(out["before"][hidden_sky], np.broadcast_to(SKY, (hidden_sky.sum(), 3)), rtol=1e-5)
    clear = (real == 1) & wall_there[:, None]
    np.testing.assert_allclose(out["before"][clear], 10.0)
    mixed = (alpha > 0) & (alpha < 1) & wall_there[:, None]
    expected = 20 * alpha + 10 * real
    np.testing.assert_allclose(out["before"][mixed][:, 0], expected[mixed], rtol=1e-5)


@pytest.mark.parametrize(("origin", "scale"), [((0, 0, 0), 1.0), ((3.0, -7.0, 11.0), 0.02), ((-40.0, 2.0, 0.5), 50.0)])
def test_layers_are_in_world_space_and_metres(launcher, origin, scale):
    """Whatever volume space is: a slanted plane's position, normal, albedo and depth at the pixels' centres."""
    materials = [Material(base_color=(0.25, 0.5, 0.75), ior=1.0)]
    tilt = np.array([0.0, np.sin(0.5), np.cos(0.5)])
    plane = lit.rectangle((0, 0, -2), (9, 0, 0), 9 * np.cross(tilt, [1, 0, 0]))
    camera = Camera(facing().to_world, -0.7, 0.3, -0.2, 0.5)
    out, _ = resolved(
        launcher,
        lit.scene_of(lit.mesh(plane), materials=materials, camera=camera),
        20,
        14,
        samples=0,
        origin=origin,
        scale=scale,
    )
    x = -0.7 + (np.arange(20) + 0.5) / 20
    y = 0.5 - (np.arange(14) + 0.5) / 14 * 0.7
    ray = np.stack([*np.meshgrid(x, y), np.full((14, 20), -1.0)], -1)
    eye = np.array([0, 0, 1.0])
    t = ((np.array([0, 0, -2]) - eye) @ tilt) / (ray @ tilt)
    np.testing.assert_allclose(out["position"], eye + t[..., None] * ray, atol=2e-5)
    np.testing.assert_allclose(out["depth"], t, rtol=2e-5)
    np.testing.assert_allclose(out["normal"], np.broadcast_to(tilt, (14, 20, 3)), atol=1e-5)
    np.testing.assert_allclose(out["albedo"], np.broadcast_to([0.25, 0.5, 0.75], (14, 20, 3)), rtol=1e-6)
    assert (out["mask_real"] == 1).all()


def test_background_has_no_surface(launcher):
    out, _ = resolved(launcher, lit.scene_of(lit.mesh(lit.ball((0, 0, 0), 0.2)), camera=facing()), 20, 20, samples=4)
    empty = out["depth"] == np.inf
    assert empty[0, 0]
    assert not empty[10, 10]
    for name in ("albedo", "normal", "position", "delta"):
        assert not out[name][0, 0].any(), name
    assert out["depth"][10, 10] == pytest.approx(0.8, abs=0.01)


def test_clipping_range_is_kept(launcher):
    """Surfaces nearer than near or beyond far are not seen; neither are they behind an object."""
    walls = [lit.mesh(lit.rectangle((0, 0, z), (4, 0, 0), (0, 4, 0))) for z in (0.9, 0.0, -3.0)]
    base = facing()
    camera = Camera(base.to_world, -0.5, 0.5, -0.5, 0.5, near=0.5, far=2.0)
    out, _ = resolved(launcher, lit.scene_of(*walls, camera=camera), 6, 6, samples=0)
    np.testing.assert_allclose(out["depth"], 1.0, rtol=1e-5)
    out, _ = resolved(launcher, lit.scene_of(walls[0], walls[2], camera=camera), 6, 6, samples=0)
    assert (out["depth"] == np.inf).all()
    inserted = lit.mesh(lit.rectangle((0, 0, 0), (4, 0, 0), (0, 4, 0)), Role.SYNTHETIC)
    for far, before in ((2.0, 0.0), (5.0, 20.0)):
        camera = Camera(base.to_world, -0.5, 0.5, -0.5, 0.5, near=0.5, far=far)
        out, _ = resolved(launcher, lit.scene_of(inserted, walls[2], camera=camera), 6, 6, samples=0)
        np.testing.assert_array_equal(out["before"], before)


def test_edges_of_colour_and_crease_are_found(launcher):
    """Two walls that meet, and two colours on one: their pixels get more points; a flat wall gets none."""
    flat = lit.scene_of(lit.mesh(lit.rectangle((0, 0, 0), (4, 0, 0), (0, 4, 0))), camera=facing())
    assert resolved(launcher, flat, 16, 16, samples=4)[1].count == 256
    materials = [Material(base_color=c, ior=1.0) for c in ((0.1, 0.1, 0.1), (0.9, 0.9, 0.9))]
    halves = [lit.mesh(lit.rectangle((x, 0, 0), (2, 0, 0), (0, 4, 0)), material=k) for k, x in enumerate((-2, 2))]
    _, buffer = resolved(launcher, lit.scene_of(*halves, materials=materials, camera=facing()), 16, 16, samples=4)
    assert buffer.count == 256 + 4 * 2 * 16
    roof = [lit.rectangle((s * 0.5, 0, -0.4), (0.5, 0, -s * 0.5), (0, 4, 0)) for s in (1, -1)]
    _, buffer = resolved(launcher, lit.scene_of(*map(lit.mesh, roof), camera=facing(0.3)), 16, 16, samples=4)
    assert buffer.count >= 256 + 4 * 2 * 16


def test_objects_behind_real_surfaces_are_not_seen(launcher):
    wall = lit.mesh(lit.rectangle((0, 0, 0), (4, 0, 0), (0, 4, 0)))
    hidden = lit.mesh(lit.ball((0, 0, -1), 0.3), Role.SYNTHETIC)
    out, buffer = resolved(launcher, lit.scene_of(wall, hidden, camera=facing()), 12, 12, samples=4)
    assert not out["synthetic"].any()
    assert buffer.behind_count == 0
    assert (out["mask_real"] == 1).all()

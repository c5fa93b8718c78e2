"""Light sampling: closed forms of irradiance, densities that integrate to 1, MIS consistency, domes and spots."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from warp_dvct.device_scene import upload_lights
from warp_dvct.errors import StageError
from warp_dvct.kernels.lights import Lights, dome_radiance, light_along_ray, sample_light
from warp_dvct.kernels.sampling import sobol2
from warp_dvct.scene import Light, LightKind, LightRole

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SAMPLES = 4096
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])  # a rotation


@wp.kernel
def _sample_light(
    first: int,
    lights: Lights,
    light: int,
    position: wp.vec3,
    direction_out: wp.array(dtype=wp.vec3),
    value_out: wp.array(dtype=wp.vec3),
    scalars_out: wp.array(dtype=wp.vec2),
    met_radiance_out: wp.array(dtype=wp.vec3),
    met_scalars_out: wp.array(dtype=wp.vec2),
):
    i = first + wp.tid()
    s = sample_light(lights, light, position, sobol2(0, light, i, 0))
    direction_out[i] = s.direction
    value_out[i] = s.value
    scalars_out[i] = wp.vec2(s.distance, s.pdf)
    met = light_along_ray(lights, light, position, s.direction)
    met_radiance_out[i] = met.radiance
    met_scalars_out[i] = wp.vec2(met.distance, met.pdf)


@wp.kernel
def _meet_light(
    first: int,
    lights: Lights,
    light: int,
    position: wp.vec3,
    direction_in: wp.array(dtype=wp.vec3),
    radiance_out: wp.array(dtype=wp.vec3),
    scalars_out: wp.array(dtype=wp.vec2),
    plate_out: wp.array(dtype=wp.vec3),
    all_out: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    met = light_along_ray(lights, light, position, direction_in[i])
    radiance_out[i] = met.radiance
    scalars_out[i] = wp.vec2(met.distance, met.pdf)
    plate_out[i] = dome_radiance(lights, direction_in[i], 0)
    all_out[i] = dome_radiance(lights, direction_in[i], 1)


def upload(launcher, *lights, origin=(0, 0, 0), scale=1.0):
    return upload_lights(launcher, lights, np.array(origin, float), scale)


def sample(launcher, lights, position=(0, 0, 0), index=0, count=SAMPLES):
    """direction, value, (distance, pdf), and the radiance and (distance, pdf) met along the sampled direction."""
    out = [launcher.empty(count, t) for t in (wp.vec3, wp.vec3, wp.vec2, wp.vec3, wp.vec2)]
    launcher.launch(_sample_light, count, [lights, index, wp.vec3(*position)], out)
    return [o.numpy().astype(np.float64) for o in out]


def meet(launcher, lights, directions, position=(0, 0, 0), index=0):
    count = len(directions)
    out = [launcher.empty(count, t) for t in (wp.vec3, wp.vec2, wp.vec3, wp.vec3)]
    rays = launcher.array(np.asarray(directions, np.float32), wp.vec3)
    launcher.launch(_meet_light, count, [lights, index, wp.vec3(*position), rays], out)
    return [o.numpy().astype(np.float64) for o in out]


def irradiance(launcher, light, normal=(0, 1, 0), count=SAMPLES):
    """Sampled estimate of the irradiance at the origin."""
    direction, value, *_ = sample(launcher, upload(launcher, light), count=count)
    return (value * np.maximum(direction @ np.array(normal, float), 0)[:, None]).mean(0)


def sphere_grid(n=1024):
    """Directions of equal solid angle over the sphere; its poles lie off every light's axis."""
    u = (np.arange(n) + 0.5) / n
    y, phi = np.meshgrid(2 * u - 1, 2 * np.pi * u, indexing="ij")
    r = np.sqrt(1 - y * y)
    return np.stack([r * np.cos(phi), y, r * np.sin(phi)], -1).reshape(-1, 3) @ TURN.T


L = (2.0, 3.0, 4.0)
RECT = Light(LightKind.RECT, L, position=(0, 2, 0), axis_x=(0.5, 0, 0), axis_y=(0, 0, 0.8), direction=(0, -1, 0))
DISK = replace(RECT, kind=LightKind.DISK, axis_x=(0.6, 0, 0), axis_y=(0, 0, 0.6))
SPHERE = Light(LightKind.SPHERE, L, position=(0.3, 2, 0.4), radius=0.5)
POINT = Light(LightKind.POINT, L, position=(0.3, 2, 0.4))
DISTANT = Light(LightKind.DISTANT, L, direction=(0, -1, 0), angle=0.3)
DOME = Light(LightKind.DOME, L)
SKEWED = replace(RECT, axis_y=(0.3, 0, 0.8))


def picture(height=16, width=32, seed=0):
    """A dome texture with strong contrast and a black part."""
    pixels = np.random.default_rng(seed).random((height, width, 3)) ** 6
    pixels[3, 5] = 40
    pixels[10:, 8:20] = 0
    return pixels.astype(np.float32)


PICTURE = Light(LightKind.DOME, (1.0, 2.0, 0.5), texture=picture(), rotation=TURN)
EXTENDED = {
    "rect": RECT,
    "skewed rect": SKEWED,
    "disk": DISK,
    "sphere": SPHERE,
    "distant": DISTANT,
    "dome": DOME,
    "picture": PICTURE,
}


def test_inverse_square_law_of_a_point(launcher):
    r2 = 0.3**2 + 2**2 + 0.4**2
    np.testing.assert_allclose(irradiance(launcher, POINT, count=1), np.array(L) / r2 * 2 / np.sqrt(r2), rtol=1e-5)
    # Three times as far: a ninth, at the same angle.
    far = replace(POINT, position=(0.9, 6, 1.2))
    np.testing.assert_allclose(irradiance(launcher, far, count=1) * 9, irradiance(launcher, POINT, count=1), rtol=1e-5)


def test_disk_form_factor(launcher):
    np.testing.assert_allclose(irradiance(launcher, DISK), np.pi * np.array(L) * 0.36 / (0.36 + 4), rtol=1e-3)


def test_rectangle_form_factor(launcher):
    x, y = 0.5 / 2, 0.8 / 2
    a, b = np.sqrt(1 + x * x), np.sqrt(1 + y * y)
    corner = (x / a * np.arctan(y / a) + y / b * np.arctan(x / b)) / (2 * np.pi)
    np.testing.assert_allclose(irradiance(launcher, RECT), np.pi * np.array(L) * 4 * corner, rtol=1e-3)


def test_sphere_and_its_tiny_and_huge_forms(launcher):
    for radius in (1.9, 0.5, 1e-3):
        light = replace(SPHERE, radius=radius)
        r2 = 0.3**2 + 2**2 + 0.4**2
        towards = np.array(light.position) / np.sqrt(r2)
        expected = np.pi * np.array(L) * radius**2 / r2  # facing it; a huge one stays above the horizon
        np.testing.assert_allclose(irradiance(launcher, light, towards), expected, rtol=2e-3)


def test_distant_disc_and_direction(launcher):
    np.testing.assert_allclose(irradiance(launcher, DISTANT), np.pi * np.array(L) * np.sin(0.15) ** 2, rtol=1e-3)
    sun = replace(DISTANT, angle=np.radians(0.53))
    np.testing.assert_allclose(
        irradiance(launcher, sun), np.pi * np.array(L) * np.sin(np.radians(0.265)) ** 2, rtol=1e-3
    )
    np.testing.assert_allclose(irradiance(launcher, replace(DISTANT, angle=0.0), count=1), L, rtol=1e-6)


def test_uniform_dome(launcher):
    np.testing.assert_allclose(irradiance(launcher, DOME), np.pi * np.array(L), rtol=2e-3)


@pytest.mark.parametrize("name", EXTENDED)
def test_densities_integrate_to_one_and_radiance_to_irradiance(launcher, name):
    light = EXTENDED[name]
    directions = sphere_grid()
    lights = upload(launcher, light)
    radiance, scalars, _, _ = meet(launcher, lights, directions)
    assert scalars[:, 1].mean() * 4 * np.pi == pytest.approx(1.0, abs=0.01)
    normal = np.array([0.36, 0.8, 0.48])
    expected = (radiance * np.maximum(directions @ normal, 0)[:, None]).mean(0) * 4 * np.pi
    np.testing.assert_allclose(irradiance(launcher, light, normal, 1 << 16), expected, rtol=0.01)


@pytest.mark.parametrize("name", EXTENDED)
def test_a_ray_along_a_sampled_direction_meets_what_was_sampled(launcher, name):
    direction, value, scalars, met, met_scalars = sample(launcher, upload(launcher, EXTENDED[name]))
    assert np.linalg.norm(direction, axis=1) == pytest.approx(1.0, abs=1e-5)
    found = met_scalars[:, 1] > 0
    assert found.mean() > 0.995  # rounding loses a few at the rim
    if name == "picture":  # a direction on a texel's border may be looked up on its other side
        found &= np.isclose(met_scalars[:, 1], scalars[:, 1], rtol=1e-3)
        assert found.mean() > 0.99
    np.testing.assert_allclose(met_scalars[found], scalars[found], rtol=2e-3)
    np.testing.assert_allclose(value[found] * scalars[found, 1:], met[found], rtol=2e-3, atol=1e-5)


def test_volume_space_leaves_irradiance_alone(launcher):
    """Points move, distances and intensities scale; what a surface receives stays."""
    origin, scale = np.array([5.0, -3.0, 2.0]), 0.02
    for light in (POINT, SPHERE, RECT, DISK, DISTANT, DOME, PICTURE):
        moved = upload(launcher, light, origin=origin, scale=scale)
        direction, value, scalars, *_ = sample(launcher, moved, -origin * scale)
        here = sample(launcher, upload(launcher, light))
        np.testing.assert_allclose(direction, here[0], atol=2e-5)
        np.testing.assert_allclose(value, here[1], rtol=2e-3, atol=1e-4)
        finite = here[2][:, 0] < 1e17
        np.testing.assert_allclose(scalars[finite, 0] / scale, here[2][finite, 0], rtol=1e-4)


def test_planar_lights_emit_on_one_side_and_spheres_outwards(launcher):
    for light in (RECT, DISK):
        behind = upload(launcher, replace(light, direction=(0, 1, 0)))
        _, value, _, met, _ = sample(launcher, behind)
        assert not value.any()
        assert not met.any()
        assert not meet(launcher, behind, sphere_grid(64))[0].any()
    inside = upload(launcher, replace(SPHERE, position=(0.1, 0, 0)))
    assert not sample(launcher, inside)[1].any()
    assert not meet(launcher, inside, sphere_grid(64))[0].any()


def test_a_spot_fades_as_a_smoothstep_of_the_angle(launcher):
    for light in (POINT, replace(SPHERE, radius=1e-3)):
        spot = replace(light, position=(0, 0, 0), direction=(0, 0, -1), cone_angle=0.6, cone_softness=0.4)
        lights, plain = upload(launcher, spot), upload(launcher, replace(spot, cone_angle=np.pi))
        for angle in (0.0, 0.2, 0.35, 0.4, 0.5, 0.59, 0.61, 1.0, 3.0):
            at = (2 * np.sin(angle), 0, -2 * np.cos(angle))
            x = np.clip((angle - 0.36) / 0.24, 0, 1)
            share = 1 - x * x * (3 - 2 * x)
            value = [sample(launcher, which, at, count=16)[1].mean(0) for which in (lights, plain)]
            np.testing.assert_allclose(value[0], value[1] * share, rtol=2e-3, atol=2e-4 * value[1].max())
    hard = upload(launcher, replace(POINT, position=(0, 0, 0), direction=(0, 0, -1), cone_angle=0.6))
    assert sample(launcher, hard, (np.sin(0.599), 0, -np.cos(0.599)), count=1)[1].all()
    assert not sample(launcher, hard, (np.sin(0.601), 0, -np.cos(0.601)), count=1)[1].any()


def test_a_lat_long_dome_is_turned_as_usdlux_says(launcher):
    """Image centre = +Z, a quarter in from the left = +X, top = +Y; then the light's rotation."""
    height, width = 64, 128
    axes = {(0, 0, 1): (32, 64), (1, 0, 0): (32, 32), (-1, 0, 0): (32, 96), (0, 1, 0): (0, 5), (0, -1, 0): (63, 5)}
    for axis, (row, column) in axes.items():
        pixels = np.zeros((height, width, 3), np.float32)
        if row in (0, 63):
            pixels[row] = 1.0
        else:
            pixels[row - 1 : row + 1, column - 1 : column + 1] = 1.0
        for turn in (np.eye(3), TURN):
            lights = upload(launcher, Light(LightKind.DOME, L, texture=pixels, rotation=turn))
            np.testing.assert_allclose(meet(launcher, lights, [turn @ axis])[0][0], L, rtol=0.05)
            direction, value, _, _, _ = sample(launcher, lights)
            mean = (direction * value[:, :1]).mean(0)
            np.testing.assert_allclose(mean / np.linalg.norm(mean), turn @ axis, atol=0.02)


def test_dome_samples_follow_the_texture(launcher):
    """Chi-square over the texels of the counts against the stated density."""
    lights = upload(launcher, replace(PICTURE, rotation=np.eye(3)))
    direction, _, scalars, _, _ = sample(launcher, lights, count=1 << 16)
    height, width = 16, 32
    u = (0.5 - np.arctan2(direction[:, 0], direction[:, 2]) / (2 * np.pi)) % 1
    row = np.clip((np.arccos(np.clip(direction[:, 1], -1, 1)) / np.pi * height).astype(int), 0, height - 1)
    column = (u * width).astype(int) % width
    counts = np.bincount(row * width + column, minlength=height * width)
    centre_row, centre_column = np.divmod(np.arange(height * width), width)
    theta, phi = (centre_row + 0.5) * np.pi / height, (0.5 - (centre_column + 0.5) / width) * 2 * np.pi
    centres = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], -1)
    pdf = meet(launcher, lights, centres)[1][:, 1]
    solid_angle = 2 * np.pi / width * (np.cos(centre_row * np.pi / height) - np.cos((centre_row + 1) * np.pi / height))
    expected = pdf * solid_angle * (1 << 16)
    assert expected.sum() == pytest.approx(1 << 16, rel=1e-4)
    assert not counts[expected == 0].any()
    used = expected > 5
    chi2 = ((counts[used] - expected[used]) ** 2 / expected[used]).sum()
    assert chi2 < used.sum() + 4 * np.sqrt(2 * used.sum())  # stratified samples lie far below
    assert scalars[:, 1].min() > 0


def test_the_background_leaves_added_domes_out_when_asked(launcher):
    added = replace(DOME, radiance=(1.0, 0.0, 0.5), role=LightRole.ADDED)
    _, _, plate, everything = meet(launcher, upload(launcher, POINT, DOME, added, PICTURE), [(0, 1, 0)], index=1)
    picture_there = meet(launcher, upload(launcher, PICTURE), [(0, 1, 0)])[0]
    np.testing.assert_allclose(plate, picture_there + L, rtol=1e-6)
    np.testing.assert_allclose(everything, picture_there + L + (1.0, 0.0, 0.5), rtol=1e-6)


def test_a_black_dome_gives_nothing_and_breaks_nothing(launcher):
    black = replace(PICTURE, texture=np.zeros((4, 8, 3), np.float32))
    direction, value, scalars, _, _ = sample(launcher, upload(launcher, black))
    assert not value.any()
    assert np.isfinite(direction).all()
    assert (scalars[:, 1] > 0).all()


def test_lights_without_area_or_direction_are_named(launcher):
    with pytest.raises(StageError, match=r"/L/Flat: the light has no area"):
        upload(launcher, replace(RECT, axis_x=(0, 0, 0), path="/L/Flat"))
    with pytest.raises(StageError, match=r"/L/Flat: the light's direction .* does not say which side"):
        upload(launcher, replace(RECT, direction=RECT.axis_x, path="/L/Flat"))
    with pytest.raises(StageError, match=r"/L/Sun: the light's direction"):
        upload(launcher, replace(DISTANT, direction=(0, 0, 0), path="/L/Sun"))

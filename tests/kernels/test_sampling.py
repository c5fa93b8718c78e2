"""Random numbers, Sobol' points and warps of the unit square, against their defining properties."""

import numpy as np
import pytest
import warp as wp

from warp_dvct.kernels.sampling import (
    concentric_disk,
    cosine_hemisphere,
    from_frame,
    reverse_bits,
    sobol1,
    sobol2,
    sobol_second_reversed,
    uniform1,
    uniform2,
    uniform_cone,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def _draw_numbers(
    first: int,
    seed: int,
    dimension: int,
    samples: int,
    independent_out: wp.array(dtype=wp.vec3),
    sobol_out: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    u = uniform2(seed, i // samples, i % samples, dimension)
    s = sobol2(seed, i // samples, i % samples, dimension)
    independent_out[i] = wp.vec3(u[0], u[1], uniform1(seed, i // samples, i % samples, dimension))
    sobol_out[i] = wp.vec3(s[0], s[1], sobol1(seed, i // samples, i % samples, dimension))


@wp.kernel
def _map_square(
    first: int,
    xi_in: wp.array(dtype=wp.vec2),
    axis_in: wp.array(dtype=wp.vec3),
    height: float,
    disk_out: wp.array(dtype=wp.vec2),
    hemisphere_out: wp.array(dtype=wp.vec3),
    cone_out: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    disk_out[i] = concentric_disk(xi_in[i])
    hemisphere_out[i] = from_frame(cosine_hemisphere(xi_in[i]), axis_in[i])
    cone_out[i] = uniform_cone(xi_in[i], height)


@wp.kernel
def _permute_bits(
    first: int, index_in: wp.array(dtype=wp.uint32), x_out: wp.array(dtype=wp.uint32), y_out: wp.array(dtype=wp.uint32)
):
    i = first + wp.tid()
    x_out[i] = reverse_bits(index_in[i])
    y_out[i] = reverse_bits(sobol_second_reversed(index_in[i]))


def draw(launcher, seed=0, dimension=0, indices=1, samples=1024):
    """Independent and Sobol' numbers, each [indices, samples, 3]; the third column is the one-dimensional form."""
    count = indices * samples
    out = [launcher.empty(count, wp.vec3) for _ in range(2)]
    launcher.launch(_draw_numbers, count, [seed, dimension, samples], out)
    return [o.numpy().reshape(indices, samples, 3) for o in out]


def map_square(launcher, xi, axis, height=0.3):
    out = [launcher.empty(len(xi), t) for t in (wp.vec2, wp.vec3, wp.vec3)]
    axes = np.broadcast_to(np.asarray(axis, np.float32), (len(xi), 3))
    launcher.launch(
        _map_square,
        len(xi),
        [launcher.array(xi.astype(np.float32), wp.vec2), launcher.array(axes, wp.vec3), height],
        out,
    )
    return [o.numpy().astype(np.float64) for o in out]


def grid(n):
    u = (np.arange(n) + 0.5) / n
    return np.stack(np.meshgrid(u, u), -1).reshape(-1, 2)


def test_sobol_points_are_those_of_the_direction_numbers(launcher):
    index = np.concatenate([np.arange(256), np.random.default_rng(1).integers(0, 2**32, 256)]).astype(np.uint32)
    x, y = launcher.empty(len(index), wp.uint32), launcher.empty(len(index), wp.uint32)
    launcher.launch(_permute_bits, len(index), [launcher.array(index, wp.uint32)], [x, y])
    # Direction numbers of the second Sobol' dimension: v_k = v_(k-1) xor v_(k-1) / 2 from v_1 = 1/2.
    direction = [1 << 31]
    for _ in range(31):
        direction.append(direction[-1] ^ (direction[-1] >> 1))
    expected_x = [int(f"{i:032b}"[::-1], 2) for i in index]
    expected_y = [
        np.bitwise_xor.reduce([v for k, v in enumerate(direction) if i >> k & 1] or [0]) for i in index.tolist()
    ]
    np.testing.assert_array_equal(x.numpy(), np.array(expected_x, np.uint32))
    np.testing.assert_array_equal(y.numpy(), np.array(expected_y, np.uint32))


@pytest.mark.parametrize("log2", [2, 4, 7, 10])
def test_every_power_of_two_prefix_is_a_net_in_every_pixel_and_dimension(launcher, log2):
    for dimension in (0, 5):
        _, points = draw(launcher, seed=3, dimension=dimension, indices=4)
        for pixel in points[:, : 2**log2].astype(np.float64):
            for k in range(log2 + 1):
                cells = np.floor(pixel[:, :2] * [2**k, 2 ** (log2 - k)]).astype(int)
                assert len(np.unique(cells, axis=0)) == 2**log2  # one point in each elementary interval
            assert len(np.unique(np.floor(pixel[:, 2] * 2**log2))) == 2**log2


def test_pixels_dimensions_and_seeds_are_independent(launcher):
    rng_columns = [
        draw(launcher, seed, dimension, 1, 1024)[kind][0, :, 0]
        for kind in (0, 1)
        for seed, dimension in ((0, 0), (0, 1), (1, 0))
    ]
    more = draw(launcher, 0, 0, 2, 1024)
    columns = np.array([*rng_columns, more[0][1, :, 0], more[1][1, :, 0], more[0][0, :, 1], more[1][0, :, 1]])
    correlation = np.corrcoef(columns) - np.eye(len(columns))
    assert np.abs(correlation).max() < 5 / np.sqrt(1024)


def test_independent_numbers_are_uniform(launcher):
    independent, _ = draw(launcher, 7, 2, 64, 1024)
    assert independent.min() >= 0.0
    assert independent.max() < 1.0
    cells = np.floor(independent[..., :2].reshape(-1, 2) * 16).astype(int)
    counts = np.bincount(cells[:, 0] * 16 + cells[:, 1], minlength=256)
    chi2 = ((counts - counts.mean()) ** 2 / counts.mean()).sum()
    assert 160 < chi2 < 365  # 255 degrees of freedom: 4 and 5 standard deviations


def test_scrambled_points_have_an_unbiased_mean(launcher):
    _, points = draw(launcher, 11, 0, 4096, 1)
    assert np.abs(points.mean((0, 1)) - 0.5).max() < 4 * np.sqrt(1 / 12 / 4096)


def test_the_disk_map_preserves_area_and_stays_inside(launcher):
    disk, _, _ = map_square(launcher, np.random.default_rng(4).random((65536, 2)), (0, 0, 1))
    r2 = (disk**2).sum(1)
    assert r2.max() <= 1.0
    assert np.histogram(r2, 8, (0, 1))[0] == pytest.approx(np.full(8, 8192), rel=0.05)  # 4.5 standard deviations
    angle = np.arctan2(disk[:, 1], disk[:, 0])
    assert np.histogram(angle, 8, (-np.pi, np.pi))[0] == pytest.approx(
        np.full(8, 8192), rel=0.05
    )  # 4.5 standard deviations
    centre, _, _ = map_square(launcher, np.array([[0.5, 0.5], [0.5, 0.9], [0.9, 0.5]]), (0, 0, 1))
    assert np.isfinite(centre).all()


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 0, -1), (0.6, -0.64, 0.48), (1e-4, 0, -1)])
def test_hemisphere_directions_are_unit_and_cosine_distributed_about_the_axis(launcher, axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    _, directions, _ = map_square(launcher, grid(128), axis)
    assert np.linalg.norm(directions, axis=1) == pytest.approx(1.0, abs=2e-6)
    assert directions.mean(0) == pytest.approx(axis * 2 / 3, abs=1e-3)  # the mean of cos^2 / pi is 2/3
    second = np.einsum("ni,nj->ij", directions, directions) / len(directions)
    expected = 0.25 * np.eye(3) + 0.25 * np.outer(axis, axis)
    assert second == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("height", [2.0, 0.3, 1e-5])
def test_cone_directions_are_uniform_in_height_even_for_the_sun(launcher, height):
    _, _, cone = map_square(launcher, grid(64), (0, 0, 1), height)
    sine2 = (cone[:, :2] ** 2).sum(1)
    # sin^2 = h (2 - h), averaged over heights h uniform in [0, height]
    assert sine2.mean() == pytest.approx(height - height**2 / 3, rel=1e-3)
    assert cone[:, :2].mean(0) == pytest.approx([0, 0], abs=1e-3 * np.sqrt(height))

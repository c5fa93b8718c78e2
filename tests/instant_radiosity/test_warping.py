"""Hierarchical warping: exact probabilities, any size, any range of values."""

import numpy as np
import pytest

from warp_dvct.passes.warping import build_importance, texel_probabilities, warp_points

SIZES = [(1, 1), (1, 7), (5, 1), (3, 5), (16, 16), (100, 37), (640, 333)]


def halton(count, base):
    """The radical inverse of 1 ... count."""
    index, value, digit = np.arange(1, count + 1), np.zeros(count), 1.0
    while index.any():
        digit /= base
        value += digit * (index % base)
        index //= base
    return value


def halton2(count):
    return np.stack([halton(count, 2), halton(count, 3)], -1)


def random_image(width, height, seed=0):
    rng = np.random.default_rng(seed)
    return np.exp(2.0 * rng.standard_normal((height, width))).astype(np.float32)


def clarberg(image, points):
    """NumPy twin: texel indices, by recursive halving of a square of a power of two."""
    side = 1 << max(image.shape[0] - 1, image.shape[1] - 1).bit_length()
    square = np.zeros((side, side))
    square[: image.shape[0], : image.shape[1]] = image
    levels = [square]
    while levels[-1].shape[0] > 1:
        fine = levels[-1]
        levels.append(fine[::2, ::2] + fine[1::2, ::2] + fine[::2, 1::2] + fine[1::2, 1::2])
    x, y = np.zeros(len(points), int), np.zeros(len(points), int)
    ux, uy = points.T.copy()
    for fine in levels[-2::-1]:
        x, y = 2 * x, 2 * y
        upper, lower = fine[y, x] + fine[y, x + 1], fine[y + 1, x] + fine[y + 1, x + 1]
        share = upper / (upper + lower)
        down = uy >= share
        uy = np.where(down, (uy - share) / np.where(down, 1 - share, 1), uy / np.where(down, 1, share))
        y = y + down
        share = fine[y, x] / (fine[y, x] + fine[y, x + 1])
        right = ux >= share
        ux = np.where(right, (ux - share) / np.where(right, 1 - share, 1), ux / np.where(right, 1, share))
        x = x + right
    return y * image.shape[1] + x


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_probabilities_are_the_normalised_importance(launcher, width, height):
    image = random_image(width, height)
    probability = texel_probabilities(launcher, build_importance(launcher, image, width, height))
    np.testing.assert_allclose(probability, image / image.sum(dtype=np.float64), rtol=2e-5)
    assert probability.sum(dtype=np.float64) == pytest.approx(1.0, abs=1e-5)


def test_points_go_where_the_numpy_twin_sends_them(launcher):
    image = random_image(100, 37)
    points = halton2(20_000)
    place, texel, probability = warp_points(launcher, build_importance(launcher, image, 100, 37), points)
    assert (texel != clarberg(image, points)).mean() < 1e-4  # sums in float32 move a few points on a split
    np.testing.assert_allclose(probability, image.ravel()[texel] / image.sum(dtype=np.float64), rtol=2e-5)
    inside = place * [100, 37]
    assert ((inside >= [0, 0]) & (inside < [100, 37])).all()
    offset = inside - np.stack([texel % 100, texel // 100], -1)
    assert offset.min() > -1e-4
    assert offset.max() < 1 + 1e-4


def test_chi_square_of_a_million_samples(launcher):
    """Random points: the statistic is chi-square distributed with one degree less than there are texels."""
    width, height, count = 61, 33, 1_000_000
    image = random_image(width, height, seed=3)
    points = np.random.default_rng(4).random((count, 2))
    _, texel, _ = warp_points(launcher, build_importance(launcher, image, width, height), points)
    expected = count * image.ravel() / image.sum(dtype=np.float64)
    enough = expected > 5
    seen = np.bincount(texel, minlength=width * height)
    chi2 = ((seen - expected)[enough] ** 2 / expected[enough]).sum()
    degrees = enough.sum() - 1
    assert abs(chi2 - degrees) < 4 * np.sqrt(2 * degrees)


def test_low_discrepancy_survives_the_warp(launcher):
    """Halton points land in the texels far more evenly than random ones would."""
    width, height, count = 61, 33, 1_000_000
    image = random_image(width, height, seed=3)
    _, texel, _ = warp_points(launcher, build_importance(launcher, image, width, height), halton2(count))
    expected = count * image.ravel() / image.sum(dtype=np.float64)
    chi2 = ((np.bincount(texel, minlength=width * height) - expected) ** 2 / expected).sum()
    assert chi2 < 0.2 * width * height


def test_place_inside_a_texel_is_uniform(launcher):
    image = random_image(8, 8)
    place, _, _ = warp_points(launcher, build_importance(launcher, image, 8, 8), halton2(65536))
    inside = (place * 8) % 1.0
    np.testing.assert_allclose(inside.mean(0), 0.5, atol=0.01)
    np.testing.assert_allclose((inside**2).mean(0), 1 / 3, atol=0.01)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_nothing_to_pick(launcher, width, height):
    importance = build_importance(launcher, np.zeros((height, width), np.float32), width, height)
    place, texel, probability = warp_points(launcher, importance, halton2(64))
    assert importance.total == 0
    assert (probability == 0).all()
    assert np.isfinite(place).all()
    assert ((texel >= 0) & (texel < width * height)).all()
    assert (texel_probabilities(launcher, importance) == 0).all()


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_single_texel(launcher, width, height):
    image = np.zeros((height, width), np.float32)
    image[height // 2, width - 1] = 1e-30
    place, texel, probability = warp_points(launcher, build_importance(launcher, image, width, height), halton2(256))
    assert (texel == height // 2 * width + width - 1).all()
    assert (probability == 1).all()
    assert np.ptp(place[:, 0]) * width > 0.9  # the whole texel is used


def test_values_from_1e_30_to_1e30(launcher):
    image = np.logspace(-30, 30, 61, dtype=np.float32).reshape(1, 61)
    importance = build_importance(launcher, image, 61, 1)
    probability = texel_probabilities(launcher, importance)
    exact = image.astype(np.float64) / image.sum(dtype=np.float64)
    normal = exact > 1e-36  # what float32 holds as a normal number
    np.testing.assert_allclose(probability[normal], exact[normal], rtol=1e-5)
    _, texel, chosen = warp_points(launcher, importance, halton2(4096))
    assert (chosen > 0).all()
    assert np.bincount(texel, minlength=61)[60] / 4096 == pytest.approx(0.9, abs=0.002)
    faint = build_importance(launcher, np.full((3, 3), 1e-30, np.float32), 3, 3)
    np.testing.assert_allclose(texel_probabilities(launcher, faint), 1 / 9, rtol=1e-6)


def test_largest_size(launcher):
    image = np.ones((2048, 4096), np.float32)
    image[1000, 3000] = 1e6
    importance = build_importance(launcher, image, 4096, 2048)
    assert importance.total == pytest.approx(4096 * 2048 - 1 + 1e6, rel=1e-6)
    _, texel, _ = warp_points(launcher, importance, halton2(100_000))
    assert (texel == 1000 * 4096 + 3000).mean() == pytest.approx(1e6 / importance.total, abs=1e-3)
    assert np.unique(texel).size > 80_000


def test_unusable_values_are_never_picked(launcher):
    image = np.array([[np.nan, -1.0, np.inf], [1.0, 3.0, 0.0]], np.float32)
    _, texel, _ = warp_points(launcher, build_importance(launcher, image, 3, 2), halton2(1000))
    assert set(texel) == {3, 4}


def test_a_size_that_does_not_fit_is_refused(launcher):
    with pytest.raises(ValueError, match="3 x 3 does not fit 8"):
        build_importance(launcher, np.ones(8, np.float32), 3, 3)

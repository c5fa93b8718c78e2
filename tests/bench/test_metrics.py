"""Metrics against closed forms."""

import builtins

import numpy as np
import pytest

from warp_dvct import metrics
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.passes.tonemap import tonemap


def flat(value, shape=(16, 24)):
    return np.full((*shape, 3), value, np.float32)


def test_rmse_of_an_offset_is_the_offset():
    assert metrics.rmse(flat(0.25), flat(0.35)) == pytest.approx(0.1, rel=1e-5)


def test_rel_mse_closed_form():
    assert metrics.rel_mse(flat(0.5), flat(0.6), epsilon=0.01) == pytest.approx(0.01 / 0.26, rel=1e-5)


def test_masks_select_pixels():
    test = flat(0.5)
    test[:8] += 0.2
    top = np.zeros((16, 24), bool)
    top[:8] = True
    assert metrics.rmse(flat(0.5), test, top) == pytest.approx(0.2, rel=1e-5)
    assert metrics.rmse(flat(0.5), test, ~top) == 0
    assert metrics.rmse(flat(0.5), test) == pytest.approx(0.2 / np.sqrt(2), rel=1e-5)
    assert np.isnan(metrics.rmse(flat(0.5), test, np.zeros((16, 24), bool)))


def test_different_shapes_are_refused():
    with pytest.raises(ValueError, match=r"\(16, 24, 3\).*\(8, 24, 3\)"):
        metrics.rmse(flat(1), flat(1, (8, 24)))


@pytest.mark.parametrize("exposure", [0.0, -1.5, 2.0])
def test_to_display_is_what_the_png_shows(exposure):
    linear = np.random.default_rng(1).uniform(-0.2, 3, (31, 17, 3)).astype(np.float32)
    codes = tonemap(Launcher("cpu", 1), linear, exposure=exposure)
    assert np.abs(metrics.to_display(linear, exposure) * 255 - codes).max() <= 0.5 + 1e-2


def test_to_display_known_values():
    # 0.5 linear is code 188 in sRGB; grey at or above 1 is white.
    assert metrics.to_display(flat(0.5))[0, 0, 0] * 255 == pytest.approx(187.5, abs=0.1)
    assert metrics.to_display(flat(0.25), exposure=1)[0, 0, 0] * 255 == pytest.approx(187.5, abs=0.1)
    assert metrics.to_display(flat(7.0)).min() == 1


def test_flip_of_equal_pictures_is_zero_and_grows_with_error():
    rng = np.random.default_rng(2)
    picture = rng.uniform(0, 1, (40, 60, 3)).astype(np.float32)
    mean, error = metrics.flip_ldr(picture, picture)
    assert mean == 0
    assert error.shape == (40, 60)
    assert not error.any()
    small, large = (metrics.flip_ldr(picture, picture * f)[0] for f in (0.95, 0.8))
    assert 0 < small < large <= 1


def test_flip_sees_the_error_where_it_is():
    test = flat(0.5, (64, 64))
    test[:, :20] = 0.1
    mean, error = metrics.flip_ldr(flat(0.5, (64, 64)), test)
    assert error[:, :16].min() > 0.2
    assert error[:, 40:].max() < 1e-3
    assert mean == pytest.approx(error.mean(), rel=1e-3)


def test_flip_black_against_white_is_near_one():
    assert 0.95 < metrics.flip_ldr(flat(0), flat(1))[0] <= 1  # green against blue is the largest, 1


def test_flip_depends_on_exposure():
    dark = flat(0.01), flat(0.02)
    assert metrics.flip_ldr(*dark, exposure=4)[0] > 1.5 * metrics.flip_ldr(*dark)[0]


def test_missing_flip_says_how_to_install(monkeypatch):
    real = builtins.__import__

    def without_flip(name, *args, **kwargs):
        if name == "flip_evaluator":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_flip)
    with pytest.raises(OptionError, match="pip install"):
        metrics.flip_ldr(flat(0), flat(1))


def test_affected_mask():
    delta = np.zeros((1, 4, 3))
    delta[0, 1] = (0, -0.02, 0)
    delta[0, 2] = 0.009
    coverage = np.array([[0, 0, 0, 0.25]])
    assert metrics.affected_mask(delta, coverage).tolist() == [[False, True, False, True]]


def test_region_masks():
    #          covered  shadow  bounce only  glossy, bounce  unchanged  shadow and bounce
    direct = [-0.5, -0.3, 0.0, 0.0, 0.0, -0.3]
    total = [-0.5, -0.3, 0.05, 0.05, 0.004, -0.1]
    coverage = np.array([[1.0, 0, 0, 0, 0, 0]])
    glossy = np.array([[True, False, False, True, True, False]])
    spread = np.array([1.0, 0.5, 0.2])
    masks = metrics.region_masks(
        np.array(direct)[None, :, None] * spread, np.array(total)[None, :, None] * spread, coverage, glossy
    )
    assert tuple(masks) == metrics.REGIONS
    assert masks["object"][0].tolist() == [True, False, False, False, False, False]
    assert masks["shadow"][0].tolist() == [False, True, False, False, False, True]
    assert masks["bounce"][0].tolist() == [False, False, True, False, False, True]
    assert masks["reflection"][0].tolist() == [False, False, False, True, False, False]


def test_smooth_delta_averages_noise_but_not_the_objects_pixels():
    rng = np.random.default_rng(3)
    coverage = np.zeros((40, 40))
    coverage[:20] = 1
    delta = np.where(coverage[..., None] > 0, 9.0, 0.05) + rng.normal(0, 0.01, (40, 40, 3))
    smooth = metrics.smooth_delta(delta, coverage)
    assert np.abs(smooth[20:] - 0.05).max() < 0.015
    assert smooth[20:].std() < delta[20:].std() / 3
    assert not smooth[:17].any()
    constant = np.full((6, 6, 3), 0.3)
    np.testing.assert_allclose(
        metrics.smooth_delta(constant, np.zeros((6, 6))), 0.3, err_msg="up to the picture's edge"
    )

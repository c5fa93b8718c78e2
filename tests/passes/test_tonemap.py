"""The preview's tone curves: a photograph keeps its codes, highlights fade without a hue shift."""

from __future__ import annotations

import numpy as np
import pytest

from warp_dvct.errors import OptionError
from warp_dvct.passes.tonemap import tonemap


def decode_srgb(codes: np.ndarray) -> np.ndarray:
    v = codes / 255.0
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def test_srgb_curve_returns_all_codes_of_a_photograph(launcher):
    codes = np.arange(256, dtype=np.uint8)
    image = np.stack([codes, codes[::-1], np.roll(codes, 7)], -1)[None]
    np.testing.assert_array_equal(tonemap(launcher, decode_srgb(image)), image)


def test_exposure_is_in_stops(launcher):
    image = np.random.default_rng(0).uniform(0, 0.5, (4, 5, 3))
    np.testing.assert_array_equal(tonemap(launcher, image, exposure=1.0), tonemap(launcher, 2 * image))


@pytest.mark.parametrize("curve", ["srgb", "filmic"])
def test_curves_are_monotonic_without_bright_wrap_around(launcher, curve):
    grey = np.concatenate([[-1.0, 0.0], np.logspace(-5, 9, 400), [np.inf]])
    codes = tonemap(launcher, np.repeat(grey[None, :, None], 3, 2), curve=curve)[0, :, 0].astype(int)
    assert codes[0] == codes[1] == 0
    assert np.all(np.diff(codes) >= 0)
    assert codes[-1] == 255


def test_highlights_keep_their_hue_and_fade_to_white(launcher):
    color = np.array([1.0, 0.5, 0.25])
    for peak in (1.5, 3.0):
        shown = decode_srgb(tonemap(launcher, (peak * color)[None, None])[0, 0].astype(float))
        # A mix of the colour at full brightness and white has the hue of the colour.
        np.testing.assert_allclose(shown, color / peak + (1 - 1 / peak), atol=0.005)
    assert np.all(tonemap(launcher, (1e5 * color)[None, None]) == 255)
    assert np.all(tonemap(launcher, np.full((1, 1, 3), np.nan)) == 0)


def test_unknown_curve_and_wild_exposure_are_named(launcher):
    with pytest.raises(OptionError, match="srgb, filmic"):
        tonemap(launcher, np.zeros((1, 1, 3)), curve="aces")
    with pytest.raises(OptionError, match="nan"):
        tonemap(launcher, np.zeros((1, 1, 3)), exposure=float("nan"))

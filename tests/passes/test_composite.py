"""The composite's contract: comp = rgba over (plate * shadow + added), and an untouched plate stays bit-identical."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.layers import Layers, Radiance
from warp_dvct.passes.composite import composite

HALF_MAX = 65504.0


def half(values: np.ndarray) -> np.ndarray:
    return np.asarray(values, np.float32).astype(np.float16).astype(np.float32)


def run(launcher, before, delta, synthetic, plate=None) -> Layers:
    """Composite one row of pixels given as arrays ``[n, 3]``, ``[n, 3]``, ``[n, 4]``."""
    n = len(delta)
    vec = launcher.zeros(n, wp.vec3)
    radiance = Radiance(
        width=n,
        height=1,
        before=None if before is None else launcher.array(np.float32(before), wp.vec3),
        delta=launcher.array(np.float32(delta), wp.vec3),
        synthetic=launcher.array(np.float32(synthetic), wp.vec4),
        albedo=vec,
        normal=vec,
        position=vec,
        depth=launcher.full(n, float("inf"), wp.float32),
        mask_real=launcher.zeros(n, wp.float32),
    )
    return composite(launcher, radiance, plate)


def twin(plate, delta, synthetic) -> dict[str, np.ndarray]:
    """The same in NumPy, float32, in the same order."""
    one = np.float32(1)
    p, s = np.float32(plate), np.float32(synthetic)
    covered = np.clip(s[:, 3:], 0, 1)
    a = half(covered)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        d = np.where(a < 1, np.clip(np.float32(delta) / (one - covered), -HALF_MAX, HALF_MAX), np.float32(0))
        clipped = np.clip(p, -HALF_MAX, HALF_MAX)
        ratio = np.where((d >= 0) | (clipped < np.float32(2**-14)), one, np.clip((clipped + d) / clipped, 0, 1))
    own = half(np.clip(s[:, :3], -HALF_MAX, HALF_MAX))
    base, shadow, added = half(clipped), half(ratio), half(np.maximum(d, 0))
    comp = half(np.clip(own + (one - a) * (base * shadow + added), -HALF_MAX, HALF_MAX))
    rgba = np.concatenate([own, a], 1)
    return {"rgba": rgba, "comp": comp, "plate": base, "shadow": shadow, "added": added, "delta": half(d)}


def random_pixels(rng: np.random.Generator, n: int):
    plate = rng.lognormal(-1.0, 2.0, (n, 3)) * rng.choice([0.0, 1.0], (n, 3), p=[0.1, 0.9])
    delta = plate * rng.uniform(-1.2, 1.2, (n, 3)) * rng.choice([0.0, 1.0], (n, 1), p=[0.3, 0.7])
    alpha = rng.choice([0.0, 0.25, 1.0, 0.7313, 0.9999], (n, 1))
    synthetic = np.concatenate([rng.lognormal(-1.0, 1.0, (n, 3)) * alpha, alpha], 1)
    return plate.astype(np.float32), (delta * (1 - alpha)).astype(np.float32), synthetic.astype(np.float32)


def bits(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32).astype(np.float16).view(np.uint16)


def half_steps(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """How many half numbers lie between a and b."""
    order = [np.where(x & 0x8000, -(x & 0x7FFF).astype(int), (x & 0x7FFF).astype(int)) for x in (bits(a), bits(b))]
    return np.abs(order[0] - order[1])


def test_matches_numpy_twin(launcher):
    plate, delta, synthetic = random_pixels(np.random.default_rng(1), 20_000)
    layers = run(launcher, plate, delta, synthetic)
    for name, expected in twin(plate, delta, synthetic).items():
        # One step is left for a fused multiply-add or a division that rounds differently.
        assert half_steps(getattr(layers, name)[0], expected).max() <= 1, name
        assert np.mean(getattr(layers, name)[0] == expected) > 0.999, name


def recombine(layers: Layers) -> np.ndarray:
    """What a compositor does with the stored layers."""
    a = layers.rgba[..., 3:]
    return layers.rgba[..., :3] + (1 - a) * (layers.plate * layers.shadow + layers.added)


def test_comp_is_the_recombination_of_the_stored_layers(launcher):
    layers = run(launcher, *random_pixels(np.random.default_rng(2), 20_000))
    assert half_steps(recombine(layers), layers.comp).max() <= 1
    for name in ("rgba", "comp", "plate", "shadow", "added", "delta"):
        values = getattr(layers, name)
        np.testing.assert_array_equal(half(values), values, err_msg=name)


def test_layers_are_rounded_to_the_nearest_half(launcher):
    """Ties to even, bit for bit as NumPy rounds: halves, the middles between them, what lies just beside these, and
    numbers of every size, those below the smallest half and both zeros included."""
    halves = np.arange(65536, dtype=np.uint16).view(np.float16).astype(np.float32)
    halves = np.sort(halves[np.isfinite(halves)])
    middles = 0.5 * (halves[1:] + halves[:-1])
    beside = [np.nextafter(middles, np.float32(s) * np.inf) for s in (-1, 1)]
    sizes = np.random.default_rng(3).standard_normal(30_000) * np.logspace(-12, 4, 30_000)
    values = np.concatenate([halves, middles, *beside, sizes, [0.0, -0.0]]).astype(np.float32)
    values = np.resize(values, (-(-len(values) // 3), 3))
    nothing = np.zeros_like(values)
    layers = run(launcher, None, nothing, np.zeros((len(values), 4)), values[None])
    np.testing.assert_array_equal(bits(layers.plate[0]), bits(values))


def test_every_half_plate_comes_back_bit_for_bit(launcher):
    values = np.arange(65536, dtype=np.uint16).view(np.float16)
    values = values[np.isfinite(values)].astype(np.float32)
    plate = np.repeat(values[:, None], 3, 1)
    layers = run(launcher, None, np.zeros_like(plate), np.zeros((len(plate), 4)), plate[None])
    np.testing.assert_array_equal(bits(layers.comp[0]), bits(plate))
    np.testing.assert_array_equal(bits(layers.plate[0]), bits(plate))
    assert np.all(layers.shadow == 1)
    assert not layers.added.any()
    assert not layers.rgba.any()
    assert (layers.clamped, layers.invalid) == (0, 0)


def test_full_shadow_is_exactly_black_and_coloured(launcher):
    plate = np.float32([[0.3, 0.1, 1 / 3], [0.3, 0.1, 1 / 3]])
    delta = np.float32([[-0.3, -0.1, -1 / 3], [-0.15, 0.0, 0.1]])
    layers = run(launcher, plate, delta, np.zeros((2, 4)))
    assert np.all(layers.comp[0, 0] == 0)
    np.testing.assert_allclose(layers.shadow[0, 1], [0.5, 1, 1], rtol=5e-4)
    np.testing.assert_allclose(layers.added[0, 1], [0, 0, 0.1], rtol=5e-4)


def test_partial_coverage_takes_the_mean_over_the_real_part(launcher):
    # Three quarters of the pixel show the object; the rest was .8 and is now .4, so the pixel's sum of change is -.1.
    layers = run(launcher, [[0.8] * 3], [[-0.1] * 3], [[0.3, 0.3, 0.3, 0.75]])
    np.testing.assert_allclose(layers.shadow, 0.5, rtol=5e-4)
    np.testing.assert_allclose(layers.delta, -0.4, rtol=5e-4)
    np.testing.assert_allclose(layers.comp, 0.3 + 0.25 * 0.4, rtol=1e-3)


def test_darkening_of_a_black_plate_leaves_it_black(launcher):
    layers = run(launcher, [[0.0, 1e-6, -0.5]], [[-0.5, -1e-6, -0.5]], np.zeros((1, 4)))
    assert np.all(layers.shadow == 1)
    np.testing.assert_array_equal(layers.comp, layers.plate)


def test_overflow_is_clamped_and_counted(launcher):
    plate = np.float32([[1e6, np.inf, 1.0], [60000.0, 1.0, 1.0]])
    delta = np.float32([[0, 0, 1e9], [60000.0, 0, 0]])
    layers = run(launcher, plate, delta, np.zeros((2, 4)))
    assert layers.clamped == 4
    np.testing.assert_array_equal(layers.comp[0, 0], [HALF_MAX] * 3)
    np.testing.assert_array_equal(layers.comp[0, 1], [HALF_MAX, 1, 1])
    assert np.isfinite(bits(layers.comp).view(np.float16)).all()


def test_nan_becomes_zero_and_is_counted(launcher):
    nan = float("nan")
    layers = run(launcher, [[nan, 0.5, 0.5]], [[0.1, nan, 0.0]], [[0.0, 0.0, 0.0, nan]])
    assert layers.invalid == 3
    np.testing.assert_allclose(layers.comp, [[[0.1, 0.5, 0.5]]], rtol=5e-4)


any_float = st.floats(width=32, allow_nan=True, allow_infinity=True)


@settings(max_examples=60, deadline=None)
@given(values=hnp.arrays(np.float32, (4, 10), elements=any_float))
def test_layers_are_always_finite_in_range_and_recombine(launcher, values):
    layers = run(launcher, values[:, :3], values[:, 3:6], values[:, 6:])
    for name in ("rgba", "comp", "plate", "shadow", "added", "delta"):
        stored = getattr(layers, name)
        assert np.isfinite(stored).all()
        np.testing.assert_array_equal(half(stored), stored, err_msg=name)
    assert layers.shadow.min() >= 0
    assert layers.shadow.max() <= 1
    assert layers.added.min() >= 0
    assert half_steps(np.clip(recombine(layers), -HALF_MAX, HALF_MAX), layers.comp).max() <= 1


def test_result_does_not_depend_on_the_thread_count(launcher):
    pixels = random_pixels(np.random.default_rng(3), 5000)
    np.testing.assert_array_equal(
        run(launcher, *pixels).comp, run(Launcher(str(launcher.device), threads=1), *pixels).comp
    )


def test_plate_of_another_size_names_both(launcher):
    with pytest.raises(OptionError, match=r"2 x 5 x 3 .* 1 x 4 x 3"):
        run(launcher, None, np.zeros((4, 3)), np.zeros((4, 4)), np.zeros((2, 5, 3), np.float32))


def test_no_plate_and_no_before_is_refused(launcher):
    with pytest.raises(ValueError, match="no plate was given"):
        run(launcher, None, np.zeros((4, 3)), np.zeros((4, 4)))

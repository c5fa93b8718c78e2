"""Distances between pictures, and the regions of a picture in which an effect of the inserted objects shows.

Pictures are linear Rec.709 NumPy arrays ``[h, w, 3]``; masks are bool ``[h, w]``.
"""

from __future__ import annotations

import numpy as np

from warp_dvct.errors import OptionError

AFFECTED = 0.01  # linear radiance; a change below it is not seen on a picture exposed for [0, 1]
REGIONS = ("object", "shadow", "bounce", "reflection")


def rmse(reference: np.ndarray, test: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Root of the mean squared difference over pixels and channels, in linear units; NaN for an empty mask."""
    error = _difference(reference, test) ** 2
    return float(np.sqrt(_masked_mean(error, mask)))


def rel_mse(reference: np.ndarray, test: np.ndarray, mask: np.ndarray | None = None, epsilon: float = 0.01) -> float:
    """Mean of (test - reference)² / (reference² + epsilon) over pixels and channels; NaN for an empty mask.

    ``epsilon`` [radiance²] keeps black pixels from deciding; 0.01 is Rousselle et al. 2011, "Adaptive Sampling and
    Reconstruction using Greedy Error Minimization", section 5.
    """
    error = _difference(reference, test) ** 2 / (np.asarray(reference, np.float64) ** 2 + epsilon)
    return _masked_mean(error, mask)


def to_display(linear: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """Linear Rec.709 to sRGB in [0, 1], without rounding: what the PNG preview shows.

    Colours are scaled by ``2**exposure``; those with a channel m above 1 fade to white with their hue kept
    (1 - (1 - c/m)/m, as ``passes.tonemap`` with its curve ``srgb``); then the IEC 61966-2-1 transfer function.
    """
    color = np.maximum(np.asarray(linear, np.float64) * 2.0**exposure, 0.0)
    peak = np.maximum(color.max(axis=-1, keepdims=True), 1.0)
    color = 1.0 - (1.0 - color / peak) / peak
    low, high = 12.92 * color, 1.055 * np.maximum(color, 1e-12) ** (1 / 2.4) - 0.055
    return np.where(color <= 0.0031308, low, high).astype(np.float32)


def flip_ldr(reference: np.ndarray, test: np.ndarray, exposure: float = 0.0) -> tuple[float, np.ndarray]:
    """LDR-FLIP of two linear pictures after :func:`to_display`, at 67 pixels per degree.

    Returns:
        The mean over the picture, and the error map, float32 ``[h, w]`` in [0, 1].
    Raises:
        OptionError: The package flip-evaluator is not installed.
        ValueError: The shapes differ.

    Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images".
    """
    _difference(reference, test)
    flip = import_flip()
    shown, other = (np.ascontiguousarray(to_display(picture, exposure)) for picture in (reference, test))
    error, mean, _ = flip.evaluate(shown, other, "LDR", applyMagma=False)
    return float(mean), np.asarray(error, np.float32).reshape(reference.shape[:2])


def import_flip():
    """The flip_evaluator module.

    Raises:
        OptionError: It is not installed; the message says how to install it.
    """
    try:
        import flip_evaluator
    except ImportError as error:
        raise OptionError("LDR-FLIP needs the package flip-evaluator: pip install 'warp-dvct[bench]'") from error
    return flip_evaluator


def smooth_delta(delta: np.ndarray, coverage: np.ndarray, radius: int = 2) -> np.ndarray:
    """Mean of ``delta`` over the real part of the pixels in a square around each, for masks of a noisy truth.

    A threshold on single noisy pixels would count noise as change. The mean is taken over pixels that synthetic
    objects do not cover and is 0 where there is none.

    Args:
        delta: ``[h, w, 3]``; coverage: ``[h, w]`` in [0, 1]; radius: Pixels to each side.
    """
    free = (coverage <= 0).astype(np.float64)[..., None]
    padded = np.pad(np.concatenate([delta * free, free], -1), ((radius, radius), (radius, radius), (0, 0)))
    sums = np.lib.stride_tricks.sliding_window_view(padded, (2 * radius + 1, 2 * radius + 1), (0, 1)).sum((-2, -1))
    return np.where(sums[..., 3:] > 0, sums[..., :3] / np.maximum(sums[..., 3:], 1), 0.0)


def affected_mask(delta_true: np.ndarray, coverage: np.ndarray, threshold: float = AFFECTED) -> np.ndarray:
    """Pixels that the inserted objects change: a channel of the true delta beyond ``threshold``, or covered at all."""
    return (np.abs(delta_true).max(axis=-1) > threshold) | (coverage > 0)


def region_masks(
    delta_direct: np.ndarray,
    delta_true: np.ndarray,
    coverage: np.ndarray,
    glossy: np.ndarray,
    threshold: float = AFFECTED,
) -> dict[str, np.ndarray]:
    """Where each effect shows, from the truth; regions may overlap, save that ``object`` overlaps none.

    Args:
        delta_direct: True change of direct light on real surfaces, ``[h, w, 3]``.
        delta_true: True change of all light, ``[h, w, 3]``.
        coverage: By synthetic objects, ``[h, w]`` in [0, 1].
        glossy: Pixels whose real surface has a visible specular lobe, bool ``[h, w]``.
        threshold: Linear radiance below which a change does not count.
    Returns:
        ``object``: covered pixels; ``shadow``: direct light lost; ``bounce``: indirect light changed, on surfaces that
        are not glossy; ``reflection``: light of any kind changed on glossy real surfaces.
    """
    free = coverage <= 0
    indirect = np.abs(delta_true - delta_direct).max(axis=-1) > threshold
    changed = np.abs(delta_true).max(axis=-1) > threshold
    return {
        "object": ~free,
        "shadow": free & (delta_direct.min(axis=-1) < -threshold),
        "bounce": free & indirect & ~glossy,
        "reflection": free & changed & glossy,
    }


def _difference(reference: np.ndarray, test: np.ndarray) -> np.ndarray:
    if reference.shape != test.shape or reference.ndim != 3 or reference.shape[-1] != 3:
        raise ValueError(f"pictures must both be [h, w, 3]; reference is {reference.shape}, test {test.shape}")
    return np.asarray(test, np.float64) - np.asarray(reference, np.float64)


def _masked_mean(values: np.ndarray, mask: np.ndarray | None) -> float:
    chosen = values if mask is None else values[mask]
    return float(chosen.mean()) if chosen.size else float("nan")

"""OpenCV's lens distortion, on the plane at distance 1 in front of a camera: x to the right, y down."""

from __future__ import annotations

import numpy as np

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
STEP = 1e-6  # of the plane, for differences: far below a pixel, far above float64's rounding
CLOSE = 1e-12  # of the plane
FOLDED = 1e-6  # determinant at and below which a lens shows no direction once


def distort(x: np.ndarray, y: np.ndarray, coefficients: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Where a lens shows the direction (x, y, 1): OpenCV's rational model with tangential and thin-prism terms."""
    if not any(coefficients):
        return x, y
    full = np.pad(np.asarray(coefficients, np.float64), (0, len(COEFFICIENTS) - len(coefficients)))
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = full
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    a, b, c = 2 * x * y, r2 + 2 * x * x, r2 + 2 * y * y
    return x * radial + p1 * a + p2 * b + r2 * (s1 + s2 * r2), y * radial + p1 * c + p2 * a + r2 * (s3 + s4 * r2)


def undistort(
    x: np.ndarray, y: np.ndarray, coefficients: tuple[float, ...], *, steps: int = 20
) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of :func:`distort` by Newton steps with differences as derivatives.

    Where a lens model folds back (beyond its calibrated field) there is no inverse; the result there is NaN.
    """
    if not any(coefficients):
        return x, y
    u, v = np.array(x, np.float64), np.array(y, np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        for _ in range(steps):
            px, py = distort(u, v, coefficients)
            ax, ay = distort(u + STEP, v, coefficients)
            bx, by = distort(u, v + STEP, coefficients)
            a, b, c, d = (ax - px) / STEP, (bx - px) / STEP, (ay - py) / STEP, (by - py) / STEP
            determinant = a * d - b * c
            determinant = np.where(determinant > FOLDED, determinant, np.nan)
            ex, ey = px - x, py - y
            if np.nanmax(np.hypot(ex, ey), initial=0.0) < CLOSE:
                break
            u, v = u - (d * ex - b * ey) / determinant, v - (a * ey - c * ex) / determinant
        px, py = distort(u, v, coefficients)
        good = np.hypot(px - x, py - y) < STEP
    return np.where(good, u, np.nan), np.where(good, v, np.nan)

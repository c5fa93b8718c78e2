"""Which light explains shading, where surfaces of one colour have one albedo: light and albedo in turns.

Pure NumPy: the renderer's part, irradiance by unit light and its Jacobian, is in :mod:`warp_dvct.capture.light_fit`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from warp_dvct.probe import LUMINANCE

CLUSTERS = 12  # colours that are taken to be of one albedo each, at most
APART = 0.8  # logarithm of chromaticity between colours of their own, before the light is known
SAME = 0.25  # the same, where it is known
LOW, HIGH = 0.02, 0.95  # no matt surface is blacker than velvet or whiter than fresh snow
LIGHTEST = 0.8  # albedo of the lightest surfaces, the 99th percentile: white paint or paper
RIDGE = 0.02  # of the normal matrix' mean diagonal: what shading does not tell stays even
# Of the same, times the squared relative residual: what draws all parts of the light to one colour where shading leaves
# open how they share it. Parts that differ by a seventh, told by ten independent places: 1 / (0.14**2 * 10).
EVEN_COLORS = 5.0
NEGATIVE = 30.0  # of the same: what keeps the dome from taking light away
GRID = 200  # directions at which it is kept from that
MOST_TURN = np.radians(10.0)  # of the dominant light in one step
HALVINGS = 5  # of a step that does not help
TUKEY = 4.685 * 1.4826  # of the median absolute residual: the usual 95 % efficiency
LEAST_SCALE = 1.0  # of the shading: a shadow that the light does not explain yet is what moves it

MOST_BOUNCED = 0.9

# Irradiance of a distant light of unit irradiance toward a direction, [n], and its derivative by that, [n, 3].
Sun = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass
class Unknowns:
    """The light that is looked for, and the albedo of each sample.

    Attributes:
        harmonics: ``[h, 3]`` of the dome. toward, irradiance: Of the dominant light; 0 where there is none.
        albedo: ``[n, 3]``.
    """

    harmonics: np.ndarray
    toward: np.ndarray
    irradiance: np.ndarray
    albedo: np.ndarray


class Solver:
    """Alternates between light (weighted linear least squares, Gauss-Newton for the direction) and albedo.

    Args:
        seen: Radiance in the photographs, positive, ``[n, 3]``.
        dome: Irradiance by each harmonic of the dome, ``[n, h]``.
        clipped: Samples that may have been any brighter, ``[n]``.
        sun: The dominant light's irradiance.
        seed: Of the clusters' start.

    Attributes:
        bounced: Share of the irradiance that bounced off other surfaces, in [0, MOST_BOUNCED], ``[n, 3]``, to be set
            from outside. As a share it follows the light, and the fit cannot run away from it.
    """

    def __init__(
        self, seen: np.ndarray, dome: np.ndarray, sun: Sun, *, clipped: np.ndarray | None = None, seed: int = 0
    ) -> None:
        self.seen, self.dome, self.sun, self.seed = seen, dome, sun, seed
        self.clipped = np.zeros(len(seen), bool) if clipped is None else clipped
        self.cluster = np.zeros(len(seen), np.int64)
        self.bounced = np.zeros_like(seen)
        self.weight = np.ones(len(seen))
        self.x = Unknowns(np.zeros((dome.shape[1], 3)), np.array([0.0, 1.0, 0.0]), np.zeros(3), np.ones_like(seen))
        self.regroup(APART)

    def predicted(self) -> np.ndarray:
        """Irradiance ``[n, 3]`` of the current estimate."""
        sun = self.sun(self.x.toward)[0][:, None] * self.x.irradiance
        return np.maximum(self.dome @ self.x.harmonics + sun, 0.0) / (1.0 - self.bounced)

    def regroup(self, apart: float, lightness: float = 0.0) -> None:
        """Find anew which samples share an albedo, by the colour that is left when the estimated light is divided out.

        Light and shade differ in colour under a blue sky, so as long as the light is not known only colours that are
        far apart are told apart; or each would have an albedo of its own, and no shading would be left to explain.
        ``lightness`` is the weight of lightness beside chromaticity.
        """
        lit = bool(self.x.harmonics.any())
        quotient = self._quotient() if lit else np.pi * self.seen
        self.cluster = color_clusters(quotient, self.seed, apart, lightness)
        self._set_albedo(quotient)
        if lit:
            self._normalize()

    def start_from(self, tried: np.ndarray, columns: np.ndarray) -> None:
        """Take the one of the directions ``tried`` ``[m, 3]``, with irradiance ``columns`` ``[n, m]``, that explains
        most of what the dome does not."""
        target, row = self._target()
        basis = np.linalg.qr(self.dome * row[:, None])[0]
        rest = (target @ LUMINANCE) * row
        rest = rest - basis @ (basis.T @ rest)
        columns = columns * row[:, None]
        columns = columns - basis @ (basis.T @ columns)
        gain = np.maximum(columns.T @ rest, 0.0) ** 2 / np.maximum((columns**2).sum(0), 1e-9)
        self.x.toward = tried[int(np.argmax(gain))]

    def step(self, *, turn: bool = True) -> None:
        """One round: light with the albedo held, the dominant light's direction, weights, albedo."""
        target, row = self._target()
        value, gradient = self.sun(self.x.toward)
        matrix = np.column_stack([self.dome, value]) * row[:, None]
        width = self.dome.shape[1]
        grey = nonnegative_light(matrix, (target @ LUMINANCE) * row, width)
        tint = (target * row[:, None]).sum(0) / max(float(((target @ LUMINANCE) * row).sum()), 1e-12)
        even = EVEN_COLORS * self.residual() ** 2
        solved = np.stack(
            [nonnegative_light(matrix, target[:, c] * row, width, prior=grey * tint[c], trust=even) for c in range(3)],
            -1,
        )
        self.x.harmonics, self.x.irradiance = solved[:width], solved[width]
        if turn and self.x.irradiance.any():
            self._turn(gradient, row)
        self._reweight()
        self._set_albedo(self._quotient())
        self._normalize()

    def jacobian(self) -> np.ndarray:
        """Of the relative shading by harmonics, strength of the dominant light and its turns: ``[n, h + 3]``."""
        _, row = self._target()
        value, gradient = self.sun(self.x.toward)
        turns = float(self.x.irradiance @ LUMINANCE) * gradient @ tangents(self.x.toward).T
        return np.column_stack([self.dome, value, turns]) * row[:, None]

    def residual(self) -> float:
        """Weighted root mean square error of the shading, relative."""
        error = self._relative_error()
        return float(np.sqrt((self.weight * error**2).sum() / self.weight.sum()))

    def _whole(self) -> np.ndarray:
        """Irradiance that the photographs ask for, ``[n, 3]``; clipped ones ask for no less than that."""
        whole = np.pi * self.seen / self.x.albedo
        return np.where(self.clipped[:, None], np.maximum(whole, self.predicted()), whole)

    def _target(self) -> tuple[np.ndarray, np.ndarray]:
        """Irradiance that is to come from the light directly, and the weight of each row: errors are relative."""
        whole = self._whole()
        return whole * (1.0 - self.bounced), np.sqrt(self.weight) / np.maximum(whole @ LUMINANCE, 1e-9)

    def _quotient(self) -> np.ndarray:
        predicted = self.predicted()
        return np.pi * self.seen / np.maximum(predicted, 1e-3 * predicted.mean())

    def _relative_error(self) -> np.ndarray:
        whole = self._whole()
        return ((self.predicted() - whole) @ LUMINANCE) / np.maximum(whole @ LUMINANCE, 1e-9)

    def _turn(self, gradient: np.ndarray, row: np.ndarray) -> None:
        """A damped Gauss-Newton step of the direction; shorter until it helps."""
        across = tangents(self.x.toward)
        slope = gradient @ across.T * (float(self.x.irradiance @ LUMINANCE) * row)[:, None]
        error = self._relative_error() * np.sqrt(self.weight)
        normal = slope.T @ slope
        damping = 1e-3 * np.trace(normal) + 1e-12
        step = np.linalg.solve(normal + damping * np.eye(2), -slope.T @ error)
        step *= min(1.0, MOST_TURN / max(float(np.linalg.norm(step)), 1e-12))
        before, start = float((error**2).sum()), self.x.toward
        for _ in range(HALVINGS):
            turned = start + step @ across
            self.x.toward = turned / np.linalg.norm(turned)
            if float((self.weight * self._relative_error() ** 2).sum()) < before:
                return
            step = 0.5 * step
        self.x.toward = start

    def _reweight(self) -> None:
        error = self._relative_error()
        scale = max(TUKEY * float(np.median(np.abs(error))), LEAST_SCALE)
        self.weight = np.where(np.abs(error) < scale, (1.0 - (error / scale) ** 2) ** 2, 0.0)

    def _set_albedo(self, quotient: np.ndarray) -> None:
        """Each cluster's median."""
        for k in np.unique(self.cluster):
            mine = self.cluster == k
            trusted = mine & (self.weight > 0.1) & ~self.clipped
            self.x.albedo[mine] = np.median(quotient[trusted if trusted.any() else mine], axis=0)

    def _normalize(self) -> None:
        """Light white on average, lightest surfaces at LIGHTEST: light and albedo trade a factor per channel.

        The light that arrives directly, not what bounced: photographs are balanced for their lamps or their sky, and a
        wooden floor stays brown in them and colours what stands on it.
        """
        mean = (self.predicted() * (1.0 - self.bounced)).mean(0)
        factor = (mean @ LUMINANCE) / np.maximum(mean, 1e-12)
        lightest = np.percentile((self.x.albedo / factor) @ LUMINANCE, 99.0)
        factor = factor * lightest / LIGHTEST
        self.x.albedo = np.clip(self.x.albedo / factor, LOW, HIGH)
        self.x.harmonics, self.x.irradiance = self.x.harmonics * factor, self.x.irradiance * factor


def nonnegative_light(
    matrix: np.ndarray, target: np.ndarray, harmonics: int, *, prior: np.ndarray | None = None, trust: float = 0.0
) -> np.ndarray:
    """Least squares for a dome's harmonics and, in a last column if there is one, a light; neither takes light away.

    The harmonics beyond the constant one are drawn to 0 by a small ridge, and directions in which the dome is negative
    are drawn to 0 until hardly any is left. All are drawn to ``prior``, by ``trust`` of the matrix' mean diagonal.
    """
    normal, right = matrix.T @ matrix, matrix.T @ target
    unit = float(np.trace(normal)) / len(normal) + 1e-12
    if prior is not None:
        normal, right = normal + trust * unit * np.eye(len(normal)), right + trust * unit * prior
    basis = harmonics_of(fibonacci_sphere(GRID))[:, :harmonics]
    ridge = np.full(len(normal), RIDGE * unit)
    ridge[0], ridge[harmonics:] = 1e-6 * unit, 1e-6 * unit
    penalty = np.zeros((harmonics, harmonics))
    negative = np.zeros(GRID, bool)
    free = np.ones(len(normal), bool)
    x = np.zeros(len(normal))
    for _ in range(12):
        whole = normal + np.diag(ridge)
        whole[:harmonics, :harmonics] += penalty
        x = np.zeros(len(normal))
        x[free] = np.linalg.solve(whole[np.ix_(free, free)], right[free])
        below = basis @ x[:harmonics] < 0.0
        worse = (below & ~negative).any()
        negative |= below
        if (x[harmonics:] < 0.0).any():
            free[harmonics:], worse = False, True
        if not worse:
            break
        penalty = NEGATIVE * unit * basis[negative].T @ basis[negative] / GRID
    return x


def harmonics_of(d: np.ndarray) -> np.ndarray:
    """The harmonics of ``kernels.light_fit.harmonic`` for unit directions ``[..., 3]``: ``[..., 9]``."""
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    return np.stack(
        [
            np.full(x.shape, 0.28209479),
            0.48860251 * y,
            0.48860251 * z,
            0.48860251 * x,
            1.09254843 * x * y,
            1.09254843 * y * z,
            0.31539157 * (3.0 * z * z - 1.0),
            1.09254843 * x * z,
            0.54627421 * (x * x - y * y),
        ],
        -1,
    )


def fibonacci_sphere(count: int) -> np.ndarray:
    """Evenly spread unit directions ``[count, 3]`` (Gonzalez 2010)."""
    k = np.arange(count) + 0.5
    y, turn = 1.0 - 2.0 * k / count, k * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - y * y)
    return np.stack([radius * np.cos(turn), y, radius * np.sin(turn)], -1)


def tangents(direction: np.ndarray) -> np.ndarray:
    """Two unit vectors across a direction, ``[2, 3]``."""
    side = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    side = side / np.linalg.norm(side)
    return np.stack([side, np.cross(direction, side)])


def color_clusters(color: np.ndarray, seed: int, apart: float, lightness: float = 0.0) -> np.ndarray:
    """Which samples share a colour: k-means of the chromaticity, started as k-means++; centres nearer than ``apart``
    (in logarithms) are one. ``lightness``: weight of the logarithm of lightness beside chromaticity."""
    log = np.log(np.maximum(color, 1e-4))
    mean = log.mean(-1, keepdims=True)
    tint = np.concatenate([log - mean, lightness * mean], -1)
    rng = np.random.default_rng(seed)
    centers = tint[rng.integers(len(tint))][None]
    while len(centers) < CLUSTERS:
        far = ((tint[:, None] - centers) ** 2).sum(-1).min(1)
        if far.sum() <= 0.0:
            break
        centers = np.concatenate([centers, tint[rng.choice(len(tint), p=far / far.sum())][None]])
    label = np.zeros(len(tint), np.int64)
    for _ in range(20):
        label = ((tint[:, None] - centers) ** 2).sum(-1).argmin(1)
        centers = np.stack([tint[label == k].mean(0) if (label == k).any() else c for k, c in enumerate(centers)])
    near = np.linalg.norm(centers[:, None] - centers, axis=-1) < apart
    for _ in range(len(near)):  # chains of near centres are one
        near = near @ near
    return near.argmax(1)[label]

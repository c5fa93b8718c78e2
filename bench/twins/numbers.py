"""Twin of ``kernels/sampling.py``: the hash is exact, the warps are in double."""

from __future__ import annotations

import numpy as np

GOLDEN = 0x9E3779B9


def uint(values) -> np.ndarray:
    """As 32-bit numbers that wrap."""
    return np.asarray(values, np.int64).astype(np.uint32)


def hash1(x: np.ndarray) -> np.ndarray:
    """PCG's output permutation of one LCG step (Jarzynski and Olano 2020)."""
    with np.errstate(over="ignore"):
        state = x * np.uint32(747796405) + np.uint32(2891336453)
        word = ((state >> ((state >> np.uint32(28)) + np.uint32(4))) ^ state) * np.uint32(277803737)
    return (word >> np.uint32(22)) ^ word


def hash2(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hash of a pair."""
    with np.errstate(over="ignore"):
        return hash1(a ^ (hash1(b) + np.uint32(GOLDEN)))


def unit_float(bits: np.ndarray) -> np.ndarray:
    """The upper 24 bits in [0, 1)."""
    return (bits >> np.uint32(8)) / 2.0**24


def uniform2(seed: int, index, sample, dimension: int) -> np.ndarray:
    """Two independent numbers: ``[…, 2]``."""
    index, sample = np.broadcast_arrays(uint(index), uint(sample))
    key = hash2(hash2(hash2(uint(seed), index), sample), uint(dimension))
    return np.stack([unit_float(key), unit_float(hash1(key ^ np.uint32(0x68BC21EB)))], -1)


def reverse_bits(x: np.ndarray) -> np.ndarray:
    """The 32 bits in opposite order."""
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)):
        x = ((x >> np.uint32(shift)) & np.uint32(mask)) | ((x & np.uint32(mask)) << np.uint32(shift))
    return x


def owen_reversed(x: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Laine and Karras' permutation of the bit-reversed integer."""
    with np.errstate(over="ignore"):
        x = x + seed
        for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
            x = x ^ (x * np.uint32(factor))
    return x


def sobol2(seed: int, index, sample, dimension: int) -> np.ndarray:
    """Owen-scrambled Sobol' points (Burley 2020): ``[…, 2]``."""
    index, sample = np.broadcast_arrays(uint(index), uint(sample))
    key = hash2(hash2(uint(seed), index), uint(dimension))
    i = reverse_bits(owen_reversed(reverse_bits(sample), key))
    second = i
    for shift, mask in ((1, 0xAAAAAAAA), (2, 0xCCCCCCCC), (4, 0xF0F0F0F0), (8, 0xFF00FF00), (16, 0xFFFF0000)):
        second = second ^ ((second & np.uint32(mask)) >> np.uint32(shift))
    x = reverse_bits(owen_reversed(i, hash1(key ^ np.uint32(0xA511E9B3))))
    y = reverse_bits(owen_reversed(second, hash1(key ^ np.uint32(0x63D83595))))
    return np.stack([unit_float(x), unit_float(y)], -1)


def concentric_disk(xi: np.ndarray) -> np.ndarray:
    """Area-preserving map of the unit square to the unit disk (Shirley and Chiu 1997)."""
    a, b = 2.0 * xi[..., 0] - 1.0, 2.0 * xi[..., 1] - 1.0
    wide = np.abs(a) > np.abs(b)
    with np.errstate(divide="ignore", invalid="ignore"):
        phi = np.where(wide, 0.25 * np.pi * b / a, 0.5 * np.pi - 0.25 * np.pi * a / b)
    r = np.where(wide, a, b)
    phi = np.where(r == 0.0, 0.0, phi)
    return np.stack([r * np.cos(phi), r * np.sin(phi)], -1)


def cosine_hemisphere(xi: np.ndarray) -> np.ndarray:
    """Directions about +z with density cos / pi."""
    d = concentric_disk(xi)
    return np.concatenate([d, np.sqrt(np.maximum(0.0, 1.0 - (d**2).sum(-1, keepdims=True)))], -1)


def uniform_cone(xi: np.ndarray, height) -> np.ndarray:
    """Directions about +z, uniform over the cap of that height."""
    down = xi[..., 0] * height
    r, phi = np.sqrt(np.maximum(0.0, down * (2.0 - down))), 2.0 * np.pi * xi[..., 1]
    return np.stack([r * np.cos(phi), r * np.sin(phi), 1.0 - down], -1)


def from_frame(local: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Vectors about +z turned so that +z becomes ``n`` (Duff et al. 2017)."""
    sign = np.where(n[..., 2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + n[..., 2])
    t = np.stack([1.0 + sign * n[..., 0] ** 2 * a, sign * n[..., 0] * n[..., 1] * a, -sign * n[..., 0]], -1)
    return t * local[..., :1] + np.cross(n, t) * local[..., 1:2] + n * local[..., 2:]


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Along the last axis."""
    return (a * b).sum(-1)


def unit(v: np.ndarray) -> np.ndarray:
    """Normalised along the last axis."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)

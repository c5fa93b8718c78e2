"""Albedo of a scanned surface: what it sent to the camera over what fell on it.

With E the irradiance at a vertex and L the radiance that the photographs saw, a Lambertian surface has the albedo
pi L / E. Light that bounces depends on the albedo in turn, so both are found in turns; the direct part stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_dvct.capture.enclosure import Enclosure
from warp_dvct.capture.fusion import FusedMesh, open3d_for_reconstruction
from warp_dvct.capture.irradiance import Lighting, Receivers
from warp_dvct.capture.light_solver import HIGH, LOW
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.scene import Light

CLIPPED = 0.98  # of a photograph's white, from which a channel may have been anything brighter
ROUNDS = 4  # of albedo and bounced light; in a closed room, where the error is largest, it is 1 % then
CELL = 4.0  # voxels between the points at which bounced light is gathered: it is smooth
NEIGHBOURS = 6
FACING = 8.0  # exponent of the normals' cosine with which a gathered point counts for a vertex
SMOOTHING = 30  # Jacobi rounds over the mesh's edges
SAME_COLOR = 0.15  # difference of log colours of neighbours that is still texture of one surface
TRUST = 0.05  # share of the median irradiance at which a vertex counts as much as its surroundings


@dataclass(frozen=True)
class Albedo:
    """An estimate for each vertex.

    Attributes:
        values: Linear RGB in [LOW, HIGH], float32 ``[v, 3]``.
        irradiance: The irradiance that it was divided by [W m^-2], float32 ``[v, 3]``.
        bright, dark: Share of the vertices that the upper and the lower bound holds.
    """

    values: np.ndarray
    irradiance: np.ndarray
    bright: float
    dark: float


def estimate_albedo(
    launcher: Launcher,
    mesh: FusedMesh,
    lights: tuple[Light, ...],
    *,
    voxel: float,
    enclosure: Enclosure | None = None,
    threads: int | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Albedo:
    """Divide what the photographs saw by the irradiance that the passes of the renderer gather.

    Args:
        mesh: With colours, in the world of the lights. lights: In the photographs' units of radiance.
        voxel: Its resolution in metres.
        enclosure: What reflects light and was not seen; its albedo follows the mesh's.
    Raises:
        OptionError: The mesh has no colours, or no light reaches it.
    """
    if mesh.colors is None:
        raise OptionError("the capture has no photographs, so albedo cannot be estimated; use --albedo color")
    report = progress or (lambda name, share: None)
    seen = mesh.colors.astype(np.float64)
    everywhere = Receivers(mesh.points.astype(np.float64), unit(mesh.normals), 0.5 * voxel)
    chosen = thinned(mesh.points, CELL * voxel)
    some = Receivers(everywhere.points[chosen], everywhere.normals[chosen], everywhere.lift)
    spread = Spread.between(everywhere, some, threads)
    report("direct light", 0.0)
    albedo = np.clip(seen, LOW, HIGH)

    def lighting() -> Lighting:
        around = (mesh, albedo) if enclosure is None else enclosure.around(mesh, albedo)
        return Lighting(launcher, *around, lights)

    direct = lighting().direct(everywhere).astype(np.float64)
    total = direct
    for number in range(ROUNDS):
        report("bounced light", (number + 1.0) / (ROUNDS + 2.0))
        total = direct + spread(lighting().gathered(some))
        if float(total.max()) <= 0.0:
            raise OptionError("none of the lights reaches the surface; check where --probe puts them")
        found = np.clip(_quotient(seen, total, mesh.colors), LOW, HIGH)
        # The more a room reflects, the less albedo it takes: what is found swings around the answer.
        albedo = found if number == 0 else np.sqrt(albedo * found)
    report("smoothing", 1.0 - 1.0 / (ROUNDS + 2.0))
    albedo = _regularized(mesh, albedo, total)
    raw = np.pi * seen / np.maximum(total, 1e-12)
    return Albedo(
        values=np.clip(albedo, LOW, HIGH).astype(np.float32),
        irradiance=total.astype(np.float32),
        bright=float((raw > HIGH).any(-1).mean()),
        dark=float((raw < LOW).all(-1).mean()),
    )


def _quotient(seen: np.ndarray, total: np.ndarray, stored: np.ndarray) -> np.ndarray:
    """pi L / E, drawn to the surface's mean albedo where E is too small to tell."""
    floor = TRUST * np.median(total, axis=0)
    weight = total / (total + floor)
    plain = np.pi * seen / np.maximum(total, 1e-12)
    lit = (weight > 0.5).all(-1) & (stored < CLIPPED).all(-1)
    mean = np.median(np.clip(plain[lit], LOW, HIGH), axis=0) if lit.any() else np.full(3, 0.5)
    return weight * np.clip(plain, 0.0, 1.0) + (1.0 - weight) * mean


def _regularized(mesh: FusedMesh, albedo: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Even out albedo along the mesh's edges: between neighbours of like colour an abrupt change of the quotient is one
    of irradiance (the edge of a shadow, a voxel's noise), not of paint."""
    assert mesh.colors is not None
    edges = unique_edges(mesh.triangles)
    a, b = edges[:, 0], edges[:, 1]
    color = np.log(np.maximum(mesh.colors.astype(np.float64), 1e-3))
    tint = color - color.mean(-1, keepdims=True)
    like = np.exp(-((np.abs(tint[a] - tint[b]).max(-1) / SAME_COLOR) ** 2))
    like *= np.clip((mesh.normals[a] * mesh.normals[b]).sum(-1), 0.0, 1.0)
    count = len(mesh.points)
    # A clipped photograph says only that the albedo is at least that.
    known = (mesh.colors < CLIPPED).all(-1).astype(np.float64)
    known *= (total / (total + np.median(total, axis=0))).min(-1)
    weight = np.bincount(a, like, count) + np.bincount(b, like, count)
    value = albedo.copy()
    for _ in range(SMOOTHING):
        around = np.stack(
            [
                np.bincount(a, like * value[b, k], count) + np.bincount(b, like * value[a, k], count)
                for k in range(albedo.shape[1])
            ],
            -1,
        )
        value = (known[:, None] * albedo + around) / np.maximum(known + weight, 1e-12)[:, None]
        value = np.where((known + weight)[:, None] > 1e-9, value, albedo)
    return value


@dataclass(frozen=True)
class Spread:
    """Carries values from some points to all: a mean of the nearest ones that face the same way."""

    index: np.ndarray
    weight: np.ndarray

    @staticmethod
    def between(all_: Receivers, some: Receivers, threads: int | None) -> Spread:
        """Weights by distance and normal."""
        o3d: Any = open3d_for_reconstruction(threads)
        tensor = o3d.core.Tensor
        search = o3d.core.nns.NearestNeighborSearch(tensor(some.points.astype(np.float32)))
        search.knn_index()
        index, square = search.knn_search(tensor(all_.points.astype(np.float32)), min(NEIGHBOURS, len(some.points)))
        index, square = index.numpy(), square.numpy()
        facing = np.clip((all_.normals[:, None] * some.normals[index]).sum(-1), 0.0, 1.0) ** FACING
        near = 1.0 / (square + 1e-6 + 0.05 * square.mean())
        weight = near * (facing + 1e-6)
        return Spread(index, weight / weight.sum(-1, keepdims=True))

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Values ``[m, k]`` at some points to ``[n, k]`` at all."""
        return (values[self.index] * self.weight[..., None]).sum(1)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Normalised rows, float64."""
    vectors = np.asarray(vectors, np.float64)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def thinned(points: np.ndarray, cell: float) -> np.ndarray:
    """Indices of one point in each cell of a grid, the first one."""
    cells = np.floor(np.asarray(points, np.float64) / cell).astype(np.int64) + 2**20
    return np.unique((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2], return_index=True)[1]


def unique_edges(triangles: np.ndarray) -> np.ndarray:
    """Each edge of a mesh once, int ``[e, 2]``."""
    pairs = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    packed = np.unique((pairs[:, 0].astype(np.int64) << 32) | pairs[:, 1])
    return np.stack([packed >> 32, packed & 0xFFFFFFFF], -1)

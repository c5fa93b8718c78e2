"""Twins of the volume: cut triangles, injected flux, the lit field and its filtered levels, on dense grids."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.bench.twins.deviation import Deviation, compare
from warp_dvct.bench.twins.stage import MATERIALS, POINT, Twin, make_scene
from warp_dvct.bench.twins.surfaces import specular_albedo
from warp_dvct.kernels import bounces, injection, pyramid, voxelization
from warp_dvct.launch import Launcher
from warp_dvct.passes.bounces import mean_albedo
from warp_dvct.passes.injection import empty_flux, inject
from warp_dvct.passes.pyramid import build_pyramid, light_faces
from warp_dvct.passes.rsm import ShadowMaps, render_rsm
from warp_dvct.passes.voxels import Box, Voxels, unlit, voxelize
from warp_dvct.scene import Scene

N = 12
FACES = np.array([(s if k == axis else 0.0) for axis in range(3) for s in (1.0, -1.0) for k in range(3)]).reshape(6, 3)


def voxels_of(launcher: Launcher, twin: Twin) -> Voxels:
    """The scene in the unit cube."""

    corners = launcher.array(twin.corners.reshape(-1, 3).astype(np.float32), wp.vec3)
    sides = twin.device.geometry.double_sided
    box = Box((0.0, 0.0, 0.0), 1.0, N)
    return unlit(launcher, voxelize(launcher, corners, twin.device_normals(launcher), sides, twin.reals, box))


def cells(voxels: Voxels, level: int) -> np.ndarray:
    """Cell of each record of a level: int ``[records, 3]``; bricks of 8^3 voxels, x fastest in both."""
    key = voxels.level_keys[level].numpy()
    bricks = -(-(((voxels.box.n - 1) >> level) + 1) // 8)
    brick, cell = key >> 9, key & 511
    corner = np.stack([brick % bricks, brick // bricks % bricks, brick // bricks**2], 1) * 8
    return corner + np.stack([cell & 7, (cell >> 3) & 7, cell >> 6], 1)


def dense(voxels: Voxels, values: np.ndarray, level: int = 0) -> np.ndarray:
    """Values per record of a level on a grid ``[x, y, z, …]``, 0 in empty voxels."""
    extent = ((voxels.box.n - 1) >> level) + 1
    out = np.zeros((extent,) * 3 + values.shape[1:])
    out[tuple(cells(voxels, level).T)] = values
    return out


def fields(voxels: Voxels) -> list[np.ndarray]:
    """The field of each level on a grid: ``[x, y, z, face, solution, 4]``."""
    values = voxels.field().astype(np.float64)
    starts = np.cumsum([0, *voxels.level_records])
    return [dense(voxels, values[starts[k] : starts[k + 1]], k) for k in range(len(voxels.level_records))]


def clipped_area(triangle: np.ndarray, low: np.ndarray) -> float:
    """Area of a triangle inside of the unit cube at ``low`` (Sutherland and Hodgman 1974)."""
    polygon = [p - low for p in triangle]
    for axis in range(3):
        for bound, sign in ((0.0, -1.0), (1.0, 1.0)):
            kept = []
            for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
                dp, dq = sign * (bound - p[axis]), sign * (bound - q[axis])
                if dp >= 0:
                    kept.append(p)
                if dp * dq < 0:
                    kept.append(p + (q - p) * (dp / (dp - dq)))
            polygon = kept
            if not polygon:
                return 0.0
    fan = [np.cross(p - polygon[0], q - polygon[0]) for p, q in pairwise(polygon[1:])]
    return 0.5 * float(np.linalg.norm(np.sum(fan, 0)))


def face_areas(twin: Twin) -> np.ndarray:
    """Projected front-facing area, before and after, in voxel faces: ``[x, y, z, face, 2]``."""
    out = np.zeros((N, N, N, 6, 2))
    both = twin.device.double_sided
    for i, (triangle, normal) in enumerate(zip(twin.corners * N, twin.normals, strict=True)):
        low, high = np.floor(triangle.min(0)).astype(int), np.floor(triangle.max(0)).astype(int)
        shown = np.maximum(FACES @ normal, 0.0) + (np.maximum(-FACES @ normal, 0.0) if both[i] else 0.0)
        for cell in np.ndindex(*(np.minimum(high, N - 1) - low + 1)):
            at = tuple(low + cell)
            out[at][:, 1 if i >= twin.reals else 0] += clipped_area(triangle, np.array(at, float)) * shown
    real, synthetic = out[..., 0], out[..., 1].copy()
    out[..., 1] = np.minimum(real + synthetic, np.maximum(np.maximum(real, synthetic), 1.0))
    return out


def mean_albedos(twin: Twin) -> np.ndarray:
    """Of the real and the synthetic surfaces in each voxel, weighted by area: ``[x, y, z, 2, 3]``."""
    each = []
    for material in MATERIALS:
        f0 = np.full((1, 3), ((material.ior - 1.0) / (material.ior + 1.0)) ** 2)
        f90 = np.minimum(50.0 * f0[:, 0], 1.0)
        passed = 1.0 - f0 - (f90[:, None] - f0) / 21.0
        alpha = np.array([material.roughness**2])
        each.append((np.asarray(material.base_color) * passed**2 + specular_albedo(f0, f90, alpha))[0])
    total, area = np.zeros((N, N, N, 2, 3)), np.zeros((N, N, N, 2, 1))
    for i, triangle in enumerate(twin.corners * N):
        low, high = np.floor(triangle.min(0)).astype(int), np.floor(triangle.max(0)).astype(int)
        for cell in np.ndindex(*(np.minimum(high, N - 1) - low + 1)):
            at = tuple(low + cell)
            part = clipped_area(triangle, np.array(at, float))
            role = int(i >= twin.reals)
            total[at][role] += part * each[twin.device.material[i]]
            area[at][role] += part
    return np.where(area > 1e-6, total / np.where(area > 1e-6, area, 1.0), 0.0)


def measure_albedos(launcher: Any) -> list[Deviation]:
    """Mean albedo behind each record, of voxels that hold more than the rim of a surface."""
    twin = Twin.upload(launcher, make_scene(POINT))
    voxels = voxels_of(launcher, twin)
    got = mean_albedo(launcher, twin.device, voxels, twin.device_normals(launcher)).numpy()
    grid = dense(voxels, got[: 2 * voxels.level_records[0]].reshape(-1, 2, 3))
    expected = mean_albedos(twin)
    solid = (expected[..., 0].sum(-1) > 0.0) & (grid[..., 0].sum(-1) > 0.0)
    return [compare(bounces._mean_albedo, "albedo", grid[solid].reshape(-1, 6), expected[solid].reshape(-1, 6))]


def measure_voxels(launcher: Any) -> list[Deviation]:
    """Areas of all faces."""
    twin = Twin.upload(launcher, make_scene(POINT))
    voxels = voxels_of(launcher, twin)
    area = voxels.area.numpy()[: voxels.level_records[0] * 6].reshape(-1, 6, 2)
    got, expected = dense(voxels, area), face_areas(twin)
    return [compare(voxelization._sum_areas, "area", got.reshape(-1, 12), expected.reshape(-1, 12))]


def lit(launcher: Any, scene: Scene | None = None) -> tuple[Twin, Voxels, ShadowMaps, Any]:
    """The scene's voxels, the RSM pair of its light, and what is injected of it."""
    twin = Twin.upload(launcher, scene or make_scene(POINT))
    voxels = voxels_of(launcher, twin)
    maps = render_rsm(launcher, twin.device, 0, 64, center=(0.5, 0.5, 0.5), radius=0.8, start=2.0)
    flux = empty_flux(launcher, voxels)
    inject(launcher, voxels, maps, flux)
    light_faces(launcher, voxels, flux)
    build_pyramid(launcher, voxels)
    return twin, voxels, maps, flux


def inject_one(out: np.ndarray, area: np.ndarray, maps: ShadowMaps, name: str, solution: int, chosen: np.ndarray):
    """Add texels of one map to one solution: flux by max(0, n . e), over the area of a voxel's face."""
    position, normal, flux = (
        getattr(maps, f"{what}_{name}").numpy()[chosen].astype(float) for what in ("position", "normal", "flux")
    )
    share = np.maximum(normal @ FACES.T, 0.0)
    left = np.ones(len(position), bool)
    for nudge in (0.0, -0.3, 0.3):
        cell = np.floor(position * N + nudge * normal).astype(int)
        inside = np.all((cell >= 0) & (cell < N), 1)
        cell = np.clip(cell, 0, N - 1)
        shown = (share * area[tuple(cell.T)][..., solution]).sum(-1) > 0.0
        here = left & inside & shown
        at: Any = (*cell[here].T, slice(None), solution)
        np.add.at(out, at, share[here, :, None] * flux[here, None] * N**2)
        left &= ~here


def measure_injection(launcher: Any) -> list[Deviation]:
    """The split-injection of a map pair (Franke 2014, eq. 2), from the kernels' own texels and areas."""
    _, voxels, maps, flux = lit(launcher)
    area = dense(voxels, voxels.area.numpy()[: voxels.level_records[0] * 6].reshape(-1, 6, 2))
    after, before = maps.role_after.numpy(), maps.role_before.numpy()
    out = np.zeros((N, N, N, 6, 2, 3))
    inject_one(out, area, maps, "after", 1, after >= 0)
    both = (after == 0) & (before == 0)
    # Where both maps see one surface, the texel goes to one record, which the areas after choose.
    chosen = np.zeros((N, N, N, 6, 2, 3))
    inject_one(chosen, area, maps, "after", 1, both)
    out[..., 0, :] += chosen[..., 1, :]
    inject_one(out, area, maps, "before", 0, (before >= 0) & (after != 0))
    got = dense(voxels, flux.numpy()[: voxels.level_records[0] * 12].reshape(-1, 6, 2, 3))
    return [compare(injection._inject, "flux", got.reshape(-1, 36), out.reshape(-1, 36))]


def next_level(fine: np.ndarray) -> np.ndarray:
    """Pairs along a face's axis composited front over back, the mean of the four pairs."""
    n = fine.shape[0]
    extent = (n + 1) // 2
    padded = np.zeros((2 * extent,) * 3 + fine.shape[3:])
    padded[:n, :n, :n] = fine
    out = np.zeros((extent,) * 3 + fine.shape[3:])
    for face in range(6):
        axis = face // 2
        even, odd = (np.take(padded[..., face, :, :], np.arange(k, 2 * extent, 2), axis) for k in (0, 1))
        front, back = (odd, even) if face % 2 == 0 else (even, odd)
        with np.errstate(divide="ignore", invalid="ignore"):
            visible = np.where(back[..., 3:] > 0, np.clip((1.0 - front[..., 3:]) / back[..., 3:], 0, 1), 0)
        both = front + back * visible
        shape = [m for k in range(3) for m in ((extent, 2) if k != axis else (extent, 1))]
        out[..., face, :, :] = both.reshape(*shape, *both.shape[3:]).mean((1, 3, 5))
    return out


def measure_pyramid(launcher: Any) -> list[Deviation]:
    """Level 0 from areas and flux, and each further level from the kernels' own last one."""
    _, voxels, _, flux = lit(launcher)
    count = voxels.level_records[0]
    area = dense(voxels, voxels.area.numpy()[: count * 6].reshape(-1, 6, 2))[..., None]
    power = dense(voxels, flux.numpy()[: count * 12].reshape(-1, 6, 2, 3))
    alpha = np.minimum(area, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        color = np.where(area > 0.0, power * alpha / area, 0.0)
    levels = fields(voxels)
    rows = [compare(pyramid._light_faces, "field", levels[0], np.concatenate([color, alpha], -1))]
    got = np.concatenate([level.reshape(-1, 48) for level in levels[1:]])
    twin = np.concatenate([next_level(level).reshape(-1, 48) for level in levels[:-1]])
    return [*rows, compare(pyramid._filter_level, "field, all levels", got, twin)]

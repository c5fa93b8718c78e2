"""Points on surfaces, for imperfect shadow maps and further bounces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import ism as kernels
from warp_dvct.kernels.ism import Cloud, Pieces
from warp_dvct.launch import Launcher
from warp_dvct.passes.vpls import Region
from warp_dvct.scene import Role

PIECE_SIZE = 0.35  # largest edge of a piece, in distances from the focus: what is far off is drawn from more coarsely
MOST_PIECES = 200_000


@dataclass(frozen=True)
class SurfacePoints:
    """The two clouds. ``real`` and ``synthetic`` are ``kernels.ism.Cloud``; a count of 0 where there is no surface."""

    real: Any
    synthetic: Any


def sample_surfaces(
    launcher: Launcher, scene: DeviceScene, region: Region, *, block: int, blocks: int, seed: int
) -> SurfacePoints:
    """Draw ``block * blocks`` points on real and as many on synthetic surfaces.

    Points are drawn by area, real surfaces more thinly the farther they are from the focus, as 1 / (1 + (d / R)²), so
    that a large ground does not take them all. What lies outside of the region gets none.

    Args:
        block: Points that one VPL uses; powers of two are stratified best.
    """
    synthetic_first = scene.synthetic_first
    ranges = ((Role.REAL, 0, synthetic_first), (Role.SYNTHETIC, synthetic_first, len(scene.triangles_vs)))
    clouds = []
    for role, low, high in ranges:
        triangles = np.asarray(scene.triangles_vs[low:high], np.float64)
        pieces = _pieces(triangles, low, region, thin=role == Role.REAL)
        count = block * blocks if pieces is not None else 0
        cloud = _new_cloud(launcher, count, block)
        if pieces is not None:
            launcher.launch(
                kernels._sample_surface,
                count,
                [_upload(launcher, pieces), scene.geometry, scene.materials, int(role), block, seed],
                [cloud],
            )
        clouds.append(cloud)
    return SurfacePoints(*clouds)


def cloud_from_points(
    launcher: Launcher, positions: np.ndarray, normals: np.ndarray, radii: np.ndarray, *, role: Role, block: int
) -> Any:
    """A cloud from given points, as a scan or a ``UsdGeom.Points`` has them.

    Args:
        positions, normals: ``[n, 3]``, volume space; unit normals.
        radii: ``[n]``, the radius that a point stands for among all ``n`` (half of ``UsdGeom.Points.widths``).
        block: Points that one VPL uses; at most ``n``.
    Raises:
        ValueError: The arrays differ in length, or ``block`` is not in 1 … n.
    """
    count = len(positions)
    if len(normals) != count or len(radii) != count or not 1 <= block <= count:
        raise ValueError(f"{count} positions, {len(normals)} normals, {len(radii)} radii; a block is {block} of them")
    # A block takes every so-many-th point, so that neighbours in the file do not all go to one VPL.
    blocks = count // block
    order = np.arange(blocks * block).reshape(block, blocks).T.ravel()
    cloud = Cloud()
    cloud.count, cloud.block = blocks * block, block
    cloud.position = launcher.array(np.asarray(positions, np.float32)[order], wp.vec3)
    cloud.normal = launcher.array(np.asarray(normals, np.float32)[order], wp.vec3)
    radius = np.asarray(radii, np.float32)[order]
    cloud.radius = launcher.array(radius * np.sqrt(np.float32(count / block)), wp.float32)
    cloud.area = launcher.array((np.pi * radius**2).astype(np.float32), wp.float32)
    cloud.albedo = launcher.zeros(len(order), wp.vec3)
    cloud.synthetic = launcher.full(len(order), int(role), wp.int32)
    return cloud


def _new_cloud(launcher: Launcher, count: int, block: int) -> Any:
    cloud = Cloud()
    cloud.count, cloud.block = count, block
    for name, variable in Cloud.vars.items():
        if name not in ("count", "block"):
            setattr(cloud, name, launcher.zeros(max(1, count), variable.type.dtype))
    return cloud


@dataclass(frozen=True)
class _HostPieces:
    triangle: np.ndarray
    corners: np.ndarray  # [n, 3, 2], weights of the triangle's first two corners
    area: np.ndarray
    weight: np.ndarray


def _pieces(triangles: np.ndarray, first: int, region: Region, *, thin: bool) -> _HostPieces | None:
    """Triangles cut until they are small for their distance from the focus; those outside of the region left out."""
    index = np.arange(len(triangles))
    corners = np.broadcast_to(np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]), (len(triangles), 3, 2)).copy()
    focus, center = np.asarray(region.focus), np.asarray(region.center)
    done: list[tuple[np.ndarray, np.ndarray]] = []
    held = 0
    while len(index):
        points = _points(triangles, index, corners)
        middle = points.mean(1)
        size = np.linalg.norm(points - np.roll(points, 1, 1), axis=-1).max(1)
        inside = np.linalg.norm(middle - center, axis=-1) < region.radius + size
        limit = PIECE_SIZE * np.maximum(np.linalg.norm(middle - focus, axis=-1), region.focus_radius)
        split = inside & thin & (size > limit)
        if held + 4 * int(split.sum()) > MOST_PIECES:
            split[:] = False
        keep = inside & ~split
        done.append((index[keep], corners[keep]))
        held += int(keep.sum())
        index = np.repeat(index[split], 4)
        corners = _quarters(corners[split])
    index, corners = (np.concatenate(parts) for parts in zip(*done, strict=True)) if done else (index, corners)
    points = _points(triangles, index, corners)
    area = 0.5 * np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=-1)
    distance = np.linalg.norm(points.mean(1) - focus, axis=-1) / region.focus_radius
    weight = area / (1.0 + distance**2) if thin else area
    if not len(index) or weight.sum() <= 0.0:
        return None
    return _HostPieces(index + first, corners, area, weight)


def _points(triangles: np.ndarray, index: np.ndarray, corners: np.ndarray) -> np.ndarray:
    weights = np.concatenate([corners, 1.0 - corners.sum(-1, keepdims=True)], -1)
    return np.einsum("nck,nkd->ncd", weights, triangles[index])


def _quarters(corners: np.ndarray) -> np.ndarray:
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    parts = [np.stack(p, 1) for p in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.stack(parts, 1).reshape(-1, 3, 2)


def _upload(launcher: Launcher, host: _HostPieces) -> Any:
    pieces = Pieces()
    pieces.count = len(host.triangle)
    pieces.triangle = launcher.array(host.triangle.astype(np.int32), wp.int32)
    for k, name in enumerate("abc"):
        setattr(pieces, name, launcher.array(host.corners[:, k].astype(np.float32), wp.vec2))
    cdf = np.concatenate([[0.0], np.cumsum(host.weight) / host.weight.sum()])
    cdf[-1] = 1.0
    pieces.cdf = launcher.array(cdf, wp.float64)
    pieces.area = launcher.array(host.area.astype(np.float32), wp.float32)
    return pieces

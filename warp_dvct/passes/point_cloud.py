"""Points on surfaces, for imperfect shadow maps and further bounces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import ism as kernels
from warp_dvct.kernels.ism import Cloud, Dots, Pieces
from warp_dvct.launch import Launcher
from warp_dvct.passes.vpls import Region
from warp_dvct.scene import PointCloud, Role

PIECE_SIZE = 0.35  # largest edge of a piece, in distances from the focus: what is far off is drawn from more coarsely
MOST_PIECES = 200_000


@dataclass(frozen=True)
class SurfacePoints:
    """The two clouds, ``kernels.ism.Cloud``; a count of 0 where there is no surface.

    ``real_order`` and ``synthetic_order`` list their points along a curve that keeps neighbours together.
    """

    real: Any
    synthetic: Any
    real_order: np.ndarray
    synthetic_order: np.ndarray


def sample_surfaces(
    launcher: Launcher,
    scene: DeviceScene,
    region: Region,
    *,
    block: int,
    blocks: int,
    seed: int,
    scans: Sequence[PointCloud] = (),
) -> SurfacePoints:
    """Draw ``block * blocks`` points on real and as many on synthetic surfaces.

    Points are drawn by area, real surfaces more thinly the farther they are from the focus, as 1 / (1 + (d / R)²), so
    that a large ground does not take them all. What lies outside of the region gets none.

    Args:
        block: Points that one VPL uses; powers of two are stratified best.
        scans: Points that are given; they are drawn by the area of their discs and taken as they are.
    """
    synthetic_first = scene.synthetic_first
    ranges = ((Role.REAL, 0, synthetic_first), (Role.SYNTHETIC, synthetic_first, len(scene.triangles_vs)))
    clouds = []
    for role, low, high in ranges:
        triangles = np.asarray(scene.triangles_vs[low:high], np.float64)
        # What stands for given points has no area here: the points themselves are drawn from.
        triangles[scene.scanned[low:high] == 1] = triangles[scene.scanned[low:high] == 1][:, :1]
        dots = _HostDots.gather([c for c in scans if c.role == role], scene, region)
        pieces = _pieces(triangles, low, dots, region, thin=role == Role.REAL)
        count = block * blocks if pieces is not None else 0
        cloud = _new_cloud(launcher, count, block)
        if pieces is not None:
            launcher.launch(
                kernels._sample_surface,
                count,
                [
                    _upload(launcher, pieces),
                    dots.upload(launcher),
                    scene.geometry,
                    scene.materials,
                    int(role),
                    block,
                    seed,
                ],
                [cloud],
            )
        clouds.append(cloud)
    return SurfacePoints(*clouds, *(_curve(c.position.numpy()[: c.count].astype(np.float64)) for c in clouds))


def _new_cloud(launcher: Launcher, count: int, block: int) -> Any:
    cloud = Cloud()
    cloud.count, cloud.block = count, block
    for name, variable in Cloud.vars.items():
        if name not in ("count", "block"):
            setattr(cloud, name, launcher.zeros(max(1, count), variable.type.dtype))
    return cloud


@dataclass(frozen=True)
class _HostPieces:
    triangle: np.ndarray  # or -1 - the index of a dot
    corners: np.ndarray  # [n, 3, 2], weights of the triangle's first two corners
    area: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class _HostDots:
    """Given points inside of the region, in volume space, along a curve that keeps neighbours together."""

    position: np.ndarray  # float64 [n, 3]
    normal: np.ndarray
    radius: np.ndarray
    material: np.ndarray
    color: np.ndarray

    @staticmethod
    def gather(scans: Sequence[PointCloud], scene: DeviceScene, region: Region) -> _HostDots:
        def joined(values: list[np.ndarray], *shape: int) -> np.ndarray:
            return np.concatenate([np.zeros((0, *shape)), *values])

        position = joined([(c.points - scene.origin) * scene.scale for c in scans], 3)
        white = [np.ones((len(c.points), 3)) if c.colors is None else c.colors for c in scans]
        inside = np.linalg.norm(position - np.asarray(region.center), axis=-1) < region.radius
        chosen = np.flatnonzero(inside)
        chosen = chosen[_curve(position[chosen])]
        return _HostDots(
            position[chosen],
            joined([c.normals for c in scans], 3)[chosen],
            joined([c.radii * scene.scale for c in scans])[chosen],
            joined([np.full(len(c.points), c.material) for c in scans])[chosen],
            joined(white, 3)[chosen],
        )

    def upload(self, launcher: Launcher) -> Any:
        dots = Dots()
        for name in ("position", "normal", "color"):
            setattr(dots, name, launcher.array(getattr(self, name).astype(np.float32), wp.vec3))
        dots.radius = launcher.array(self.radius.astype(np.float32), wp.float32)
        dots.material = launcher.array(self.material.astype(np.int32), wp.int32)
        return dots


def _curve(position: np.ndarray) -> np.ndarray:
    """Order of points along Morton's curve, which visits a grid of 1024 cells an edge octant by octant."""
    if not len(position):
        return np.zeros(0, np.int64)
    low, extent = position.min(0), np.ptp(position, axis=0).max()
    cell = np.minimum((position - low) / max(extent, 1e-300) * 1024, 1023).astype(np.int64)
    for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
        cell = (cell | (cell << shift)) & mask
    return np.argsort(cell @ np.array([1, 2, 4]), kind="stable")


def _pieces(triangles: np.ndarray, first: int, dots: _HostDots, region: Region, *, thin: bool) -> _HostPieces | None:
    """Triangles cut until they are small for their distance from the focus, and dots; None where there is nothing.

    Triangles outside of the region are left out.
    """
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
    middle = np.concatenate([points.mean(1), dots.position])
    area = np.concatenate([area, np.pi * dots.radius**2])
    distance = np.linalg.norm(middle - focus, axis=-1) / region.focus_radius
    weight = area / (1.0 + distance**2) if thin else area
    if weight.sum() <= 0.0:
        return None
    index = np.concatenate([index + first, -1 - np.arange(len(dots.position))])
    corners = np.concatenate([corners, np.zeros((len(dots.position), 3, 2))])
    return _HostPieces(index, corners, area, weight)


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

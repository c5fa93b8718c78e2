"""A depth image as a triangle mesh: the grid of its pixels, cut at depth jumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.scene import Mesh, Role

# Corners of a quad of pixels in the order top left, top right, bottom left, bottom right; its two triangles, which run
# counter-clockwise seen from the camera (whose v axis points down).
TRIANGLES = ((0, 2, 1), (1, 2, 3))


@dataclass(frozen=True)
class GridLimits:
    """When two neighbours of the grid are on one surface: their inverse depths differ by at most
    ``(fixed + share * inverse depth) * stride``.

    Attributes:
        fixed: [1/m]. share: Of the nearer one's inverse depth.
    """

    fixed: float
    share: float

    def joined(self, a: np.ndarray, b: np.ndarray, stride: int) -> np.ndarray:
        """Whether pixels with inverse depths ``a`` and ``b`` are, elementwise."""
        near = np.maximum(a, b)
        return (a > 0.0) & (b > 0.0) & (np.abs(a - b) <= (self.fixed + self.share * near) * stride)


@dataclass(frozen=True)
class Grid:
    """Vertices and triangles in camera axes (OpenCV).

    Attributes:
        points: float64 ``[v, 3]``. normals: float32 ``[v, 3]``, unit.
        pixels: Pixel coordinates of each vertex, float64 ``[v, 2]``.
        source: Index into the image, row by row, of the pixel whose surface a vertex is on, ``[v]``.
        triangles: int32 ``[t, 3]``.
    """

    points: np.ndarray
    normals: np.ndarray
    pixels: np.ndarray
    source: np.ndarray
    triangles: np.ndarray


def depth_grid(inverse: np.ndarray, normals: np.ndarray, lens: Intrinsics, limits: GridLimits, stride: int = 1) -> Grid:
    """Join every ``stride``-th pixel to triangles.

    At a depth jump the farther surface is continued to the nearer one's last vertices, so that from the camera no gap
    is seen between both. Pixels without depth leave holes.

    Args:
        inverse: 1 / depth [1/m], ``[h, w]``; 0 where nothing is known.
        normals: Unit normals towards the camera, ``[h, w, 3]``; 0 where there is none.
        lens: Without distortion.
        limits: When neighbours are joined.
        stride: Pixels between vertices.
    """
    rows = np.arange(0, lens.height, stride)
    columns = np.arange(0, lens.width, stride)
    rho = inverse[np.ix_(rows, columns)].astype(np.float64)
    source = (rows[:, None] * lens.width + columns).astype(np.int64)
    number = np.arange(rho.size).reshape(rho.shape)
    quad = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]], -1).reshape(-1, 4)
    corner = rho.ravel()[quad]
    kept = []
    for a, b, c in TRIANGLES:
        joined = limits.joined(corner[:, a], corner[:, b], stride)
        joined &= limits.joined(corner[:, b], corner[:, c], stride) & limits.joined(corner[:, a], corner[:, c], stride)
        kept.append(joined)
    triangles = [quad[joined][:, list(t)] for joined, t in zip(kept, TRIANGLES, strict=True)]
    torn = ~(kept[0] & kept[1]) & (corner > 0.0).all(-1)
    extra, extra_rho, extra_source = _continue_behind(quad[torn], corner[torn], source.ravel(), limits, stride)
    if len(extra):
        triangles += [(rho.size + extra)[:, list(t)] for t in TRIANGLES]
    place = np.concatenate([source.ravel(), source.ravel()[quad[torn]].ravel()])
    pixels = np.stack([place % lens.width, place // lens.width], -1).astype(np.float64)
    owner = np.concatenate([source.ravel(), extra_source])
    depth = np.concatenate([rho.ravel(), extra_rho])
    faces = np.concatenate(triangles).astype(np.int32)
    used, faces = np.unique(faces, return_inverse=True)
    pixels, owner, depth = pixels[used], owner[used], depth[used]
    rays = np.stack([(pixels[:, 0] - lens.cx) / lens.fx, (pixels[:, 1] - lens.cy) / lens.fy, np.ones(len(pixels))], -1)
    points = rays / depth[:, None]
    normal = normals.reshape(-1, 3)[owner]
    missing = np.linalg.norm(normal, axis=-1) < 0.5
    normal[missing] = -(rays / np.linalg.norm(rays, axis=-1, keepdims=True))[missing]
    return Grid(points, normal.astype(np.float32), pixels, owner, faces.reshape(-1, 3).astype(np.int32))


def _continue_behind(
    quad: np.ndarray, corner: np.ndarray, source: np.ndarray, limits: GridLimits, stride: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Four vertices for each torn quad on its farthest surface: indices ``[q, 4]``, inverse depths, and pixels whose
    surface they are on, flat."""
    count = len(quad)
    far = corner.min(-1, keepdims=True)
    on_far = limits.joined(corner, np.broadcast_to(far, corner.shape), stride)
    mean = (corner * on_far).sum(-1, keepdims=True) / np.maximum(on_far.sum(-1, keepdims=True), 1)
    rho = np.where(on_far, corner, mean)
    owner = np.where(on_far, source[quad], source[np.take_along_axis(quad, corner.argmin(-1)[:, None], 1)])
    return np.arange(4 * count).reshape(count, 4), rho.ravel(), owner.ravel()


def grid_mesh(grid: Grid, pose: np.ndarray, material: int, uvs: np.ndarray | None, path: str) -> Mesh:
    """The grid as a real mesh in the world.

    Args:
        pose: Camera (OpenCV axes) to world, 4x4.
        material: Index into the scene's materials.
        uvs: Texture coordinates per vertex, ``[v, 2]``, or None.
    """
    return Mesh(
        points=grid.points @ pose[:3, :3].T + pose[:3, 3],
        triangles=grid.triangles,
        materials=np.full(len(grid.triangles), material, np.int32),
        role=Role.REAL,
        double_sided=True,
        corner_normals=(grid.normals @ pose[:3, :3].T).astype(np.float32)[grid.triangles],
        corner_uvs=None if uvs is None else uvs.astype(np.float32)[grid.triangles],
        path=path,
    )

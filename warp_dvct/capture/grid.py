"""A depth image as a triangle mesh: fine where the surface bends or ends, coarse where it is flat.

Right-triangulated irregular network (Evans, Kirkpatrick and Townsend 2001): triangles are halved at the middle of their
longest side until each such middle lies close enough. Errors are those of inverse depth, in which planes are exact.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.scene import Mesh, Role

ASIDE = np.array([0.017, 0.011])  # pixels off the centres: rays through centres that ran along edges would miss some
UNDER = 0.25  # pixels that a farther surface goes on below the nearer one's edge
OUTER = 0.53  # pixels by which a surface goes on past the centres of its outermost pixels: to their edges
BLOCK = 32  # pixels an edge of the largest pair of triangles


@dataclass(frozen=True)
class GridLimits:
    """When neighbours are on one surface, and how close triangles follow it.

    Two neighbours are on one surface where their inverse depths differ by at most ``fixed + share * inverse depth``.

    Attributes:
        fixed: [1/m]. share: Of the nearer one's inverse depth.
        tolerance: Of inverse depth [1/m].
        slide: Pixels by which what is interpolated over a triangle (a texture's coordinates) may be off: linear in
            space is not linear in the picture where depth changes.
    """

    fixed: float
    share: float
    tolerance: float
    slide: float = 0.5

    def joined(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Whether neighbours with inverse depths ``a`` and ``b`` are on one surface, elementwise."""
        return (a > 0.0) & (b > 0.0) & (np.abs(a - b) <= self.fixed + self.share * np.maximum(a, b))


@dataclass(frozen=True)
class Grid:
    """Vertices and triangles in camera axes (OpenCV).

    Attributes:
        points: float64 ``[v, 3]``. normals: float32 ``[v, 3]``, unit, towards the camera.
        pixels: Pixel coordinates of each vertex, float64 ``[v, 2]``.
        source: Index into the image, row by row, of the pixel whose surface a vertex is on, ``[v]``.
        triangles: int32 ``[t, 3]``, counter-clockwise seen from the camera.
    """

    points: np.ndarray
    normals: np.ndarray
    pixels: np.ndarray
    source: np.ndarray
    triangles: np.ndarray


def depth_grid(inverse: np.ndarray, normals: np.ndarray, lens: Intrinsics, limits: GridLimits) -> Grid:
    """Join pixels to triangles.

    At a depth jump the farther surface is continued to the nearer one's last vertices, so that from the camera no gap
    is seen between both. Pixels without depth leave holes.

    Args:
        inverse: 1 / depth [1/m], ``[h, w]``; 0 where nothing is known.
        normals: Unit normals towards the camera, ``[h, w, 3]``; 0 where there is none.
        lens: Without distortion.
        limits: When pixels are joined, and how closely.
    """
    rho = _padded(inverse)
    width = rho.shape[1]
    corners = _refined(rho, _errors(rho, limits) > 1.0)
    number = corners[..., 1] * width + corners[..., 0]
    flat = rho.ravel()
    whole = (flat[number] > 0.0).all(-1)
    small = np.ptp(corners, axis=1).max(-1) == 1  # larger ones are in one piece, or they would have been halved
    number, small = number[whole], small[whole]
    number = number[~small | _one_surface(flat[number], limits)]
    extra, extra_pixels, extra_rho, extra_owner = _continued(rho, limits)
    triangles = np.concatenate([number, rho.size + extra])
    # Only what a triangle uses becomes a vertex.
    used, triangles = np.unique(triangles, return_inverse=True)
    centers = np.stack([np.arange(rho.size) % width, np.arange(rho.size) // width], -1).astype(np.float64)
    shift, bent = _outward(rho, limits)
    pixels = np.concatenate([centers + shift.reshape(-1, 2), extra_pixels])[used] + ASIDE
    owner = np.concatenate([np.arange(rho.size), extra_owner])[used]
    depth = np.concatenate([bent.ravel(), extra_rho])[used]
    source = np.minimum(owner // width, lens.height - 1) * lens.width + np.minimum(owner % width, lens.width - 1)
    rays = np.stack([(pixels[:, 0] - lens.cx) / lens.fx, (pixels[:, 1] - lens.cy) / lens.fy, np.ones(len(pixels))], -1)
    normal = normals.reshape(-1, 3)[source].astype(np.float64)
    missing = np.linalg.norm(normal, axis=-1) < 0.5
    normal[missing] = -(rays / np.linalg.norm(rays, axis=-1, keepdims=True))[missing]
    return Grid(
        rays / depth[:, None], normal.astype(np.float32), pixels, source, triangles.reshape(-1, 3).astype(np.int32)
    )


def _padded(inverse: np.ndarray) -> np.ndarray:
    """The image with unknown pixels at its right and bottom, so that it is whole blocks and one pixel."""
    height, width = inverse.shape
    down, right = -(height - 1) % BLOCK, -(width - 1) % BLOCK
    return np.pad(inverse.astype(np.float64), ((0, down), (0, right)))


def _levels() -> Iterator[int]:
    """Half edges of cells, from the finest: 1, 2, 4 ... BLOCK / 2."""
    half = 1
    while half < BLOCK:
        yield half
        half *= 2


def _errors(rho: np.ndarray, limits: GridLimits) -> np.ndarray:
    """How far each pixel, as the middle of a longest side, or any pixel in the triangles that it splits, is off, in
    what is tolerated."""
    margin = BLOCK
    error = np.zeros((rho.shape[0] + 2 * margin, rho.shape[1] + 2 * margin))

    def at(first_y: int, first_x: int, step: int, count: tuple[int, ...]) -> np.ndarray:
        y, x = first_y + margin, first_x + margin
        return error[y : y + step * count[0] : step, x : x + step * count[1] : step]

    torn = _beside_tear(rho, limits)
    for half in _levels():
        step, quarter = 2 * half, half // 2
        corner = rho[::step, ::step]
        for middle, a, b, y, x in (
            (rho[::step, half::step], corner[:, :-1], corner[:, 1:], 0, half),
            (rho[half::step, ::step], corner[:-1], corner[1:], half, 0),
        ):
            found = _middle_error(a, middle, b, half, limits)
            if half == 1:
                found[torn[y::2, x::2]] = np.inf
            if quarter:
                for dy, dx in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
                    found = np.maximum(found, at(y + dy * quarter, x + dx * quarter, step, found.shape))
            at(y, x, step, found.shape)[:] = found
        middle = rho[half::step, half::step]
        falling = _falling(middle.shape)
        a = np.where(falling, corner[:-1, :-1], corner[:-1, 1:])
        b = np.where(falling, corner[1:, 1:], corner[1:, :-1])
        found = _middle_error(a, middle, b, half * np.sqrt(2.0), limits)
        if half == 1:
            found[torn[1::2, 1::2]] = np.inf
        for dy, dx in ((-half, 0), (half, 0), (0, -half), (0, half)):
            found = np.maximum(found, at(half + dy, half + dx, step, found.shape))
        at(half, half, step, found.shape)[:] = found
    return error[margin:-margin, margin:-margin]


def _beside_tear(rho: np.ndarray, limits: GridLimits) -> np.ndarray:
    """Pixels with a neighbour to a side that is on another surface, or of which one is unknown."""
    torn = np.zeros(rho.shape, bool)
    for one, other in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        apart = ~limits.joined(rho[one], rho[other]) & ((rho[one] > 0.0) | (rho[other] > 0.0))
        torn[one] |= apart
        torn[other] |= apart
    return torn


def _outward(rho: np.ndarray, limits: GridLimits) -> tuple[np.ndarray, np.ndarray]:
    """How far the outermost pixels of a surface move their vertices, ``[h, w, 2]``, towards unknown pixels, farther
    surfaces and the image's edge; and the inverse depth there, on the line from the pixel on the other side."""
    shift, bent = np.zeros((*rho.shape, 2)), rho.copy()
    padded = np.pad(rho, 1)
    height, width = rho.shape
    for axis, dx, dy in ((0, 1, 0), (0, -1, 0), (1, 0, 1), (1, 0, -1)):
        other = padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        ends = (rho > 0.0) & (other < rho) & ~limits.joined(rho, other)
        shift[..., axis] += (dx + dy) * OUTER * ends
        inner = padded[1 - dy : 1 - dy + height, 1 - dx : 1 - dx + width]
        bent += np.where(ends & limits.joined(rho, inner), OUTER * (rho - inner), 0.0)
    return shift, bent


def _middle_error(a: np.ndarray, middle: np.ndarray, b: np.ndarray, reach: float, limits: GridLimits) -> np.ndarray:
    """Of a middle between the ends of a side, in what is tolerated; infinite where one of the three is unknown.

    Args:
        reach: Pixels from the middle to the ends. In space the middle lies at the share (1 / a) / (1 / a + 1 / b).
    """
    known = (a > 0.0).astype(np.int8) + (middle > 0.0) + (b > 0.0)
    slide = reach * np.abs(a - b) / np.maximum(a + b, 1e-12)
    error = np.maximum(np.abs(0.5 * (a + b) - middle) / limits.tolerance, slide / limits.slide)
    return np.where(known == 3, error, np.where(known == 0, 0.0, np.inf))


def _falling(shape: tuple[int, ...]) -> np.ndarray:
    """Which cells are split from top left to bottom right: every other one."""
    y, x = np.indices(shape)
    return (x + y) % 2 == 0


def _refined(rho: np.ndarray, split: np.ndarray) -> np.ndarray:
    """Halve the triangles of all blocks at the middles that ask for it: pixels ``[t, 3, 2]`` as (x, y)."""
    rows, columns = (rho.shape[0] - 1) // BLOCK, (rho.shape[1] - 1) // BLOCK
    y, x = np.indices((rows, columns)) * BLOCK
    corner = np.stack([np.stack([x + dx * BLOCK, y + dy * BLOCK], -1) for dy in (0, 1) for dx in (0, 1)], -2)
    falling = _falling((rows, columns))[..., None]
    # The longest side's ends, then the corner across from it; counter-clockwise where y points down.
    first = np.where(falling, [0, 3, 1], [2, 1, 0])
    second = np.where(falling, [3, 0, 2], [1, 2, 3])
    chosen = [np.take_along_axis(corner, t[..., None], -2).reshape(-1, 3, 2) for t in (first, second)]
    triangles = np.concatenate(chosen)
    done = []
    while len(triangles):
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        middle = (a + b) // 2
        # A side of one pixel, or the diagonal of one, has no pixel in its middle.
        halved = (np.abs(a - b).max(-1) > 1) & split[middle[:, 1], middle[:, 0]]
        done.append(triangles[~halved])
        a, b, c, middle = a[halved], b[halved], c[halved], middle[halved]
        triangles = np.concatenate([np.stack([c, a, middle], 1), np.stack([b, c, middle], 1)])
    return np.concatenate(done)


def _one_surface(corner: np.ndarray, limits: GridLimits) -> np.ndarray:
    """Whether the corners ``[t, 3]`` of the smallest triangles are on one surface, along both sides of one pixel."""
    return limits.joined(corner[:, 1], corner[:, 2]) & limits.joined(corner[:, 2], corner[:, 0])


def _continued(rho: np.ndarray, limits: GridLimits) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Triangles that continue the farther surface below the nearer one's edge.

    Returns:
        Triangles ``[t, 3]`` over new vertices, and of these the pixel coordinates, the inverse depth, and the pixel
        whose surface they are on.
    """
    number = np.arange(rho.size).reshape(rho.shape)
    quad = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]], -1)
    falling = _falling(quad.shape[:2])
    known = rho > 0.0
    known = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
    quad, falling = quad[known], falling[known]
    corner = rho.ravel()[quad]
    far = corner.min(-1, keepdims=True)
    sides = [limits.joined(corner[:, i], corner[:, j]) for i, j in ((0, 1), (1, 3), (3, 2), (2, 0))]
    torn = ~np.logical_and.reduce(sides)
    quad, falling, corner, far = quad[torn], falling[torn], corner[torn], far[torn]
    on_far = limits.joined(corner, np.broadcast_to(far, corner.shape))
    mean = (corner * on_far).sum(-1, keepdims=True) / np.maximum(on_far.sum(-1, keepdims=True), 1)
    farthest = np.take_along_axis(quad, corner.argmin(-1)[:, None], 1)
    new = np.arange(4 * len(quad)).reshape(len(quad), 4)
    triangles = [
        np.take_along_axis(new, np.where(falling[:, None], fall, rise), 1)
        for fall, rise in (([0, 3, 1], [1, 0, 2]), ([3, 0, 2], [2, 3, 1]))
    ]
    rho_new, owner = np.where(on_far, corner, mean), np.where(on_far, quad, farthest)
    pixels = np.stack([quad % rho.shape[1], quad // rho.shape[1]], -1).astype(np.float64)
    middle = (pixels * on_far[..., None]).sum(1, keepdims=True) / np.maximum(on_far.sum(-1), 1)[:, None, None]
    pixels += UNDER * np.where(on_far[..., None], 0.0, np.sign(pixels - middle))
    return np.concatenate(triangles), pixels.reshape(-1, 2), rho_new.ravel(), owner.ravel()


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

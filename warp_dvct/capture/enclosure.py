"""The parts of a room that no frame has seen: a box around the scan, in which seen walls go on.

A scan shows what is in front of the camera. What is beside and behind it reflects light as well, and less of it when
something is put into the room, so neither darkness nor a dome of fixed radiance can stand for it. Indoors, walls go on
as they begin: each side of the box has the mean albedo of what the scan shows of that side, and where it shows nothing,
that of the whole scan. Where it is wrong: rooms that are not boxes, and walls with something else on them farther on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from warp_dvct.capture.fusion import FusedMesh
from warp_dvct.errors import OptionError
from warp_dvct.scene import Light, LightKind

SIDES = ("left", "right", "below", "above", "back", "front")  # -x, +x, -y, +y, -z, +z of the box
ALONG = 0.95  # cosine with a side's normal from which a vertex faces like the side
BAND = 0.15  # metres from the outermost of these that are taken for the side itself
LEAST_SUPPORT = 0.1  # square metres of a side that have to be seen for its colour
TILE = 0.1  # metres, or 8 voxels where that is more
COVERED = 0.5  # share of a tile that the scan shows, from which the box has none there: both would share one light
LEAST_SEEN = 3  # sides, of which two walls, from which the scan is taken for one of a room
CLEARANCE = 0.3  # metres that a camera keeps from what is behind it; lamps and things may be at the wall
BEHIND = 2.0  # voxels between a side that is seen and the box: rays are to meet the scan where there is one
QUARTER = 0.5 * np.pi
BINS = 45  # of two degrees, in which the walls' direction is looked for
LOCAL = (LightKind.POINT, LightKind.SPHERE, LightKind.RECT, LightKind.DISK)


@dataclass(frozen=True)
class Enclosure:
    """The tiles of a box's six sides that the scan leaves open; they face inward.

    Attributes:
        points: float32 ``[4 t, 3]``, four to a tile. normals: float32 ``[4 t, 3]``.
        triangles: int32 ``[2 t, 3]``, counter-clockwise seen from inside.
        side: Of each point, which of ``SIDES``, ``[4 t]``.
        index, weight: Of each side, the vertices of the scan that show it, and their areas [m^2]; of a side that is
            not seen, all of them.
        seen: Which sides, in the order of ``SIDES``, the scan shows.
        size: Of the box along its axes, metres; the second is its height.
    """

    points: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    side: np.ndarray
    index: tuple[np.ndarray, ...]
    weight: tuple[np.ndarray, ...]
    seen: tuple[bool, ...]
    size: tuple[float, float, float]

    def albedo(self, values: np.ndarray) -> np.ndarray:
        """Of the box's vertices, ``[4 t, 3]``, from that of the scan's, ``[v, 3]``."""
        sides = [np.average(values[i], axis=0, weights=w) for i, w in zip(self.index, self.weight, strict=True)]
        return np.array(sides)[self.side]

    def describe(self) -> str:
        """How large the box is, and which sides of it the scan shows."""
        size = " x ".join(f"{edge:.1f}" for edge in self.size)
        return (
            f"what no frame has seen is taken to be a room of {size} m around the scan, {sum(self.seen)} of whose sides"
            " are seen in part (--unseen dome or none if it is not)"
        )

    def around(self, mesh: FusedMesh, albedo: np.ndarray) -> tuple[FusedMesh, np.ndarray]:
        """The scan and the box as one mesh, and the albedo of its vertices: the scan's first."""
        colors = np.concatenate([albedo, self.albedo(albedo)])
        joined = replace(
            mesh,
            points=np.concatenate([mesh.points, self.points]),
            normals=np.concatenate([mesh.normals, self.normals]),
            colors=colors.astype(np.float32),
            triangles=np.concatenate([mesh.triangles, self.triangles + len(mesh.points)]).astype(np.int32),
        )
        return joined, colors


def find_enclosure(
    mesh: FusedMesh, cameras: np.ndarray, lights: tuple[Light, ...], *, voxel: float, asked: bool = False
) -> Enclosure | None:
    """A box around the scan, its cameras and its lamps; None where that is no room.

    A sun or a dome does not get into a closed room, so with one of them there is none; and fewer than three sides that
    the scan shows, two walls among them, are not taken for a room.

    Args:
        mesh: In a world whose y points up.
        cameras: Positions, ``[n, 3]``. lights: All that are known.
        voxel: Of the scan, in metres.
        asked: Whether it is known to be a room.
    Raises:
        OptionError: It is known to be a room, and a sun shines.
    """
    outside = next((light for light in lights if light.kind not in LOCAL), None)
    if outside is not None and asked:
        raise OptionError(f"--unseen room: {outside.path} does not get into a closed room; give --unseen dome or none")
    if outside is not None or not lights:
        return None
    area = vertex_areas(mesh)
    turn = _turn(mesh, area)
    local = mesh.points.astype(np.float64) @ turn
    normals = mesh.normals.astype(np.float64) @ turn
    eyes = np.reshape(cameras, (-1, 3)) @ turn
    lamps = np.concatenate([_corners(light) for light in lights]) @ turn
    reach, index, seen = [], [], []
    for side in range(6):
        axis, sign = side // 2, 1.0 if side % 2 else -1.0
        along, facing = sign * local[:, axis], -sign * normals[:, axis] > ALONG
        found = np.flatnonzero(facing)
        if len(found):
            found = found[along[found] > np.percentile(along[found], 99.0) - BAND]
        shown = len(found) > 0 and area[found].sum() >= LEAST_SUPPORT
        eye = float((sign * eyes[:, axis]).max())
        outermost = max(float(along.max()), float((sign * lamps[:, axis]).max())) + BEHIND * voxel
        reach.append(outermost if shown and eye < outermost else max(outermost, eye + CLEARANCE))
        index.append(found if shown else np.arange(len(area)))
        seen.append(bool(shown))
    walls = seen[0] + seen[1] + seen[4] + seen[5]
    if not asked and (sum(seen) < LEAST_SEEN or walls < LEAST_SEEN - 1):
        return None
    tiles = [_tiles(side, np.array(reach), max(TILE, 8.0 * voxel)) for side in range(6)]
    open_ = [
        _uncovered(tile, side, local[i], area[i]) if shown else tile
        for side, (tile, i, shown) in enumerate(zip(tiles, index, seen, strict=True))
    ]
    points = np.concatenate(open_)
    sides = np.repeat(np.arange(6), [len(tile) for tile in open_])
    inward = np.array([(1.0 - 2.0 * (side % 2)) * np.eye(3)[side // 2] for side in range(6)])[np.repeat(sides, 4)]
    first = 4 * np.arange(len(points))[:, None]
    return Enclosure(
        (points.reshape(-1, 3) @ turn.T).astype(np.float32),
        (inward @ turn.T).astype(np.float32),
        np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])]).astype(np.int32),
        np.repeat(sides, 4),
        tuple(index),
        tuple(area[i] for i in index),
        tuple(seen),
        (reach[0] + reach[1], reach[2] + reach[3], reach[4] + reach[5]),
    )


def vertex_areas(mesh: FusedMesh) -> np.ndarray:
    """A third of the triangles around each vertex [m^2], ``[v]``."""
    a, b, c = (mesh.points[mesh.triangles[:, k]].astype(np.float64) for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 6.0
    return np.bincount(mesh.triangles.ravel(), np.repeat(area, 3), len(mesh.points))


def _turn(mesh: FusedMesh, area: np.ndarray) -> np.ndarray:
    """Columns are the box's axes: y up, and x and z along the walls, whose directions repeat every quarter turn.

    The direction of most area, then the mean of what is near it: a cupboard that stands askew does not turn the room.
    """
    x, y, z = mesh.normals.astype(np.float64).T
    upright = area * (np.abs(y) < np.sqrt(1.0 - ALONG**2))
    angle = np.arctan2(z, x) % QUARTER
    most = np.histogram(angle, BINS, (0.0, QUARTER), weights=upright)[0]
    start = QUARTER / BINS * (int(np.argmax(most + np.roll(most, 1) + np.roll(most, -1))) + 0.5)
    off = (angle - start + 0.5 * QUARTER) % QUARTER - 0.5 * QUARTER
    near = upright * (np.abs(off) < 2.0 * QUARTER / BINS)
    turn = start + (near * off).sum() / max(near.sum(), 1e-12)
    return np.array([[np.cos(turn), 0.0, -np.sin(turn)], [0.0, 1.0, 0.0], [np.sin(turn), 0.0, np.cos(turn)]])


def _corners(light: Light) -> np.ndarray:
    """Points that enclose a lamp, ``[4, 3]`` or more."""
    center, x, y = (np.asarray(v, np.float64) for v in (light.position, light.axis_x, light.axis_y))
    ball = light.radius * np.concatenate([np.eye(3), -np.eye(3)])
    return np.concatenate([center + ball, [center + i * x + j * y for i in (-1.0, 1.0) for j in (-1.0, 1.0)]])


def _tiles(side: int, reach: np.ndarray, edge: float) -> np.ndarray:
    """Corners ``[t, 4, 3]`` of the about square tiles of a side of a box that reaches so far to its six sides."""
    axis, upper = side // 2, side % 2
    u, v = (axis + 1) % 3, (axis + 2) % 3
    low, high = -reach[::2], reach[1::2]
    across, along = (np.linspace(low[k], high[k], max(1, round((high[k] - low[k]) / edge)) + 1) for k in (u, v))
    i, j = (k.ravel() for k in np.meshgrid(np.arange(len(across) - 1), np.arange(len(along) - 1), indexing="ij"))
    # Counter-clockwise from inside: u x v is the axis, which points out of the upper side.
    ring = [(0, 0), (0, 1), (1, 1), (1, 0)] if upper else [(0, 0), (1, 0), (1, 1), (0, 1)]
    corners = np.empty((len(i), 4, 3))
    corners[..., axis] = high[axis] if upper else low[axis]
    for k, (di, dj) in enumerate(ring):
        corners[:, k, u], corners[:, k, v] = across[i + di], along[j + dj]
    return corners


def _uncovered(tiles: np.ndarray, side: int, points: np.ndarray, area: np.ndarray) -> np.ndarray:
    """The tiles that the vertices of the side, with their areas, do not cover."""
    u, v = (side // 2 + 1) % 3, (side // 2 + 2) % 3
    edges = [np.unique(tiles[..., k]) for k in (u, v)]
    shown = np.histogram2d(points[:, u], points[:, v], edges, weights=area)[0]
    whole = np.diff(edges[0])[:, None] * np.diff(edges[1])
    return tiles[(shown < COVERED * whole).ravel()]

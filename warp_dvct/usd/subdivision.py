"""Subdivision surfaces: Catmull and Clark 1978 on any polygons, Loop 1987 on triangles, with creases as USD has them.

Each level keeps the vertices of the one before at the front, so that vertex k of the cage is vertex k of every level.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

SCHEMES = ("catmullClark", "loop")
SHARP = 10.0  # USD: sharpness from which a crease is one on every level


@dataclass(frozen=True)
class Creases:
    """Edges and vertices that stay sharp for as many levels as they are sharp; 10 and more for ever.

    Attributes:
        edges: Vertices of each edge, int64 ``[e, 2]``. edge_sharpness: ``[e]``.
        corners: Vertices, int64 ``[k]``. corner_sharpness: ``[k]``.
        sharp_corners: Whether a vertex of a single face at the border stays where it is (``edgeAndCorner``).
    """

    edges: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    edge_sharpness: np.ndarray = field(default_factory=lambda: np.zeros(0))
    corners: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    corner_sharpness: np.ndarray = field(default_factory=lambda: np.zeros(0))
    sharp_corners: bool = True


class Level:
    """Polygons, their edges, and the rules that place the vertices of the next level or of the limit.

    Args:
        count: Vertices. counts: Corners per face ``[f]``, at least 3. indices: Vertices of the corners ``[c]``.
        scheme: One of ``SCHEMES``; ``loop`` takes triangles alone.
    """

    def __init__(self, count: int, counts: np.ndarray, indices: np.ndarray, scheme: str, creases: Creases) -> None:
        self.count, self.counts, self.indices, self.scheme = count, counts, indices, scheme
        corner = np.arange(len(indices))
        first = np.repeat(np.cumsum(counts) - counts, counts)
        size = np.repeat(counts, counts)
        self.face = np.repeat(np.arange(len(counts)), counts)
        self.next = first + (corner - first + 1) % size
        self.last = first + (corner - first - 1) % size
        ends = np.sort(np.stack([indices, indices[self.next]], 1), 1)
        keys, self.edge, uses = np.unique(ends[:, 0] * count + ends[:, 1], return_inverse=True, return_counts=True)
        self.ends = np.stack([keys // count, keys % count], 1)
        self.edge_sharpness = self._edge_sharpness(keys, uses, creases)
        self.vertex_sharpness = self._vertex_sharpness(creases)
        self.creases = creases

    def _edge_sharpness(self, keys: np.ndarray, uses: np.ndarray, creases: Creases) -> np.ndarray:
        """Of each edge; those at a border, and those of more than two faces, are sharp for ever."""
        sharpness = np.where(uses == 2, 0.0, np.inf)
        wanted = np.sort(creases.edges, 1)
        wanted = wanted[:, 0] * self.count + wanted[:, 1]
        place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        there = keys[place] == wanted
        np.maximum.at(sharpness, place[there], creases.edge_sharpness[there])
        return sharpness

    def _vertex_sharpness(self, creases: Creases) -> np.ndarray:
        sharpness = np.zeros(self.count)
        np.maximum.at(sharpness, creases.corners, creases.corner_sharpness)
        if creases.sharp_corners:
            border = np.zeros(self.count, bool)
            border[self.ends[np.isinf(self.edge_sharpness)]] = True
            sharpness[border & (np.bincount(self.indices, minlength=self.count) == 1)] = np.inf
        return sharpness

    def refined(self, values: np.ndarray) -> np.ndarray:
        """Values ``[v, k]`` at the vertices of the next level: the vertices, then a value per edge, then (Catmull and
        Clark) one per face."""
        a, b = values[self.ends[:, 0]], values[self.ends[:, 1]]
        middle = 0.5 * (a + b)
        if self.scheme == "loop":
            across = _sums(self.edge, values[self.indices[self.last]], len(self.ends))
            smooth = 0.375 * (a + b) + 0.125 * across
            faces = values[:0]
        else:
            faces = self._face_means(values[self.indices])
            smooth = 0.25 * (a + b + _sums(self.edge, faces[self.face], len(self.ends)))
        sharp = np.minimum(self.edge_sharpness, 1.0)[:, None]
        edges = np.where(sharp > 0.0, sharp * middle + (1.0 - sharp) * np.where(sharp < 1.0, smooth, 0.0), smooth)
        return np.concatenate([self._vertices(values, faces, middle), edges, faces])

    def _vertices(self, values: np.ndarray, faces: np.ndarray, middle: np.ndarray) -> np.ndarray:
        edges, around = self._valence()
        if self.scheme == "loop":
            beta = _loop_weight(edges)
            smooth = (1.0 - edges * beta) * values + beta * self._neighbours(values)
        else:
            q = _sums(self.indices, faces[self.face], self.count) / around
            r = sum(_sums(self.ends[:, k], middle, self.count) for k in range(2)) / edges
            smooth = (q + 2.0 * r + (edges - 3.0) * values) / edges
        return self._with_creases(values, smooth, 0.75, 0.125)

    def limit(self, values: np.ndarray) -> np.ndarray:
        """Values ``[v, k]`` where the vertices end up after endless refinement; Catmull and Clark's for quads."""
        edges, _ = self._valence()
        near = self._neighbours(values)
        if self.scheme == "loop":
            weight = 1.0 / (edges + 0.375 / np.maximum(_loop_weight(edges), 1e-12))
            smooth = (1.0 - edges * weight) * values + weight * near
        else:
            far = _sums(self.indices, values[self.indices[self.next[self.next]]], self.count)
            smooth = (edges**2 * values + 4.0 * near + far) / (edges * (edges + 5.0))
        return self._with_creases(values, smooth, 2.0 / 3.0, 1.0 / 6.0)

    def _valence(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges and faces at each vertex ``[v, 1]``, at least one."""
        edges = np.bincount(self.ends.ravel(), minlength=self.count)
        faces = np.bincount(self.indices, minlength=self.count)
        return np.maximum(edges, 1.0)[:, None], np.maximum(faces, 1.0)[:, None]

    def _neighbours(self, values: np.ndarray, of: np.ndarray | None = None) -> np.ndarray:
        """Sums over the far ends of the edges at each vertex; ``of`` chooses edges."""
        ends = self.ends if of is None else self.ends[of]
        one, other = ends[:, 0], ends[:, 1]
        return _sums(one, values[other], self.count) + _sums(other, values[one], self.count)

    def _with_creases(self, values: np.ndarray, smooth: np.ndarray, own: float, each: float) -> np.ndarray:
        """The smooth rule, blended with that of a crease (two sharp edges) or of a corner (more, or a sharp vertex)."""
        sharp = self.edge_sharpness > 0.0
        ends = self.ends[sharp].ravel()
        number = np.bincount(ends, minlength=self.count)
        size = np.bincount(ends, np.repeat(np.minimum(self.edge_sharpness[sharp], SHARP), 2), self.count)
        along = own * values + each * self._neighbours(values, sharp)
        corner = (number > 2) | (self.vertex_sharpness > 0.0)
        stiff = np.where(corner[:, None], values, along)
        weight = np.where(number >= 2, size / np.maximum(number, 1), 0.0)
        weight = np.clip(np.maximum(weight, self.vertex_sharpness), 0.0, 1.0)[:, None]
        alone = np.bincount(self.indices, minlength=self.count) == 0
        weight, stiff = np.where(alone[:, None], 1.0, weight), np.where(alone[:, None], values, stiff)
        return np.where(weight > 0.0, weight * stiff + (1.0 - weight) * smooth, smooth)

    def split(self) -> Level:
        """The next level's polygons."""
        edge = self.count + self.edge
        before = self.count + self.edge[self.last]
        if self.scheme == "loop":
            cut = np.stack([self.indices, edge, before], 1)
            indices = np.concatenate([cut.ravel(), edge])
            counts = np.full(len(indices) // 3, 3)
            vertices = self.count + len(self.ends)
        else:
            center = self.count + len(self.ends) + self.face
            indices = np.stack([self.indices, edge, center, before], 1).ravel()
            counts = np.full(len(self.indices), 4)
            vertices = self.count + len(self.ends) + len(self.counts)
        kept = np.flatnonzero((self.edge_sharpness > 0.0) & np.isfinite(self.edge_sharpness))
        halves = np.stack([self.ends[kept].ravel(), self.count + np.repeat(kept, 2)], 1)
        creases = Creases(
            halves,
            _worn(np.repeat(self.edge_sharpness[kept], 2)),
            self.creases.corners,
            _worn(self.creases.corner_sharpness),
            self.creases.sharp_corners,
        )
        return Level(vertices, counts, indices, self.scheme, creases)

    def parents(self) -> np.ndarray:
        """The face that each face of the next level is of."""
        return np.concatenate([self.face, np.arange(len(self.counts))]) if self.scheme == "loop" else self.face

    def split_corners(self, values: np.ndarray) -> np.ndarray:
        """Values ``[c, k]`` of corners at the corners of the next level, linear over each face."""
        ahead = 0.5 * (values + values[self.next])
        if self.scheme == "loop":
            cut = np.stack([values, ahead, ahead[self.last]], 1).reshape(-1, values.shape[1])
            return np.concatenate([cut, ahead])
        center = self._face_means(values)[self.face]
        return np.stack([values, ahead, center, ahead[self.last]], 1).reshape(-1, values.shape[1])

    def _face_means(self, corners: np.ndarray) -> np.ndarray:
        return _sums(self.face, corners, len(self.counts)) / self.counts[:, None]


class Refinement:
    """A cage refined ``levels`` times, its vertices moved to the limit surface.

    Attributes:
        counts, indices: The refined polygons. parents: The cage's face of each.
    """

    def __init__(self, cage: Level, levels: int) -> None:
        self.cage = cage
        self._levels = [cage]
        self.parents = np.arange(len(cage.counts))
        for _ in range(levels):
            self.parents = self.parents[self._levels[-1].parents()]
            self._levels.append(self._levels[-1].split())
        self.counts, self.indices = self._levels[-1].counts, self._levels[-1].indices

    def vertices(self, values: np.ndarray) -> np.ndarray:
        """Values of the cage's vertices ``[v, k]`` at the refined vertices."""
        for level in self._levels[:-1]:
            values = level.refined(values)
        return self._levels[-1].limit(values)

    def corners(self, values: np.ndarray) -> np.ndarray:
        """Values of the cage's corners ``[c, k]`` at the refined corners."""
        for level in self._levels[:-1]:
            values = level.split_corners(values)
        return values


def _worn(sharpness: np.ndarray) -> np.ndarray:
    """What is left of sharpness after a level."""
    return np.where(sharpness >= SHARP, sharpness, np.maximum(sharpness - 1.0, 0.0))


def _loop_weight(edges: np.ndarray) -> np.ndarray:
    """Of a neighbour, by the number of edges at a vertex (Loop 1987)."""
    return (0.625 - (0.375 + 0.25 * np.cos(2.0 * np.pi / edges)) ** 2) / edges


def _sums(index: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Rows of ``values`` summed by ``index``, ``[count, k]``."""
    return (
        np.stack([np.bincount(index, column, count) for column in values.T], 1)
        if len(values)
        else np.zeros((count, values.shape[1]))
    )

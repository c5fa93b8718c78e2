"""Sparse voxelization of real and synthetic surfaces into the level-0 records and the brick maps of all levels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.kernels import sorting
from warp_dvct.kernels import voxelization as kernels
from warp_dvct.kernels.volume import Volume
from warp_dvct.launch import Launcher
from warp_dvct.passes.sorting import count_below, scan, sort_by_key, unique_runs
from warp_dvct.structs import with_fields


@dataclass(frozen=True)
class Box:
    """A cube of voxels in volume space.

    Attributes:
        low: Its lowest corner.
        edge: Its edge length.
        n: Voxels an edge at level 0.
    """

    low: tuple[float, float, float]
    edge: float
    n: int

    @property
    def voxel(self) -> float:
        """Edge of a voxel."""
        return self.edge / self.n


@dataclass(frozen=True)
class Fragments:
    """Pieces of triangles, one per (triangle, voxel), ordered by voxel through ``order``.

    Attributes:
        triangle: int ``[f]``. place: vec4 ``[f]``, centroid and area in voxel faces (level 0).
        order: int ``[f]``, fragments sorted by voxel. record_start: int ``[records]``, first entry in ``order``.
        count: Valid entries of ``order``.
    """

    triangle: Any
    place: Any
    order: Any
    record_start: Any
    count: int


@dataclass(frozen=True)
class Voxels:
    """A voxelised scene, not yet lit.

    Attributes:
        box: Where it is.
        volume: The brick maps of all levels, which the voxels of :func:`unlit` share; ``field`` is empty, or theirs.
        level_records: Records of each level; level ``l`` starts at ``sum(level_records[:l])``.
        level_keys: Sorted voxel keys per level.
        area: vec2 ``[level-0 records * 6]``, projected area per face, before and after, in voxel faces.
        fragments: The pieces that the records are made of.
    """

    box: Box
    volume: Any
    level_records: tuple[int, ...]
    level_keys: tuple[Any, ...]
    area: Any
    fragments: Fragments

    def field(self) -> np.ndarray:
        """The field of all levels on the host, ``[records, face, solution, 4]``."""
        return self.volume.field.numpy().reshape(6, -1, 2, 4).swapaxes(0, 1)


@dataclass(frozen=True)
class Pieces:
    """Fragments of one role's triangles, sorted by voxel.

    Attributes:
        key: int, voxel keys. triangle: int, index among that role's triangles. place: As in :class:`Fragments`.
        count: How many.
    """

    key: Any
    triangle: Any
    place: Any
    count: int


def voxelize(
    launcher: Launcher,
    triangles: Any,
    normals: Any,
    double_sided: Any,
    synthetic_first: int,
    box: Box,
    *,
    most: int = 0,
    real: Pieces | None = None,
) -> Voxels:
    """Cut triangles by the voxel grid and build the brick maps of all levels.

    Args:
        triangles: Corners in volume space, vec3 ``[3 t]``, real ones first.
        normals: Unit geometric normals, vec3 ``[t]``.
        double_sided: int ``[t]``; non-zero where the back faces show as well.
        synthetic_first: Index of the first synthetic triangle.
        box: The grid, ``n`` from 1 to 1024.
        most: Levels are built until one has no more records than this; 0 for all levels.
        real: What :func:`cut_triangles` made of the real triangles, where that is at hand.
    Returns:
        Voxels without a field (:func:`unlit`). Triangles outside of the box are left out.
    """
    if real is None:
        real = cut_triangles(launcher, part(launcher, triangles, 0, 3 * synthetic_first), box)
    synthetic = cut_triangles(launcher, part(launcher, triangles, 3 * synthetic_first, triangles.shape[0]), box)
    fragments, keys = _join(launcher, real, synthetic, synthetic_first)
    level_keys = [keys]
    while (box.n - 1) >> (len(level_keys) - 1) > 0 and (most == 0 or level_keys[-1].shape[0] > most):
        level_keys.append(_parents(launcher, level_keys[-1], box.n, len(level_keys) - 1))
    volume = _build_maps(launcher, level_keys, box)
    records = keys.shape[0]
    area = launcher.zeros(max(records, 1) * 6, wp.vec2)
    launcher.launch(
        kernels._sum_areas,
        records,
        [
            fragments.record_start,
            fragments.order,
            fragments.triangle,
            fragments.place,
            normals,
            double_sided,
            synthetic_first,
            fragments.count,
            records,
        ],
        [area],
    )
    return Voxels(box, volume, tuple(k.shape[0] for k in level_keys), tuple(level_keys), area, fragments)


def part(launcher: Launcher, array: Any, start: int, stop: int) -> Any:
    """``array[start:stop]``, which Warp's slices refuse to be where it is empty."""
    return array[start:stop] if start < stop else launcher.empty(0, array.dtype)


def cut_triangles(launcher: Launcher, triangles: Any, box: Box) -> Pieces:
    """The fragments of triangles in a grid, sorted by voxel and, within a voxel, by triangle."""
    grid = [wp.vec3(*box.low), box.voxel, box.n]
    count = triangles.shape[0] // 3
    per_triangle = launcher.zeros(max(count, 1), wp.int32)
    launcher.launch(kernels._count_tiles, count, [triangles, *grid], [per_triangle])
    ends, total = scan(launcher, per_triangle)
    tile_triangle = launcher.empty(max(total, 1), wp.int32)
    tile = launcher.empty(max(total, 1), wp.int32)
    launcher.launch(kernels._list_tiles, count, [triangles, ends, per_triangle, *grid], [tile_triangle, tile])

    per_tile = launcher.zeros(max(total, 1), wp.int32)
    launcher.launch(kernels._count_fragments, total, [triangles, tile_triangle, tile, *grid], [per_tile])
    ends, listed = scan(launcher, per_tile)
    cut_key = launcher.empty(max(2 * listed, 1), wp.int32)
    order = launcher.empty(max(2 * listed, 1), wp.int32)
    cut_triangle = launcher.empty(max(listed, 1), wp.int32)
    cut_place = launcher.empty(max(listed, 1), wp.vec4)
    tiles = [triangles, tile_triangle, tile, ends, per_tile]
    launcher.launch(kernels._list_fragments, total, [*tiles, *grid], [cut_key, cut_triangle])
    launcher.launch(kernels._cut_fragments, listed, [triangles, cut_triangle, *grid], [cut_key, cut_place])
    sort_by_key(launcher, cut_key, order, listed)
    valid = count_below(launcher, cut_key, listed)
    key, triangle = launcher.empty(max(valid, 1), wp.int32), launcher.empty(max(valid, 1), wp.int32)
    place = launcher.empty(max(valid, 1), wp.vec4)
    sources = [order, cut_key, cut_triangle, cut_place]
    launcher.launch(kernels._sort_fragments, valid, sources, [key, triangle, place])
    return Pieces(key, triangle, place, valid)


def _join(launcher: Launcher, real: Pieces, synthetic: Pieces, synthetic_first: int) -> tuple[Fragments, Any]:
    """All fragments, sorted by voxel with the real ones first, and the sorted unique keys of the voxels."""
    count = real.count + synthetic.count
    key, triangle, order = (launcher.empty(max(count, 1), wp.int32) for _ in range(3))
    place = launcher.empty(max(count, 1), wp.vec4)
    for mine, other, ties, first in ((real, synthetic, 0, 0), (synthetic, real, 1, synthetic_first)):
        launcher.launch(
            kernels._join_fragments,
            mine.count,
            [mine.key, mine.triangle, mine.place, other.key, other.count, ties, first],
            [key, triangle, place],
        )
    launcher.launch(sorting._count_up, count, [], [order])
    keys, starts = unique_runs(launcher, key, count)
    return Fragments(triangle, place, order, starts, count), keys


def _parents(launcher: Launcher, keys: Any, n: int, level: int) -> Any:
    count = keys.shape[0]
    parent = launcher.empty(max(2 * count, 1), wp.int32)
    order = launcher.empty(max(2 * count, 1), wp.int32)
    launcher.launch(kernels._parent_keys, count, [keys, n, level], [parent])
    sort_by_key(launcher, parent, order, count)
    return unique_runs(launcher, parent, count)[0]


def level_bricks(n: int, level: int) -> int:
    """Bricks an edge of a level."""
    return -(-(((n - 1) >> level) + 1) // 8)


def _build_maps(launcher: Launcher, level_keys: list[Any], box: Box) -> Any:
    bricks = [unique_runs(launcher, keys, keys.shape[0], shift=9)[0] for keys in level_keys]
    sizes = [level_bricks(box.n, level) ** 3 for level in range(len(level_keys))]
    table_start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
    tables = launcher.full(int(table_start[-1]), -1, wp.int32)
    cells = launcher.full(max(1, sum(b.shape[0] for b in bricks) * 512), -1, wp.int32)
    records = sum(k.shape[0] for k in level_keys)
    brick_start = record_start = 0
    for level, (keys, held) in enumerate(zip(level_keys, bricks, strict=True)):
        start = int(table_start[level])
        launcher.launch(kernels._fill_table, held.shape[0], [held, start, brick_start], [tables])
        launcher.launch(kernels._fill_cells, keys.shape[0], [keys, tables, start, record_start], [cells])
        brick_start += held.shape[0]
        record_start += keys.shape[0]
    volume = Volume()
    volume.low = wp.vec3(*box.low)
    volume.voxel = box.voxel
    volume.n = box.n
    volume.levels = len(level_keys)
    volume.records = max(1, records)
    volume.table_start = launcher.array(table_start[:-1].copy(), wp.int32)
    volume.tables = tables
    volume.cells = cells
    volume.field = launcher.empty(0, wp.vec4)
    return volume


def unlit(launcher: Launcher, voxels: Voxels) -> Voxels:
    """The same voxels with a zero field of their own, to be lit."""
    field = launcher.zeros(12 * voxels.volume.records, wp.vec4)
    return replace(voxels, volume=with_fields(Volume, voxels.volume, field=field))

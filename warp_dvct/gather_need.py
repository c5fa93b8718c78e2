"""How many points a sparse gather will trace rays from, told from a small picture.

The picture stands for one of any size: a stride of s pixels in w is the same share s/w of its width. Blocks of
several such shares are laid over it as ``passes.gather`` does, and the bound of ``kernels.reconstruction._find_detail``
says which of them are gathered once more at half the stride.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_dvct.passes.gather import FINEST, PLANE_TOLERANCE

WIDTH = 160  # of the small picture
STRIDES = (1, 2, 4, 8, 16)  # pixels of it
SKIPPED = 11  # of so many pixels one is asked whether a gathered point tells of it
LIMITS = (0.03125, 0.0625, 0.125, 0.25, 0.5, 1.0, 2.0)  # of ``gather.detail``


@dataclass(frozen=True)
class Seen:
    """Shading points: the pixels' centres first, then points of edge pixels.

    Attributes:
        role: int ``[n]``. pixel: int ``[n, 2]``, x and y.
        position, normal, normal_g: ``[n, 3]``, in volume space; shading and geometric normal.
        footprint: Size of a pixel there, ``[n]``.
    """

    role: np.ndarray
    pixel: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    normal_g: np.ndarray
    footprint: np.ndarray


@dataclass(frozen=True)
class View:
    """What the small picture shows of one role; arrays ``[h, w]``.

    Attributes:
        seen: All points. role: Which is meant.
        nearness: Mean inverse distance of what is seen from a pixel.
        changed: Where the synthetic objects change the light; elsewhere nothing is gathered again.
    """

    seen: Seen
    role: int
    nearness: np.ndarray
    changed: np.ndarray

    @property
    def mask(self) -> np.ndarray:
        """Pixels of the role."""
        return (self.seen.role[: self.changed.size] == self.role).reshape(self.changed.shape)


@dataclass(frozen=True)
class GatherNeed:
    """Points of one role that a sparse gather takes.

    Attributes:
        share: Of the picture's pixels that show the role.
        blocks: By ``STRIDES``: area of the blocks that show it, over the picture's.
        again: By ``LIMITS`` and ``STRIDES[1:]``: share of the blocks of half the stride that are gathered as well.
        missing, missing_edge: By ``STRIDES``: shares of the pixels, and of the points at edges, near which no point of
            the same surface is gathered.
    """

    share: float
    blocks: tuple[float, ...]
    again: tuple[tuple[float, ...], ...]
    missing: tuple[float, ...]
    missing_edge: tuple[float, ...]

    def points(self, stride: int, width: int, height: int, detail: float) -> tuple[float, float]:
        """Points gathered in the blocks of ``stride`` pixels, and at halved strides where ``detail`` is exceeded."""
        pixels = float(width * height)
        first, more, step = self._area(stride / width) * pixels / stride**2, 0.0, stride
        while _halved(step, detail):
            half = step // 2
            more += self._area(half / width) * pixels / half**2 * self._again(step / width, detail)
            step = half
        return first, more

    def alone(self, stride: int, width: int, detail: float) -> tuple[float, float]:
        """Shares of the pixels, and of the points at edges, that are gathered by themselves: no other tells of them."""
        while _halved(stride, detail):
            stride //= 2
        spacing = stride / width
        return self._by_edge(spacing, 0.0, self.missing), self._by_edge(spacing, 0.0, self.missing_edge)

    def _area(self, spacing: float) -> float:
        """Of blocks: what juts out over an outline goes by their edge."""
        return self._by_edge(spacing, self.share, self.blocks)

    @staticmethod
    def _by_edge(spacing: float, least: float, values: tuple[float, ...]) -> float:
        """By ``STRIDES``; below the finest, what is above ``least`` goes by the stride."""
        stride = spacing * WIDTH
        if stride < STRIDES[0]:
            return least + (values[0] - least) * stride
        return float(np.interp(np.log2(stride), np.log2(STRIDES), values))

    def _again(self, spacing: float, detail: float) -> float:
        """Edges and contacts are lines: below the finest stride their blocks' share goes by the stride."""
        stride = max(spacing * WIDTH, 1e-9)
        by_stride = [np.interp(np.log2(detail), np.log2(LIMITS), column) for column in zip(*self.again, strict=True)]
        share = float(np.interp(np.log2(stride), np.log2(STRIDES[1:]), by_stride))
        return share * min(1.0, stride / STRIDES[1])


def _halved(stride: int, detail: float) -> bool:
    """As ``passes.gather.SparseGather`` decides."""
    return detail > 0.0 and stride > FINEST and stride % 2 == 0


def gather_need(view: View) -> tuple[GatherNeed, np.ndarray]:
    """Count blocks; also bool ``[h, w]``, pixels that stand for those gathered again under the default ``detail``."""
    mask = view.mask
    height, width = mask.shape
    chosen = {stride: _choose(mask, stride) for stride in STRIDES}
    blocks = tuple(float((chosen[s] >= 0).sum() * s * s) / (height * width) for s in STRIDES)
    values = {stride: _change(view, chosen[stride], chosen[stride // 2], stride) for stride in STRIDES[1:]}
    again = tuple(tuple(float((v > limit).mean()) if v.size else 0.0 for v in values.values()) for limit in LIMITS)
    pixels = np.nonzero(mask.ravel())[0][::SKIPPED]
    edges = mask.size + np.nonzero(view.seen.role[mask.size :] == view.role)[0][::3]
    missing, at_edges = (
        tuple(_missing(view.seen, points, chosen[stride], stride) for stride in STRIDES) for points in (pixels, edges)
    )
    marked = np.zeros(height * width, bool)
    half = chosen[STRIDES[1]].ravel()
    marked[half[half >= 0][values[STRIDES[2]] > LIMITS[3]]] = True
    return GatherNeed(float(mask.mean()), blocks, again, missing, at_edges), marked.reshape(height, width)


def _choose(mask: np.ndarray, stride: int) -> np.ndarray:
    """For each block the pixel that stands for it, as a flat index, or -1: a scattered order decides, by which a pixel
    with even coordinates, whose rays were traced, goes first."""
    height, width = mask.shape
    rows, columns = -(-height // stride), -(-width // stride)
    index = np.full((rows * stride, columns * stride), -1)
    index[:height, :width] = np.where(mask, np.arange(height * width).reshape(height, width), -1)
    cells = index.reshape(rows, stride, columns, stride).transpose(0, 2, 1, 3).reshape(rows, columns, stride * stride)
    order = np.random.default_rng(stride).permutation(stride * stride)
    y, x = order // stride, order % stride
    cells = cells[..., order[np.argsort((x % 2) + (y % 2) > 0, kind="stable")]]
    first = np.argmax(cells >= 0, axis=-1)
    return np.take_along_axis(cells, first[..., None], -1)[..., 0]


def _change(view: View, coarse: np.ndarray, fine: np.ndarray, stride: int) -> np.ndarray:
    """By block of half the stride that shows the role: the bound on how much irradiance changes within its block."""
    changed = _around(_any(view.changed, stride))
    at = coarse.repeat(2, 0).repeat(2, 1)[: fine.shape[0], : fine.shape[1]]
    live = changed.repeat(2, 0).repeat(2, 1)[: fine.shape[0], : fine.shape[1]]
    there = fine >= 0
    j, at, live = fine[there], at[there], live[there]
    position, normal = view.seen.position, view.seen.normal
    apart = np.linalg.norm(position[j] - position[at], axis=-1)
    way = np.maximum(apart, 0.5 * stride * view.seen.footprint[j]) * view.nearness.ravel()[at]
    turn = np.sqrt(np.maximum(1.0 - (normal[j] * normal[at]).sum(-1), 0.0))
    return np.where(live, way + turn, 0.0)


def _missing(seen: Seen, points: np.ndarray, chosen: np.ndarray, stride: int) -> float:
    """Share of ``points`` of which ``kernels.reconstruction.interpolated`` finds nothing."""
    if not points.size:
        return 0.0
    (x, y), position = seen.pixel[points].T, seen.position[points]
    normal, normal_g = seen.normal[points], seen.normal_g[points]
    reach = PLANE_TOLERANCE * stride * seen.footprint[points]
    padded = np.pad(chosen, 1, constant_values=-1)
    total = np.zeros(points.size)
    for dy in range(3):
        for dx in range(3):
            j = padded[y // stride + dy, x // stride + dx]
            offset = seen.position[j] - position
            gap = np.maximum(np.abs((offset * normal_g).sum(-1)), np.abs((offset * seen.normal_g[j]).sum(-1))) / reach
            far = (((j % WIDTH - x) / stride) ** 2 + ((j // WIDTH - y) / stride) ** 2) / 2.25
            facing = np.maximum((normal * seen.normal[j]).sum(-1), 0.0)
            flat = np.maximum(1.0 - gap**2 / 4.0, 0.0) ** 4
            total += (j >= 0) * np.maximum(1.0 - far, 0.0) ** 2 * facing**8 * flat
    return float((total <= 1e-3).mean())


def _any(mask: np.ndarray, stride: int) -> np.ndarray:
    height, width = mask.shape
    rows, columns = -(-height // stride), -(-width // stride)
    padded = np.zeros((rows * stride, columns * stride), bool)
    padded[:height, :width] = mask
    return np.asarray(padded.reshape(rows, stride, columns, stride).any((1, 3)))


def _around(mask: np.ndarray) -> np.ndarray:
    """True also next to what is true."""
    padded = np.pad(mask, 1)
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).any((-2, -1)))

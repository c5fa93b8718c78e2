"""Depth images with poses to one surface: a truncated signed distance field in Open3D's sparse voxel blocks.

What it costs: about 60 ms of one thread a frame of 640 x 480 at voxels of 1 cm, and 80 KiB for each block of 16³ voxels
near a surface; frames are read one at a time. Where it is wrong: surfaces seen from one side only have no back, what is
thinner than the truncation distance swells or vanishes, and nothing closes what no frame has seen.

Curless and Levoy 1996, "A Volumetric Method for Building Complex Models from Range Images"; Newcombe et al. 2011,
"KinectFusion".
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_dvct.capture.frames import FrameSource, Progress, RgbdFrame, Skipped, usable_frames
from warp_dvct.errors import DeviceError, OptionError
from warp_dvct.extras import load_open3d

BLOCK = 16  # voxels an edge of a block
BYTES_PER_VOXEL = 20  # distance, weight and colour, all float32
MEMORY_SHARE = 0.5  # of the memory that is free: the mesh needs the other half
COUNT_PIXELS = 160  # across an image that are looked at to count blocks: 2.7 cm apart at 4 m
SPARE_BLOCKS = 1.25  # the hash map rehashes, for seconds, when it is full
# Noise of 1/depth [1/m] of structured light: 1/6 pixel at f = 585 px and a baseline of 75 mm (Khoshelham 2012).
INVERSE_DEPTH_NOISE = 1.0 / 6.0 / (585.0 * 0.075)
SMOOTH_WINDOW = 7  # pixels across
SMOOTH_RANGE = 5.0  # standard deviations of the noise that still count as the same surface
JUMP = 6.0  # standard deviations between neighbours beyond which a pixel lies on the edge of something
HALF_PIXEL = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
LEAST_EDGE = 10.0  # voxels; components with less area than this squared are floaters


@dataclass(frozen=True)
class FusionOptions:
    """How frames become a surface.

    Attributes:
        voxel: Edge of a voxel in metres.
        truncation: Distance in voxels up to which a frame speaks about what is behind a surface.
        near, far: Depths in metres outside of which pixels are left out.
        weight: Least number of frames that have seen a vertex; None is half of the frames, at most 3.
        smooth: Whether depth images are smoothed in 1/depth, keeping edges.
        least_area: Square metres below which a component is dropped; None is (10 voxels)².
        close_holes: Radius in metres up to which holes are closed; 0 for none.
        triangles: Decimate to that many; None to keep all.
    Raises:
        OptionError: A value out of its range.
    """

    voxel: float = 0.01
    truncation: float = 4.0
    near: float = 0.1
    far: float = 4.0
    weight: float | None = None
    smooth: bool = True
    least_area: float | None = None
    close_holes: float = 0.0
    triangles: int | None = None

    def __post_init__(self) -> None:
        if not 1e-4 <= self.voxel <= 1.0:
            raise OptionError(f"the voxel is {self.voxel:g} m; give its edge in metres, from 0.0001 to 1")
        if not 1.0 <= self.truncation <= 64.0:
            raise OptionError(f"the truncation is {self.truncation:g} voxels; give 1 to 64")
        if not 0.0 <= self.near < self.far:
            raise OptionError(f"the depth range is {self.near:g} to {self.far:g} m; give 0 <= near < far")
        if self.triangles is not None and self.triangles < 4:
            raise OptionError(f"triangles is {self.triangles}; give at least 4")


@dataclass(frozen=True)
class FusedMesh:
    """A surface in the frames' world.

    Attributes:
        points: float32 ``[v, 3]``, metres.
        normals: Unit, toward the cameras, float32 ``[v, 3]``.
        colors: Mean colour seen, linear, float32 ``[v, 3]``; None where no frame has colour.
        triangles: int32 ``[t, 3]``, counter-clockwise seen from the cameras.
        skipped: Why frames were left out, by index.
        frames: Number of frames that were used.
        components, dropped: Connected parts that were found, and how many of them were dropped as floaters.
    """

    points: np.ndarray
    normals: np.ndarray
    colors: np.ndarray | None
    triangles: np.ndarray
    skipped: dict[int, str]
    frames: int
    components: int
    dropped: int


def fuse(
    source: FrameSource,
    options: FusionOptions = FusionOptions(),
    *,
    threads: int | None = None,
    progress: Progress | None = None,
    skipped: Skipped | None = None,
) -> FusedMesh:
    """Fuse frames into a mesh.

    Args:
        source: Frames with poses; each is read twice, the first time without its colour.
        threads: CPU threads; None for all.
        progress: Called with what is being done and the share of the work that is done.
        skipped: Frames that are left out already; it is added to.
    Raises:
        FileError: No frame can be used. OptionError: Open3D is missing, or no surface is found.
        DeviceError: The voxels would not fit into memory.
    """
    report = progress or (lambda name, share: None)
    skipped = skipped or Skipped()
    o3d = open3d_for_reconstruction(threads)
    blocks = count_blocks(source, options, skipped, lambda share: report("sizing", 0.15 * share))
    _check_memory(blocks, options)
    grid = integrate(o3d, source, options, blocks, skipped, lambda share: report("fusing", 0.15 + 0.65 * share))
    frames = len(source) - len(skipped.reasons)
    report("meshing", 0.8)
    least = options.weight if options.weight is not None else float(min(3, (frames + 1) // 2))
    # Open3D keeps what is above the threshold.
    mesh = grid.extract_triangle_mesh(least - 0.5)
    if mesh.is_empty() or not len(mesh.triangle.indices):
        raise OptionError(
            f"no surface was seen by at least {least:g} of {frames} frames between {options.near:g} and"
            f" {options.far:g} m; lower --weight, raise --far, or check the poses and the depth unit"
        )
    report("cleaning", 0.85)
    return _finished(o3d, mesh, options, skipped, frames)


def open3d_for_reconstruction(threads: int | None) -> Any:
    """Open3D, limited to that many threads, without its remarks on stdout.

    Raises:
        OptionError: It is not installed, or its library does not load.
    """
    o3d = load_open3d("Open3D is needed to reconstruct: pip install 'warp-dvct[reconstruct]'", OptionError)
    o3d.utility.set_max_threads(threads or len(os.sched_getaffinity(0)))
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    return o3d


def count_blocks(source: FrameSource, options: FusionOptions, skipped: Skipped, report: Any) -> int:
    """Number of blocks that any frame's surface and its truncation band touch."""
    seen = np.zeros(0, np.int64)
    for index, frame in usable_frames(source, skipped, color=False):
        points, rays = _sample_points(frame, options)
        band = options.truncation * options.voxel
        cells = [
            np.floor((points + share * band * rays) / (options.voxel * BLOCK)).astype(np.int64)
            for share in (-1.0, -0.5, 0.0, 0.5, 1.0)
        ]
        # 21 bits a coordinate: two million blocks either way.
        packed = [((c[:, 0] + 2**20) << 42) | ((c[:, 1] + 2**20) << 21) | (c[:, 2] + 2**20) for c in cells]
        seen = np.unique(np.concatenate([seen, *packed]))
        report((index + 1) / len(source))
    return len(seen)


def _sample_points(frame: RgbdFrame, options: FusionOptions) -> tuple[np.ndarray, np.ndarray]:
    """World positions of some pixels, and the unit directions in which they are seen."""
    assert frame.pose is not None
    stride = max(1, frame.depth.shape[1] // COUNT_PIXELS)
    depth = frame.depth[::stride, ::stride]
    v, u = np.nonzero((depth >= options.near) & (depth <= options.far))
    z = depth[v, u].astype(np.float64)
    pixels = np.stack([u * stride, v * stride, np.ones(len(u))], -1)
    local = (pixels @ np.linalg.inv(frame.K).T) * z[:, None]
    points = local @ frame.pose[:3, :3].T + frame.pose[:3, 3]
    return points, (local / np.linalg.norm(local, axis=-1, keepdims=True)) @ frame.pose[:3, :3].T


def _check_memory(blocks: int, options: FusionOptions) -> None:
    needed = int(blocks * SPARE_BLOCKS) * BLOCK**3 * BYTES_PER_VOXEL
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if needed > MEMORY_SHARE * free:
        # Blocks near a surface grow with its area in blocks.
        fitting = options.voxel * np.sqrt(needed / (MEMORY_SHARE * free))
        raise DeviceError(
            f"voxels of {options.voxel:g} m need {needed / 2**30:.1f} GiB for {blocks} blocks, of"
            f" {free / 2**30:.1f} GiB free; give --voxel {fitting:.2g} or more, or a smaller --far"
        )


def integrate(o3d: Any, source: FrameSource, options: FusionOptions, blocks: int, skipped: Skipped, report: Any) -> Any:
    """Bring frames into voxels.

    Args:
        blocks: How many blocks of voxels to make room for. report: Called with the share of the frames that is done.
    Returns:
        ``VoxelBlockGrid``.
    """
    core = o3d.core
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"),
        (core.float32, core.float32, core.float32),
        ((1), (1), (3)),
        options.voxel,
        BLOCK,
        max(1, int(blocks * SPARE_BLOCKS)),
    )
    band = (1.0, options.far, options.truncation)  # metres per step, most depth, truncation
    for index, frame in usable_frames(source, skipped):
        assert frame.pose is not None
        depth = clean_depth(o3d, frame.depth, options)
        # Open3D cuts pixel coordinates off instead of rounding: its pixel centres lie at half numbers.
        K, extrinsic = core.Tensor(frame.K + HALF_PIXEL), core.Tensor(np.linalg.inv(frame.pose))
        color = np.zeros((*depth.shape[:2], 3), np.float32) if frame.color is None else frame.color
        # A pixel without colour would pull the mean to black: its depth waits for a frame that sees it in colour.
        unseen = np.asarray(~np.isfinite(color).all(-1))
        if unseen.any():
            depth[unseen], color = 0.0, np.where(unseen[..., None], np.float32(0.0), color)
        if not depth.any():
            skipped.add(index, f"{frame.name}: no pixel is between {options.near:g} and {options.far:g} m")
            continue
        image = o3d.t.geometry.Image(core.Tensor(depth))
        touched = grid.compute_unique_block_coordinates(image, K, extrinsic, *band)
        tint = o3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(color, np.float32)))
        grid.integrate(touched, image, tint, K, K, extrinsic, *band)
        report((index + 1) / len(source))
    return grid


def clean_depth(o3d: Any, depth: np.ndarray, options: FusionOptions) -> np.ndarray:
    """Depth without pixels on the edge of something and out of range, smoothed where ``options`` says so.

    Structured light and stereo measure disparity, so their noise is even in 1/depth, in which planes are linear too: a
    bilateral filter there keeps planes and edges. Pixels at a jump mix both sides and would hang in the air.

    Returns:
        float32 ``[h, w, 1]``, contiguous, 0 where nothing is left.
    """
    valid = (depth >= max(options.near, 1e-3)) & (depth <= options.far)
    inverse = np.where(valid, 1.0 / np.where(valid, depth, 1.0), 0.0).astype(np.float32)
    keep = valid & ~_at_jump(inverse)
    if options.smooth:
        image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(inverse[..., None])))
        smooth = image.filter_bilateral(SMOOTH_WINDOW, SMOOTH_RANGE * INVERSE_DEPTH_NOISE, SMOOTH_WINDOW / 2)
        inverse = smooth.as_tensor().numpy()[..., 0]
    return np.where(keep, 1.0 / np.where(keep, inverse, 1.0), 0.0).astype(np.float32)[..., None]


def _at_jump(inverse: np.ndarray) -> np.ndarray:
    """Pixels beside one that differs by more than noise and the slope of a surface do, and beside holes: sensors lose
    the pixels at a jump, and what they keep beside them is often wrong.

    The second difference is that of the noise alone where the surface is plane, however it slopes.
    """
    jump = np.zeros(inverse.shape, bool)
    limit = JUMP * INVERSE_DEPTH_NOISE
    jump[:, 1:-1] |= np.abs(np.diff(inverse, 2, axis=1)) > limit
    jump[1:-1] |= np.abs(np.diff(inverse, 2, axis=0)) > limit
    return jump


def _finished(o3d: Any, mesh: Any, options: FusionOptions, skipped: Skipped, frames: int) -> FusedMesh:
    """Drop floaters, close holes, decimate."""
    legacy = _in_order(o3d, mesh.to_legacy())
    of_triangle, _, areas = legacy.cluster_connected_triangles()
    areas = np.asarray(areas)
    least = options.least_area if options.least_area is not None else (LEAST_EDGE * options.voxel) ** 2
    floats = areas < min(least, areas.max())
    legacy.remove_triangles_by_mask(floats[np.asarray(of_triangle)])
    legacy.remove_unreferenced_vertices()
    if options.close_holes > 0.0:
        legacy = _closed(o3d, legacy, options.close_holes)
    if options.triangles is not None and len(legacy.triangles) > options.triangles:
        legacy = legacy.simplify_quadric_decimation(options.triangles)
        legacy.remove_degenerate_triangles()
        legacy.remove_unreferenced_vertices()
        legacy.compute_vertex_normals()
    has_color = legacy.has_vertex_colors()
    return FusedMesh(
        points=np.asarray(legacy.vertices, np.float32),
        normals=np.asarray(legacy.vertex_normals, np.float32),
        colors=np.asarray(legacy.vertex_colors, np.float32) if has_color else None,
        triangles=np.asarray(legacy.triangles, np.int32),
        skipped=dict(skipped.reasons),
        frames=frames,
        components=len(areas),
        dropped=int(floats.sum()),
    )


def _in_order(o3d: Any, legacy: Any) -> Any:
    """The mesh with vertices sorted by place and triangles by vertices: Open3D's threads leave them in any order."""
    points, triangles = np.asarray(legacy.vertices), np.asarray(legacy.triangles)
    order = np.lexsort(points.T[::-1])
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    corners = rank[triangles]
    first = corners.argmin(1)
    corners = np.take_along_axis(corners, (first[:, None] + np.arange(3)) % 3, 1)
    corners = corners[np.lexsort(corners.T[::-1])]
    sorted_mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(points[order]), o3d.utility.Vector3iVector(corners.astype(np.int32))
    )
    sorted_mesh.vertex_normals = o3d.utility.Vector3dVector(np.asarray(legacy.vertex_normals)[order])
    if legacy.has_vertex_colors():
        sorted_mesh.vertex_colors = o3d.utility.Vector3dVector(np.asarray(legacy.vertex_colors)[order])
    return sorted_mesh


def _closed(o3d: Any, legacy: Any, radius: float) -> Any:
    """Triangles over holes up to that radius; they take colour and normals of the rim's vertices, which they share."""
    return o3d.t.geometry.TriangleMesh.from_legacy(legacy).fill_holes(radius).to_legacy()

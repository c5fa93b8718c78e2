"""Second and further bounces: a radiosity solution on patches, re-injected into the volumes."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kept import Kept
from warp_dvct.kernels import bounces as kernels
from warp_dvct.launch import Launcher
from warp_dvct.passes.patches import Patches, bounce_field, fragments_of
from warp_dvct.passes.voxels import Voxels

PATCH_HITS = "patches' real hits"


def mean_albedo(launcher: Launcher, scene: DeviceScene, voxels: Voxels, normals: Any) -> Any:
    """Area-weighted hemispherical albedo per level-0 record, real and synthetic surfaces: vec3 ``[records * 2]``."""
    pieces = voxels.fragments
    records = voxels.level_records[0]
    albedo = launcher.zeros(max(1, records * 2), wp.vec3)
    launcher.launch(
        kernels._mean_albedo,
        records,
        [
            scene.geometry,
            scene.materials,
            normals,
            pieces.record_start,
            pieces.order,
            pieces.triangle,
            pieces.place,
            pieces.count,
            records,
        ],
        [albedo],
    )
    return albedo


def solve_bounces(
    launcher: Launcher,
    scene: DeviceScene,
    world: Any,
    patches: Patches,
    *,
    bounces: int,
    rays: int,
    seed: int = 0,
    kept: Kept | None = None,
) -> Any:
    """Irradiance of patches from bounces 1 … ``bounces``, before and after: vec3 ``[patches * 2]``.

    Args:
        world: ``kernels.radiosity.World`` whose volumes hold directly lit radiosity.
        rays: Cosine-distributed rays per patch; they are traced once.
        kept: Holds what these rays met in the real scene from frame to frame, patch by patch.
    """
    count = patches.count
    kept = kept or Kept()
    key = (patches.voxels.box, patches.level, rays, seed)
    hits = _patch_hits(launcher, patches, rays)
    links = launcher.empty(max(1, count * rays), wp.vec2i)
    last, parts = launcher.zeros(max(1, 2 * count), wp.vec3), launcher.parts(count)
    shares = last if parts == 1 else launcher.empty(max(1, 2 * count * parts), wp.vec3)
    launcher.launch(
        kernels._link_patches,
        count * parts,
        [
            scene.geometry,
            world,
            patches.data,
            bounce_field(launcher, patches, last),
            kept.last(PATCH_HITS, key) or kernels.PatchHits(),
            rays,
            parts,
            seed,
        ],
        [links, shares, hits.distance, hits.triangle],
    )
    if parts > 1:
        launcher.launch(kernels._sum_parts, 2 * count, [parts, shares], [last])
    kept.put(PATCH_HITS, key, hits)
    total = launcher.empty(max(1, 2 * count), wp.vec3)
    wp.copy(total, last)
    following = launcher.zeros(max(1, 2 * count), wp.vec3)
    for _ in range(bounces - 1):
        launcher.launch(kernels._bounce, count, [patches.data, links, rays, last], [following, total])
        last, following = following, last
    return total


def _patch_hits(launcher: Launcher, patches: Patches, rays: int) -> Any:
    """``PatchHits`` of patches, still to be filled."""
    hits = kernels.PatchHits()
    hits.count, hits.patches = patches.count, patches.data
    hits.distance = launcher.empty(max(1, patches.count * rays), wp.float32)
    hits.triangle = launcher.empty(max(1, patches.count * rays), wp.int32)
    return hits


def reinject(
    launcher: Launcher,
    scene: DeviceScene,
    normals: Any,
    voxels: Voxels,
    albedo: Any,
    flux: Any,
    patches: Patches,
    total: Any,
) -> None:
    """Add what a volume's surfaces reflect of the patches' irradiance to ``flux``, in place.

    Args:
        albedo: Of the volume's records, by :func:`mean_albedo`. total: By :func:`solve_bounces`.
    """
    field = bounce_field(launcher, patches, total)
    pieces = fragments_of(voxels)
    launcher.launch(
        kernels._reinject,
        voxels.level_records[0],
        [
            scene.geometry,
            normals,
            voxels.level_keys[0],
            voxels.volume,
            voxels.area,
            pieces,
            albedo,
            field,
        ],
        [flux],
    )

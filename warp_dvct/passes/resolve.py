"""From shading points to the pixels of a ``Radiance``."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import resolve as kernels
from warp_dvct.launch import Launcher
from warp_dvct.layers import Radiance
from warp_dvct.passes.gbuffer import GBuffer, new_points


def resolve(
    launcher: Launcher,
    scene: DeviceScene,
    buffer: GBuffer,
    env: Any,
    *,
    light: Any,
    before: Any,
    behind_before: Any,
    with_before: bool,
) -> Radiance:
    """Average the shading points of each pixel (box filter).

    Args:
        light: vec3 ``[count]``: after on synthetic points, after - before on real ones.
        before, behind_before: Radiance before at points and at the real surfaces behind synthetic ones; read only
            ``with_before``.
    """
    pixels = buffer.width * buffer.height
    delta, albedo, normal, position = (launcher.empty(pixels, wp.vec3) for _ in range(4))
    synthetic = launcher.empty(pixels, wp.vec4)
    mask_real, depth = (launcher.empty(pixels, wp.float32) for _ in range(2))
    plate = launcher.empty(pixels if with_before else 1, wp.vec3)
    behind = buffer.behind if with_before else new_points(launcher, 1)
    behind_rank = buffer.behind_rank if with_before else launcher.zeros(1, wp.int32)
    launcher.launch(
        kernels._resolve,
        pixels,
        [
            buffer.points,
            buffer.edge_rank,
            light,
            before,
            behind,
            behind_rank,
            behind_before,
            env,
            pixels,
            max(1, buffer.edge_samples),
            int(with_before),
        ],
        [plate, delta, synthetic, mask_real],
    )
    launcher.launch(
        kernels._write_surfaces,
        pixels,
        [buffer.points, scene.camera, wp.vec3(*scene.origin), 1.0 / scene.scale],
        [albedo, normal, position, depth],
    )
    return Radiance(
        buffer.width,
        buffer.height,
        plate if with_before else None,
        delta,
        synthetic,
        albedo,
        normal,
        position,
        depth,
        mask_real,
    )

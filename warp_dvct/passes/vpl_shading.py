"""Light of VPLs at shading points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import vpl_shading
from warp_dvct.launch import Launcher
from warp_dvct.passes.gbuffer import GBuffer, compact
from warp_dvct.passes.lobe_smoothing import Smoothing, add_reflected, new_reflected

PLANE_TOLERANCE = 0.5  # distance off the tangent plane, in tiles, at which a neighbour counts 1/e
NORMAL_SHARPNESS = 8.0  # exponent of the normals' cosine


@dataclass(frozen=True)
class VplLight:
    """VPLs and how they see.

    Attributes:
        scene: What they light.
        vpls: ``kernels.vpls.Vpls``. sight: ``kernels.ism.Sight``.
        tiles: Edge of the interleaved tiles; 1 lights every pixel by every VPL.
        with_before: Whether the radiance before is wanted, or only the difference of the two solutions.
    """

    scene: DeviceScene
    vpls: Any
    sight: Any
    tiles: int
    with_before: bool

    def irradiance(
        self, launcher: Launcher, points: Any, index: Any, count: int, *, stride: int = 1, width: int = 0
    ) -> tuple[Any, Any]:
        """Irradiance [W m^-2], before and after, at the points listed in ``index``: two vec3 ``[count]``.

        Args:
            stride: Use one VPL in so many. width: Of the picture, where points are the pixels of interleaved tiles.
        """
        before, after = (launcher.empty(max(1, count), wp.vec3) for _ in range(2))
        launcher.launch(
            vpl_shading._shade_vpls,
            count,
            [
                points,
                index,
                self.scene.geometry,
                self.vpls,
                self.sight,
                width,
                self.tiles,
                stride,
                int(self.with_before),
            ],
            [before, after],
        )
        return before, after


def light_picture(launcher: Launcher, buffer: GBuffer, light: VplLight) -> tuple[Any, Any]:
    """Irradiance, before and after, at every shading point of a picture: two vec3 ``[buffer.count]``.

    Pixels of a tile share the VPLs out and a merge that respects depth and normals collects them (Segovia et al. 2006,
    "Non-interleaved Deferred Shading of Interleaved Sample Patterns"). Points without like neighbours get all VPLs.
    """
    pixels = buffer.width * buffer.height
    if light.tiles == 1:
        return light.irradiance(launcher, buffer.points, indices(launcher, buffer.count), buffer.count)
    split = light.irradiance(
        launcher, buffer.points, indices(launcher, pixels), pixels, stride=light.tiles**2, width=buffer.width
    )
    before, after = (launcher.zeros(buffer.count, wp.vec3) for _ in range(2))
    missing = launcher.empty(buffer.count, wp.int32)
    launcher.launch(
        vpl_shading._merge_tiles,
        buffer.count,
        [
            buffer.points,
            buffer.width,
            buffer.height,
            light.tiles,
            PLANE_TOLERANCE,
            NORMAL_SHARPNESS,
            *split,
        ],
        [before, after, missing],
    )
    _, index, left = compact(launcher, missing)
    rest = light.irradiance(launcher, buffer.points, index, left)
    launcher.launch(vpl_shading._put, left, [index, *rest], [before, after])
    return before, after


def light_points(launcher: Launcher, points: Any, count: int, light: VplLight) -> tuple[Any, Any]:
    """Irradiance at points that are no picture, each by one VPL in ``light.tiles``."""
    return light.irradiance(launcher, points, indices(launcher, count), count, stride=light.tiles)


def indices(launcher: Launcher, count: int) -> Any:
    """0 … count - 1 on the device."""
    return launcher.array(np.arange(max(1, count), dtype=np.int32), wp.int32)


def shade_direct_single(
    launcher: Launcher,
    scene: DeviceScene,
    points: Any,
    count: int,
    direct: Any,
    sight: Any,
    far: float,
    *,
    light: Any,
    before: Any,
) -> None:
    """Direct light with the single shadow map of 2010, as rays from the light would draw it; written, not added."""
    launcher.launch(
        vpl_shading._shade_direct_single,
        count,
        [points, scene.geometry, scene.lights, direct, sight, far],
        [light, before],
    )


def shade_glossy(
    launcher: Launcher,
    light: VplLight,
    env: Any,
    points: Any,
    index: Any,
    count: int,
    glossy: Any,
    smoothing: Smoothing,
    *,
    out: Any,
    before: Any,
) -> None:
    """Add reflections in glossy surfaces, by rays, to ``out`` (and ``before``) at the points listed in ``index``."""
    scene = light.scene
    reflected = new_reflected(launcher, count)
    launcher.launch(
        vpl_shading._shade_glossy,
        count,
        [
            points,
            index,
            scene.geometry,
            scene.materials,
            scene.lights,
            env,
            light.vpls,
            light.sight,
            glossy,
        ],
        [reflected],
    )
    to = {"light": out, "before": before, "with_before": light.with_before}
    add_reflected(launcher, scene, points, index, count, reflected, smoothing, **to)


@dataclass(frozen=True)
class Agreement:
    """How imperfect shadow maps compare with exact rays over pairs of a point and a VPL that face each other.

    Attributes:
        pairs: How many were asked.
        agree: Share in which both give the same answers, for real and for synthetic blockers.
        only_maps, only_rays: Shares that only the maps, or only the rays, find blocked.
    """

    pairs: int
    agree: float
    only_maps: float
    only_rays: float


def compare_sight(
    launcher: Launcher, scene: DeviceScene, points: Any, count: int, vpls: Any, maps: Any, rays: Any
) -> Agreement:
    """Ask both ``maps`` and ``rays`` for all pairs of ``count`` points and the VPLs."""
    pairs = launcher.empty(max(1, count), wp.vec4i)
    launcher.launch(vpl_shading._compare_sight, count, [points, scene.geometry, vpls, maps, rays], [pairs])
    total, agree, only_maps, only_rays = (int(n) for n in pairs.numpy().sum(0, dtype=np.int64))
    share = 1.0 / max(total, 1)
    return Agreement(total, agree * share, only_maps * share, only_rays * share)

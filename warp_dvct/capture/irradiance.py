"""Light that falls on the points of a scanned surface, by the renderer's own passes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.capture.fusion import FusedMesh
from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels.gbuffer import REAL, WHOLE, Points
from warp_dvct.kernels.shading import Direct
from warp_dvct.launch import Launcher
from warp_dvct.methods.light_field import light_volumes
from warp_dvct.passes.gather import Gatherer, gather_all
from warp_dvct.passes.shading import shade_direct
from warp_dvct.plan import Plan, make_plan
from warp_dvct.scene import Camera, Light, Material, Mesh, Role, Scene
from warp_dvct.settings import make_settings

LAMBERT = Material(base_color=(1.0, 1.0, 1.0), roughness=1.0, specular_color=(0.0, 0.0, 0.0), name="fused")
GATHER_RAYS = 128
BOUNCES = 24  # photographs hold all; in a closed room six leave out a tenth, and more cost next to nothing
PICTURE_WIDTH = 1024  # any: points are laid out as a picture's pixels, by which random numbers go


@dataclass(frozen=True)
class Receivers:
    """Points that light falls on, in world metres.

    Attributes:
        points, normals: float ``[n, 3]``; the normals are unit vectors.
        lift: Metres by which rays start above the surface, so that its noise does not shadow it.
    """

    points: np.ndarray
    normals: np.ndarray
    lift: float


def real_scene(mesh: FusedMesh, albedo: np.ndarray, lights: tuple[Light, ...]) -> Scene:
    """A scene of the scanned surface alone, Lambertian, with an albedo ``[v, 3]`` per vertex."""
    camera = Camera(np.eye(4), -1.0, 1.0, -1.0, 1.0)
    surface = Mesh(
        points=np.asarray(mesh.points, np.float64),
        triangles=mesh.triangles,
        materials=np.zeros(len(mesh.triangles), np.int32),
        role=Role.REAL,
        corner_colors=np.asarray(albedo, np.float32)[mesh.triangles],
        path="/fused",
    )
    return Scene((surface,), (LAMBERT,), (), lights, camera)


class Lighting:
    """A scanned surface with an albedo under known lights, from which irradiance is asked for.

    Args:
        albedo: Per vertex, ``[v, 3]``; it decides the light that bounces.
        lights: In the world.
        quality: Preset of the volumes.
    """

    def __init__(
        self,
        launcher: Launcher,
        mesh: FusedMesh,
        albedo: np.ndarray,
        lights: tuple[Light, ...],
        *,
        quality: str = "balanced",
        seed: int = 0,
    ) -> None:
        self._launcher = launcher
        self._scene = real_scene(mesh, albedo, lights)
        self._plan: Plan = make_plan(
            self._scene,
            make_settings(quality, {"seed": seed, "bounces": BOUNCES}),
            "delta-cones",
            8,
            8,
            has_plate=False,
        )
        self._device = DeviceScene.upload(launcher, self._scene, np.asarray(self._plan.origin), self._plan.scale)
        self._seed = seed

    def direct(self, at: Receivers) -> np.ndarray:
        """Irradiance [W m^-2] of all lights but domes, by shadow rays, float32 ``[n, 3]``."""
        launcher, count = self._launcher, len(at.points)
        settings = Direct()
        settings.samples, settings.probes, settings.edge_samples = 16, 4, 1
        settings.with_before, settings.seed, settings.alpha_max = 1, self._seed, -1.0
        light, before = launcher.zeros(count, wp.vec3), launcher.zeros(count, wp.vec3)
        shade_direct(launcher, self._device, self._points(at), count, settings, light=light, before=before)
        return np.pi * before.numpy()  # points have a diffuse albedo of 1, so radiance is E / pi

    def gathered(self, at: Receivers, rays: int = GATHER_RAYS) -> np.ndarray:
        """Irradiance [W m^-2] of domes and of light that bounced off the surface, float32 ``[n, 3]``."""
        volumes = light_volumes(self._launcher, self._scene, self._device, self._plan)
        gatherer = Gatherer(self._device, volumes.world, rays, self._seed)
        before, _ = gather_all(self._launcher, self._points(at), len(at.points), gatherer)
        return before.numpy()[: len(at.points)]

    def _points(self, at: Receivers) -> Any:
        """Shading points in volume space: white Lambertian surfaces seen from straight above."""
        launcher, count = self._launcher, len(at.points)
        normal = np.asarray(at.normals, np.float32)
        origin, scale = self._device.origin, self._device.scale
        position = ((at.points + at.lift * at.normals - origin) * scale).astype(np.float32)
        white = launcher.full(count, wp.vec3(1.0, 1.0, 1.0), wp.vec3)
        points = Points()
        for name, variable in Points.vars.items():
            setattr(points, name, launcher.zeros(count, variable.type.dtype))
        # Random numbers go by pixel: a picture with one point a pixel.
        pixels = np.stack([np.arange(count) % PICTURE_WIDTH, np.arange(count) // PICTURE_WIDTH], -1)
        points.pixel = launcher.array(pixels.astype(np.int32), wp.vec2i)
        points.slot = launcher.full(count, int(WHOLE), wp.int32)
        points.role = launcher.full(count, int(REAL), wp.int32)
        points.position = launcher.array(position, wp.vec3)
        points.normal_g = points.normal = points.view = launcher.array(normal, wp.vec3)
        points.base_color = points.diffuse = white
        points.lobe = launcher.full(count, wp.vec2(0.0, 1.0), wp.vec2)
        points.reach = launcher.array(np.abs(position).max(-1), wp.float32)
        return points

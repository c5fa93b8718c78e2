"""Twins of the G-buffer: camera rays, their nearest surfaces, and the BRDF that the direct light uses."""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_dvct.bench.twins.deviation import Deviation, compare
from warp_dvct.bench.twins.numbers import dot, unit
from warp_dvct.bench.twins.stage import POINT, Twin, make_scene
from warp_dvct.kernels import gbuffer as kernels
from warp_dvct.passes.gbuffer import render_gbuffer, see_real

WIDTH, HEIGHT = 40, 30


def camera_rays(twin: Twin, px: np.ndarray, py: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions through continuous pixel coordinates."""
    camera = twin.scene.camera
    x = camera.tan_left + (camera.tan_right - camera.tan_left) * px / WIDTH
    y = camera.tan_top + (camera.tan_bottom - camera.tan_top) * py / HEIGHT
    turn = camera.to_world[:3, :3]
    through = x[:, None] * turn[:, 0] + y[:, None] * turn[:, 1] - turn[:, 2]
    return np.broadcast_to(camera.to_world[:3, 3], through.shape), unit(through)


def pixel_centers() -> tuple[np.ndarray, np.ndarray]:
    """Continuous coordinates of all pixels' centres."""
    index = np.arange(WIDTH * HEIGHT)
    return index % WIDTH + 0.5, index // WIDTH + 0.5


def measure_gbuffer(launcher: Any) -> list[Deviation]:
    """Where the camera's rays end in the real scene, by brute force."""
    twin = Twin.upload(launcher, make_scene(POINT))
    points, reach = see_real(launcher, twin.device, WIDTH, HEIGHT)
    origin, direction = camera_rays(twin, *pixel_centers())
    t, triangle = twin.nearest(origin, direction, twin.real)
    normal = twin.normals[triangle]
    normal = np.where(dot(normal, direction)[:, None] > 0.0, -normal, normal)
    kernel = kernels._see_real
    return [
        compare(kernel, "reach", reach.numpy(), t),
        compare(kernel, "points.position", points.position.numpy(), origin + direction * t[:, None]),
        compare(kernel, "points.normal", points.normal.numpy(), normal),
    ]


class Surfaces:
    """Shading points as the kernels hold them, in float64: inputs of a kernel and of its twin alike."""

    def __init__(self, points: Any) -> None:
        self.role, self.triangle = points.role.numpy(), points.triangle.numpy()
        names = ("position", "normal_g", "normal", "view", "base_color", "diffuse", "f0")
        self.position, self.normal_g, self.normal, self.view, self.base_color, self.diffuse, self.f0 = (
            getattr(points, name).numpy().astype(np.float64) for name in names
        )
        self.f90, self.alpha = points.lobe.numpy().astype(np.float64).T
        self.footprint = points.footprint.numpy().astype(np.float64)


def picture_points(launcher: Any, twin: Twin) -> tuple[Any, Surfaces]:
    """The G-buffer of the picture without anti-aliasing, and its surfaces."""
    buffer = render_gbuffer(launcher, twin.device, WIDTH, HEIGHT, edge_samples=0, behind=False)
    return buffer, Surfaces(buffer.points)


def fresnel(s: Surfaces, cos: np.ndarray) -> np.ndarray:
    """Schlick's approximation with a chosen grazing reflectance."""
    return s.f0 + (s.f90[:, None] - s.f0) * np.clip(1.0 - cos, 0.0, 1.0)[:, None] ** 5


def brdf_cos(s: Surfaces, wi: np.ndarray) -> np.ndarray:
    """Lambert under its interface, plus GGX with height-correlated Smith masking (Heitz 2014), times the cosine."""
    ci, co = dot(s.normal, wi), dot(s.normal, s.view)
    front = (ci > 0) & (co > 0) & (dot(s.normal_g, wi) > 0) & (dot(s.normal_g, s.view) > 0)
    ci, co = np.where(front, ci, 1.0), np.where(front, co, 1.0)
    diffuse = s.diffuse * (1.0 - fresnel(s, ci)) * (1.0 - fresnel(s, co)) * (ci / np.pi)[:, None]
    h = unit(s.view + wi)
    a2, ch = s.alpha**2, dot(s.normal, h)
    d = a2 / (np.pi * (1.0 - ch**2 + a2 * ch**2) ** 2)
    root_i, root_o = (np.sqrt(a2 + (1.0 - a2) * c**2) for c in (ci, co))
    masking = 0.5 / (ci * root_o + co * root_i)
    specular = fresnel(s, dot(s.view, h)) * (d * masking * ci * (s.f90 > 0))[:, None]
    return np.where(front[:, None], diffuse + specular, 0.0)

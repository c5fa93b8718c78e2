"""Twins of the G-buffer: camera rays, their nearest surfaces, and the BRDF that the direct light uses."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_dvct.bench.twins.deviation import Deviation, compare
from warp_dvct.bench.twins.numbers import dot, unit
from warp_dvct.bench.twins.stage import POINT, Twin, make_scene
from warp_dvct.kernels import gather
from warp_dvct.kernels import gbuffer as kernels
from warp_dvct.passes.gather import shade_indirect
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
    view = see_real(launcher, twin.device, WIDTH, HEIGHT)
    points = view.points
    origin, direction = camera_rays(twin, *pixel_centers())
    t, triangle = twin.nearest(origin, direction, twin.real)
    normal = twin.normals[triangle]
    normal = np.where(dot(normal, direction)[:, None] > 0.0, -normal, normal)
    kernel = kernels._see_real
    return [
        compare(kernel, "reach", view.reach.numpy(), t),
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


def specular_albedo(f0: np.ndarray, f90: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """What the GGX lobe reflects of even light: the polynomials of ``kernels/materials.py``, fitted to the integral."""
    a, b = (
        np.polynomial.polynomial.polyval(alpha, c)
        for c in (
            (0.95334536, 0.02103164, -2.02790049, 2.2942133, -0.83604742),
            (0.04852881, -0.1654349, 0.21658104, -0.09786304),
        )
    )
    return f0 * a[:, None] + (f90 * np.maximum(b, 0.0))[:, None]


def measure_indirect_shading(launcher: Any) -> list[Deviation]:
    """What the picture's points make of irradiance: a Lambert lobe under its interface, and a rough GGX lobe."""
    twin = Twin.upload(launcher, make_scene(POINT))
    buffer, s = picture_points(launcher, twin)
    rng = np.random.default_rng(11)
    given = [rng.uniform(0, 4, (buffer.count, 3)).astype(np.float32) for _ in range(2)]
    light, before = (launcher.zeros(buffer.count, wp.vec3) for _ in range(2))
    shade_indirect(
        launcher,
        buffer.points,
        buffer.count,
        (launcher.array(given[0], wp.vec3), launcher.array(given[1], wp.vec3)),
        alpha_max=0.1,
        light=light,
        before=before,
        with_before=True,
    )
    passed = 1.0 - s.f0 - (s.f90[:, None] - s.f0) / 21.0
    leave = 1.0 - fresnel(s, dot(s.normal, s.view))
    rough = ((s.f90 > 0.0) & (s.alpha > 0.1))[:, None]
    share = (s.diffuse * passed * leave + np.where(rough, specular_albedo(s.f0, s.f90, s.alpha), 0.0)) / np.pi
    real = (s.role == 0)[:, None]
    kernel = gather._shade_indirect
    return [
        compare(kernel, "light", light.numpy(), share * np.where(real, given[1].astype(float) - given[0], given[1])),
        compare(kernel, "before", before.numpy(), np.where(real, share * given[0], 0.0)),
    ]

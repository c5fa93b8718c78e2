"""Twins of light that comes straight from the lights: RSM beams, direct shading, the path tracer's first vertex."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_dvct.bench.twins.deviation import Deviation, compare
from warp_dvct.bench.twins.numbers import (
    concentric_disk,
    cosine_hemisphere,
    dot,
    from_frame,
    sobol2,
    uniform2,
    uniform_cone,
    unit,
)
from warp_dvct.bench.twins.stage import LAMP, MATERIALS, POINT, SUN, Twin, make_scene
from warp_dvct.bench.twins.surfaces import HEIGHT, WIDTH, Surfaces, brdf_cos, camera_rays, picture_points
from warp_dvct.kernels import path_tracing, rsm, shading
from warp_dvct.methods.path_tracing import PathTracer
from warp_dvct.passes.rsm import render_real
from warp_dvct.passes.shading import shade_direct
from warp_dvct.scene import Light, LightKind

SIZE, RADIUS, START = 32, 0.75, 2.0
CENTER = np.array([0.5, 0.5, 0.5])


def planar(light: Light) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Half edges, unit direction of emission and area of a RECT."""
    x, y = np.asarray(light.axis_x), np.asarray(light.axis_y)
    cross = np.cross(x, y)
    normal = unit(cross) * np.sign(cross @ np.asarray(light.direction))
    return x, y, normal, 4.0 * float(np.linalg.norm(cross))


def beams(light: Light, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins, directions and fluxes of a map's texels, for a target around the light."""
    texel = np.arange(SIZE * SIZE)
    place = (np.stack([texel % SIZE, texel // SIZE], 1) + uniform2(0, texel, index, 0)) / SIZE
    xi = sobol2(0, index, texel, 1)
    radiance = np.asarray(light.radiance) / SIZE**2
    position = np.broadcast_to(np.asarray(light.position), (len(texel), 3))
    axis = np.broadcast_to(np.asarray(light.direction, float), (len(texel), 3))
    if light.kind == LightKind.POINT:
        toward = np.broadcast_to(unit(CENTER - np.asarray(light.position)), axis.shape)
        return position, from_frame(uniform_cone(place, 2.0), toward), np.tile(4.0 * np.pi * radiance, (len(texel), 1))
    if light.kind == LightKind.DISTANT:
        disc = np.concatenate([concentric_disk(place) * RADIUS, np.zeros((len(texel), 1))], 1)
        return (
            CENTER + from_frame(disc, axis) - axis * START,
            axis,
            np.tile(np.pi * RADIUS**2 * radiance, (len(texel), 1)),
        )
    x, y, normal, area = planar(light)
    spread = 2.0 * xi - 1.0
    origin = position + spread[:, :1] * x + spread[:, 1:] * y
    origin = origin + normal * (2.0e-6 * np.maximum(np.abs(origin).max(-1, keepdims=True), 1.0))
    direction = from_frame(cosine_hemisphere(place), np.broadcast_to(normal, origin.shape))
    return origin, direction, np.tile(np.pi * area * radiance, (len(texel), 1))


def measure_rsm(launcher: Any) -> list[Deviation]:
    """A map of each kind of light: where beams end, and the flux that is reflected there."""
    twin = Twin.upload(launcher, make_scene(POINT, LAMP, SUN))
    found = []
    for index, light in enumerate(twin.scene.lights):
        got = render_real(launcher, twin.device, index, SIZE, center=tuple(CENTER), radius=RADIUS, start=START)
        origin, direction, flux = beams(light, index)
        t, _ = twin.nearest(origin, direction, twin.real)
        met = np.isfinite(t) & (got.role.numpy() == 0)
        place = origin[met] + direction[met] * t[met, None]
        reflected = flux[met] * np.asarray(MATERIALS[0].base_color)
        kind = light.kind.name
        found += [
            compare(rsm._render_real, f"direction, {kind}", got.direction.numpy(), direction),
            compare(rsm._render_real, f"position, {kind}", got.position.numpy()[met], place),
            compare(rsm._render_real, f"flux, {kind}", got.flux.numpy()[met], reflected),
        ]
    return found


def sample_light(light: Light, position: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions, distances and irradiance of a light without extent on a plane that faces it."""
    if light.kind == LightKind.DISTANT:
        direction = np.broadcast_to(-np.asarray(light.direction), position.shape)
        return direction, np.full(len(position), 1e18), np.broadcast_to(np.asarray(light.radiance), position.shape)
    d = np.asarray(light.position) - position
    return unit(d), np.linalg.norm(d, axis=-1), np.asarray(light.radiance) / dot(d, d)[:, None]


def seen(twin: Twin, s: Surfaces, direction: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether points see along a direction past real surfaces, and past all: two ``[n]`` of 0 and 1."""
    side = np.sign(dot(s.normal_g, direction))[:, None]
    origin = twin.spawn(s.position, s.triangle, s.normal_g * np.where(side == 0, 1.0, side))
    before, synthetic = (twin.nearest(origin, direction, part)[0] >= reach for part in (twin.real, twin.synthetic))
    return before.astype(float), (before & synthetic).astype(float)


def measure_direct(launcher: Any) -> list[Deviation]:
    """Direct light with exact shadows of lights without extent (Franke 2014, eqs. 5 and 7)."""
    twin = Twin.upload(launcher, make_scene(POINT, SUN, closed=False))
    buffer, s = picture_points(launcher, twin)
    settings = shading.Direct()
    settings.samples = settings.probes = settings.edge_samples = 1
    settings.alpha_max, settings.with_before = -1.0, 1
    light, before = (launcher.zeros(buffer.count, wp.vec3) for _ in range(2))
    shade_direct(launcher, twin.device, buffer.points, buffer.count, settings, light=light, before=before)

    sum_before, sum_after = np.zeros((buffer.count, 3)), np.zeros((buffer.count, 3))
    for source in twin.scene.lights:
        direction, distance, value = sample_light(source, s.position)
        open_before, open_after = seen(twin, s, direction, 0.9999 * distance)
        f = brdf_cos(s, direction) * value
        sum_before += f * open_before[:, None]
        sum_after += f * open_after[:, None]
    real = (s.role == 0)[:, None]
    kernel = shading._shade_direct
    return [
        compare(kernel, "light", light.numpy(), np.where(real, sum_after - sum_before, sum_after)),
        compare(kernel, "before", before.numpy(), np.where(real, sum_before, 0.0)),
    ]


def measure_path_tracing(launcher: Any) -> list[Deviation]:
    """Paths of one vertex under a point light: camera sample, surface, BRDF, shadow ray; the sums are double."""
    twin = Twin.upload(launcher, make_scene(POINT))
    tracer = PathTracer(launcher, twin.device, twin.scene, WIDTH, HEIGHT, bounces=0)
    tracer.add(1)
    got = tracer.resolve()
    index = np.arange(WIDTH * HEIGHT)
    jitter = sobol2(0, index, 0, 0)
    origin, direction = camera_rays(twin, index % WIDTH + jitter[:, 0], index // WIDTH + jitter[:, 1])
    t, triangle = twin.nearest(origin, direction, twin.real)
    s = real_surfaces(twin, origin + direction * t[:, None], triangle, direction)
    wi, distance, value = sample_light(POINT, s.position)
    visible, _ = seen(twin, s, wi, (1.0 - 1e-4) * distance)
    before = brdf_cos(s, wi) * value * visible[:, None]
    return [compare(path_tracing._trace_pixels, "before", got.before.numpy(), before)]


def real_surfaces(twin: Twin, position: np.ndarray, triangle: np.ndarray, direction: np.ndarray) -> Surfaces:
    """Surfaces of the walls' material, seen along ``direction``."""
    s = Surfaces.__new__(Surfaces)
    normal = twin.normals[triangle]
    s.normal = s.normal_g = np.where(dot(normal, direction)[:, None] > 0.0, -normal, normal)
    s.position, s.triangle, s.view = position, triangle, -direction
    s.diffuse = np.broadcast_to(np.asarray(MATERIALS[0].base_color), position.shape)
    s.f0, s.f90, s.alpha = np.zeros_like(position), np.zeros(len(position)), np.full(len(position), 0.25)
    return s

"""Twins of what goes from frame to frame and through a lens, and of the irradiance that light is fitted by."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.bench.twins.deviation import Deviation, compare
from warp_dvct.bench.twins.direct import sample_light
from warp_dvct.bench.twins.indirect import places
from warp_dvct.bench.twins.numbers import cosine_hemisphere, dot, from_frame, sobol2
from warp_dvct.bench.twins.stage import POINT, SUN, Twin, make_scene
from warp_dvct.bench.twins.surfaces import HEIGHT, WIDTH, Surfaces
from warp_dvct.device_scene import camera_frame, upload_lights
from warp_dvct.kernels import history, lens, light_fit
from warp_dvct.passes.gbuffer import render_gbuffer
from warp_dvct.scene import Camera

MOST = 6.0  # frames that a mean is of at most
RAYS, DIRECTIONS = 24, 40


def measure_history(launcher: Any) -> list[Deviation]:
    """Irradiance found again after the camera has moved, and averaged with this frame's by its confidence; and what
    depends on the view, averaged as it is."""
    twin = Twin.upload(launcher, make_scene(POINT))
    camera = twin.scene.camera
    moved = camera.to_world.copy()
    moved[:3, 3] += (0.031, -0.017, -0.023)
    frames = [frame_of(launcher, twin, c) for c in (camera, replace(camera, to_world=moved))]
    (old, then), (points, now) = frames
    rng = np.random.default_rng(12)
    count = len(then.role)
    known = [rng.uniform(0, 4, (count, 3)).astype(np.float32) for _ in range(2)]
    confidence = rng.integers(1, 9, count).astype(np.float32)
    past = history.Past()
    past.camera, past.width, past.height = camera_frame(camera, np.zeros(3), 1.0), WIDTH, HEIGHT
    past.points, past.frames = old, launcher.array(confidence, wp.float32)
    past.before, past.after = (launcher.array(values, wp.vec3) for values in known)
    given = [rng.uniform(0, 4, (len(now.role), 3)).astype(np.float32) for _ in range(2)]
    out = [launcher.array(values, wp.vec3) for values in given]
    weight = launcher.empty(len(now.role), wp.float32)
    launcher.launch(history._blend_past, len(now.role), [past, points, 0, MOST], [*out, weight])

    seen, found = find_past(camera, then, now, confidence.astype(float), [k.astype(float) for k in known])
    n = np.minimum(seen, MOST - 1.0) * (now.role >= 0)
    kernel = history._blend_past
    rows = [compare(kernel, "frames", weight.numpy(), n + 1.0)]
    for name, got, fresh, mean in zip(("before", "after"), out, given, found, strict=True):
        blended = (mean * n[:, None] + fresh) / (n + 1.0)[:, None]
        rows.append(compare(kernel, name, got.numpy(), blended))
    same = launcher.array(given[0], wp.vec3)
    launcher.launch(history._blend_same, len(now.role), [launcher.array(given[1], wp.vec3), 5.0], [same])
    return [
        *rows,
        compare(history._blend_same, "values", same.numpy(), (given[1].astype(float) * 5.0 + given[0]) / 6.0),
    ]


def frame_of(launcher: Any, twin: Twin, camera: Camera) -> tuple[Any, Surfaces]:
    """What a camera sees: points for kernels, and their numbers."""
    device = replace(twin.device, camera=camera_frame(camera, np.zeros(3), 1.0))
    buffer = render_gbuffer(launcher, device, WIDTH, HEIGHT, edge_samples=0, behind=False)
    return buffer.points, Surfaces(buffer.points)


def find_past(
    camera: Camera, then: Surfaces, now: Surfaces, frames: np.ndarray, known: list[np.ndarray]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Frames behind each point, and the means there: of the four pixels around its place in the last picture, those
    that show the same surface (Nehab et al. 2007)."""
    toward = now.position - camera.to_world[:3, 3]
    x, y, z = (toward @ camera.to_world[:3, :3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        px = (x / -z - camera.tan_left) / (camera.tan_right - camera.tan_left) * WIDTH - 0.5
        py = (y / -z - camera.tan_top) / (camera.tan_bottom - camera.tan_top) * HEIGHT - 0.5
    visible = (z < 0) & (px > -1) & (py > -1) & (px < WIDTH) & (py < HEIGHT) & (now.role >= 0)
    px, py = np.where(visible, px, 0.0), np.where(visible, py, 0.0)
    total, weight = np.zeros(len(px)), np.zeros(len(px))
    sums = [np.zeros((len(px), 3)) for _ in known]
    for corner in range(4):
        cx, cy = np.floor(px).astype(int) + corner % 2, np.floor(py).astype(int) + corner // 2
        inside = visible & (cx >= 0) & (cy >= 0) & (cx < WIDTH) & (cy < HEIGHT)
        j = np.where(inside, cy * WIDTH + cx, 0)
        offset = then.position[j] - now.position
        footprint = np.maximum(now.footprint, then.footprint[j])
        off_plane = np.maximum(np.abs(dot(offset, now.normal_g)), np.abs(dot(offset, then.normal_g[j])))
        same = inside & (then.role[j] == now.role) & (np.linalg.norm(offset, axis=-1) < 4.0 * footprint)
        same &= (off_plane < 2.0 * footprint) & (dot(now.normal, then.normal[j]) > 0.9)
        share = (1.0 - np.abs(cx - px)) * (1.0 - np.abs(cy - py)) * same
        total += share
        weight += share * frames[j]
        for s, values in zip(sums, known, strict=True):
            s += values[j] * (share * frames[j])[:, None]
    found = (total > 0.05) & (weight > 0.0)
    behind = np.where(found, weight / np.where(found, total, 1.0), 0.0)
    return behind, [s / np.where(found, weight, 1.0)[:, None] for s in sums]


def measure_lens(launcher: Any) -> list[Deviation]:
    """Means bilinearly, surfaces from the nearest pixel, nothing where the lens shows nothing."""
    rng = np.random.default_rng(13)
    width, height, count = 23, 17, 900
    source, out, numbers = [], [], {}
    for kind in (lens.Filtered, lens.Surfaces):
        given, made = kind(), kind()
        for name, variable in kind.vars.items():
            dtype = variable.type.dtype
            shape = (width * height,) if dtype is wp.float32 else (width * height, dtype._length_)
            numbers[name] = rng.uniform(0, 3, shape).astype(np.float32)
            setattr(given, name, launcher.array(numbers[name], dtype))
            setattr(made, name, launcher.zeros(count, dtype))
        source.append(given)
        out.append(made)
    place = rng.uniform((-0.0, -0.0), (width - 1.0, height - 1.0), (count, 2)).astype(np.float32)
    place[::9] = -1.0
    given = [*source, launcher.array(place, wp.vec2), width, height, 1, 0.0]
    launcher.launch(lens._resample, count, given, out)

    x, y = place.astype(float).T
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    rows = []
    for name, values in numbers.items():
        image = values.astype(float).reshape(height, width, -1)

        def at(cx: np.ndarray, cy: np.ndarray, image: np.ndarray = image) -> np.ndarray:
            return image[np.clip(cy, 0, height - 1), np.clip(cx, 0, width - 1)]

        if name in lens.Filtered.vars:
            fx, fy = (x - x0)[:, None], (y - y0)[:, None]
            top, bottom = (at(x0, y0 + k) * (1 - fx) + at(x0 + 1, y0 + k) * fx for k in (0, 1))
            twin = top * (1 - fy) + bottom * fy
        else:
            twin = at(np.floor(x + 0.5).astype(int), np.floor(y + 0.5).astype(int))
        twin = np.where((x >= 0.0)[:, None], twin, 0.0)
        got = getattr(out[0] if name in lens.Filtered.vars else out[1], name).numpy().reshape(count, -1)
        rows.append(compare(lens._resample, name, got, twin))
    return rows


def harmonics(d: np.ndarray) -> np.ndarray:
    """Real spherical harmonics of degree 0 to 2, orthonormal over the sphere: ``[…, 9]``."""
    x, y, z = np.moveaxis(d, -1, 0)
    one = np.ones_like(x)
    terms = (one, y, z, x, x * y, y * z, 3.0 * z * z - 1.0, x * z, x * x - y * y)
    norms = np.sqrt(np.array([1, 3, 3, 3, 15, 15, 1.25, 15, 3.75]) / (4.0 * np.pi))
    return np.stack(terms, -1) * norms


def measure_light_fit(launcher: Any) -> list[Deviation]:
    """Irradiance of a dome of harmonics and of a light of each point's own; and cosines of open directions."""
    twin = Twin.upload(launcher, make_scene(SUN, closed=False))
    _, position, normal, triangle = places(launcher, twin)
    origin = twin.spawn(position, triangle, normal).astype(np.float32)
    count = len(origin)
    rng = np.random.default_rng(14)
    sources = tuple(SUN if i % 2 else POINT for i in range(count))
    coefficients = rng.normal(0, 1, (count, 9, 3)).astype(np.float32)
    dome, light = (launcher.zeros(count, wp.vec3) for _ in range(2))
    opened = launcher.zeros(count, wp.float32)
    arrays = [launcher.array(v, wp.vec3) for v in (origin, normal.astype(np.float32), coefficients.reshape(-1, 3))]
    lights = upload_lights(launcher, sources, np.zeros(3), 1.0)
    given = [twin.device.geometry, lights, *arrays, RAYS, 1, 0]
    launcher.launch(light_fit._light_points, count, given, [dome, light, opened])

    origin = origin.astype(float)
    sky, share = np.zeros((count, 3)), np.zeros(count)
    for j in range(RAYS):
        d = from_frame(cosine_hemisphere(sobol2(0, np.arange(count), j, 0)), normal)
        free = np.isinf(twin.nearest(origin, d, twin.real)[0])
        share += free / RAYS
        sky += np.einsum("nk,nkc->nc", harmonics(d), coefficients) * (free * np.pi / RAYS)[:, None]
    direct = np.zeros((count, 3))
    for kind, source in enumerate((POINT, SUN)):
        mine = slice(kind, None, 2)
        d, distance, value = sample_light(source, origin[mine])
        free = twin.nearest(origin[mine], d, twin.real)[0] >= distance
        direct[mine] = value * (np.maximum(dot(d, normal[mine]), 0.0) * free)[:, None]
    kernel = light_fit._light_points
    rows = [
        compare(kernel, name, got.numpy(), mean) for name, got, mean in (("dome", dome, sky), ("light", light, direct))
    ]
    rows.append(compare(kernel, "open", opened.numpy(), share))

    toward = from_frame(cosine_hemisphere(rng.random((DIRECTIONS, 2))), np.tile([0.0, 1.0, 0.0], (DIRECTIONS, 1)))
    toward = toward.astype(np.float32)
    cosines = launcher.empty(count * DIRECTIONS, wp.float32)
    tried = [twin.device.geometry, arrays[0], arrays[1], launcher.array(toward, wp.vec3)]
    launcher.launch(light_fit._try_directions, count * DIRECTIONS, tried, [cosines])
    each, d = np.repeat(np.arange(count), DIRECTIONS), np.tile(toward.astype(float), (count, 1))
    free = np.isinf(twin.nearest(origin[each], d, twin.real)[0])
    expected = np.maximum(dot(d, normal[each]), 0.0) * free
    return [*rows, compare(light_fit._try_directions, "cosine", cosines.numpy(), expected)]


STEP = 1e-5  # of the central differences: their own error is its square


def measure_light_fit_jacobian(launcher: Any) -> list[Deviation]:
    """The Jacobian that lights are fitted by: the kernel's adjoints against central differences of its twin in float64.

    By the dome's coefficients, by the direction of a distant light and by the place of a near one. What is seen stays
    seen.
    """
    twin = Twin.upload(launcher, make_scene(SUN, closed=False))
    _, position, normal, triangle = places(launcher, twin)
    origin = twin.spawn(position, triangle, normal).astype(np.float32)
    count = len(origin)
    lights = upload_lights(launcher, tuple(SUN if i % 2 else POINT for i in range(count)), np.zeros(3), 1.0)
    coefficients: Any = wp.zeros(9 * count, dtype=wp.vec3, device=launcher.device, requires_grad=True)
    by: Any = [wp.clone(values, requires_grad=True) for values in (lights.position, lights.direction)]
    lights.position, lights.direction = by
    arrays = [launcher.array(v, wp.vec3) for v in (origin, normal.astype(np.float32))]
    kinds = (wp.vec3, wp.vec3, wp.float32)
    outputs = [wp.zeros(count, dtype=kind, device=launcher.device, requires_grad=True) for kind in kinds]
    ones = wp.full(count, wp.vec3(1.0, 1.0, 1.0), wp.vec3, device=launcher.device)
    inputs = [twin.device.geometry, lights, *arrays, coefficients, RAYS, 1, 0]
    launcher.differentiate(light_fit._light_points, count, inputs, outputs, {outputs[0]: ones, outputs[1]: ones})

    origin = origin.astype(float)
    rays = [from_frame(cosine_hemisphere(sobol2(0, np.arange(count), j, 0)), normal) for j in range(RAYS)]
    free = [np.isinf(twin.nearest(origin, d, twin.real)[0]) for d in rays]

    def dome(x: np.ndarray) -> np.ndarray:
        """Irradiance of harmonics with coefficients ``[n, 9, 3]``."""
        basis = sum((harmonics(d) * f[:, None] for d, f in zip(rays, free, strict=True)), np.zeros((count, 9)))
        return np.einsum("nk,nkc->nc", basis, x) * (np.pi / RAYS)

    def near(place: np.ndarray) -> np.ndarray:
        return irradiance(replace(POINT, position=place), slice(0, None, 2))

    def distant(direction: np.ndarray) -> np.ndarray:
        return irradiance(replace(SUN, direction=direction), slice(1, None, 2))

    def irradiance(source: Any, mine: slice) -> np.ndarray:
        d, _, value = sample_light(source, origin[mine])
        return value * (np.maximum(dot(d, normal[mine]), 0.0) * open_to[mine])[:, None]

    open_to = np.zeros(count)
    for kind, source in enumerate((POINT, SUN)):
        mine = slice(kind, None, 2)
        d, distance, _ = sample_light(source, origin[mine])
        open_to[mine] = twin.nearest(origin[mine], d, twin.real)[0] >= distance

    kernel, half = light_fit._light_points, count // 2
    by_dome = differences(dome, np.zeros((count, 9, 3)))
    by_place = differences(near, np.tile(np.asarray(POINT.position), (half, 1)))
    by_direction = differences(distant, np.tile(np.asarray(SUN.direction), (half, 1)))
    got = coefficients.grad.numpy().reshape(count, 27)
    return [
        compare(kernel, "Jacobian, harmonics", got, by_dome.reshape(count, 27)),
        compare(kernel, "Jacobian, position", by[0].grad.numpy()[::2], by_place),
        compare(kernel, "Jacobian, direction", by[1].grad.numpy()[1::2], by_direction),
    ]


def differences(function: Any, x: np.ndarray) -> np.ndarray:
    """Derivative of the sum of a row's channels by each number of that row of ``x``, in ``x``'s shape."""
    out = np.zeros_like(x)
    for at in np.ndindex(x.shape[1:]):
        step = np.zeros_like(x)
        step[(slice(None), *at)] = STEP
        out[(slice(None), *at)] = (function(x + step) - function(x - step)).sum(-1) / (2.0 * STEP)
    return out

"""Twins of what makes pictures of radiance: resolve, composite, tone mapping, the tone-mapped difference, the sky."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_dvct.bench.twins.deviation import Deviation, compare
from warp_dvct.bench.twins.stage import Twin, make_scene
from warp_dvct.bench.twins.surfaces import HEIGHT, WIDTH, Surfaces
from warp_dvct.kernels import composite, difference, tonemap
from warp_dvct.kernels import resolve as kernels
from warp_dvct.passes.environment import build_environment
from warp_dvct.passes.gbuffer import render_gbuffer
from warp_dvct.passes.resolve import resolve
from warp_dvct.scene import Light, LightKind

PIXELS = 4000


def sky(texture: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Bilinear look-up of a lat-long image: its middle is +z, a quarter in from the left +x, its top +y."""
    height, width = texture.shape[:2]
    x = (0.5 - np.arctan2(direction[:, 0], direction[:, 2]) / (2.0 * np.pi)) * width - 0.5
    y = np.arccos(np.clip(direction[:, 1], -1.0, 1.0)) / np.pi * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    rows = [texture[np.clip(y0 + k, 0, height - 1)] for k in (0, 1)]
    at = np.arange(len(x))
    top, bottom = (row[at, x0 % width] * (1 - fx) + row[at, (x0 + 1) % width] * fx for row in rows)
    return top * (1 - fy) + bottom * fy


def measure_resolve(launcher: Any) -> list[Deviation]:
    """Means of a pixel's points, with the sky where nothing is seen."""
    texture = np.random.default_rng(1).uniform(0, 5, (16, 32, 3)).astype(np.float32)
    dome = Light(LightKind.DOME, (1.0, 1.0, 1.0), texture=texture)
    twin = Twin.upload(launcher, make_scene(dome, closed=False))
    buffer = render_gbuffer(launcher, twin.device, WIDTH, HEIGHT, edge_samples=4, behind=True)
    rng = np.random.default_rng(2)
    light, before = (rng.uniform(0, 2, (buffer.count, 3)).astype(np.float32) for _ in range(2))
    hidden = rng.uniform(0, 2, (max(1, buffer.behind_count), 3)).astype(np.float32)
    env = build_environment(launcher, (dome,))
    given = {"light": light, "before": before, "behind_before": hidden}
    arrays = {name: launcher.array(values, wp.vec3) for name, values in given.items()}
    got = resolve(launcher, twin.device, buffer, env, with_before=True, **arrays)

    s = Surfaces(buffer.points)
    shown = before.astype(float).copy()
    open_ = s.role == -1
    shown[open_] = sky(texture.astype(float), -s.view[open_])
    rank = buffer.behind_rank.numpy()
    inserted = s.role == 1
    behind_role = buffer.behind.role.numpy()[rank[inserted]]
    shown[inserted] = np.where(
        (behind_role == 0)[:, None], hidden[rank[inserted]], sky(texture.astype(float), -s.view[inserted])
    )
    delta = np.where((s.role == 0)[:, None], light, 0.0)
    synthetic = np.concatenate([light, np.ones((len(light), 1))], 1) * inserted[:, None]
    edge = buffer.edge_rank.numpy()
    pixels = WIDTH * HEIGHT

    def mean(values: np.ndarray) -> np.ndarray:
        inner = values[pixels:].reshape(-1, 4, values.shape[1]).mean(1)
        return np.where((edge >= 0)[:, None], inner[np.maximum(edge, 0)], values[:pixels])

    kernel = kernels._resolve
    return [
        compare(kernel, "before", got.before.numpy(), mean(shown)),
        compare(kernel, "delta", got.delta.numpy(), mean(delta)),
        compare(kernel, "synthetic", got.synthetic.numpy(), mean(synthetic)),
    ]


def encode(value: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, [0, 1] to [0, 1]."""
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 1e-9) ** (1 / 2.4) - 0.055)


def decode(code: np.ndarray) -> np.ndarray:
    """Its inverse."""
    code = np.clip(code, 0.0, 1.0)
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def display(color: np.ndarray) -> np.ndarray:
    """Highlights faded to white, encoded."""
    peak = np.maximum(color.max(-1, keepdims=True), 1.0)
    return encode(1.0 - (1.0 - color / peak) / peak)


def halves(values: np.ndarray) -> np.ndarray:
    """Rounded to half precision."""
    return np.clip(values, -65504.0, 65504.0).astype(np.float16).astype(float)


def measure_pictures(launcher: Any) -> list[Deviation]:
    """Random pixels through the composite, the preview and the tone-mapped difference."""
    rng = np.random.default_rng(6)
    plate = rng.uniform(0.01, 1.5, (PIXELS, 3)).astype(np.float32)
    delta = (plate * rng.uniform(-0.9, 0.9, (PIXELS, 3))).astype(np.float32)
    before = rng.uniform(0.1, 1.5, (PIXELS, 3)).astype(np.float32)
    synthetic = rng.uniform(0, 0.7, (PIXELS, 4)).astype(np.float32)
    vectors = [launcher.array(v, wp.vec3) for v in (plate, delta, before)]
    coverage = launcher.array(synthetic, wp.vec4)
    outputs = [launcher.empty(PIXELS, wp.vec4), *(launcher.empty(PIXELS, wp.vec3) for _ in range(5))]
    counts = [launcher.empty(PIXELS, wp.int32) for _ in range(2)]
    launcher.launch(composite._composite_pixels, PIXELS, [*vectors[:2], coverage], [*outputs, *counts])
    shown = launcher.empty((PIXELS, 3), wp.uint8)
    launcher.launch(tonemap._tonemap_pixels, PIXELS, [vectors[0], 1.0, 0], [shown])
    changed = launcher.empty(PIXELS, wp.vec3)
    launcher.launch(difference._tonemap_difference, PIXELS, [vectors[0], vectors[2], vectors[1], coverage], [changed])

    p, d, b, s = (x.astype(float) for x in (plate, delta, before, synthetic))
    a, real = s[:, 3:], 1.0 - s[:, 3:]
    shadow = halves(np.clip((p + np.minimum(d / real, 0.0)) / p, 0.0, 1.0))
    comp = halves(s[:, :3]) + (1.0 - halves(a)) * (halves(p) * shadow + halves(np.maximum(d / real, 0.0)))
    code = np.floor(display(p) * 255.0 + 0.5)
    change = display(np.maximum(b + d / real, 0.0)) - display(b)
    plain = np.where(change != 0.0, (decode(encode(np.clip(p, 0, 1)) + change) - p) * real, 0.0)
    return [
        compare(composite._composite_pixels, "shadow", outputs[3].numpy(), shadow),
        compare(composite._composite_pixels, "comp", outputs[1].numpy(), halves(comp)),
        compare(tonemap._tonemap_pixels, "display (codes)", shown.numpy(), code),
        compare(difference._tonemap_difference, "delta", changed.numpy(), plain),
    ]

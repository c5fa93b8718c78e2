"""Twins of what glossy surfaces send along gathered rays, under a light without extent, and of averaged reflections."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.bench.twins.deviation import Deviation, compare
from warp_dvct.bench.twins.direct import sample_light, seen
from warp_dvct.bench.twins.indirect import COUNT, RAYS, GatherRay, blank_points, falloff, incident, places, world_of
from warp_dvct.bench.twins.numbers import dot
from warp_dvct.bench.twins.stage import POINT, make_scene
from warp_dvct.bench.twins.surfaces import Surfaces, brdf_cos, specular_albedo
from warp_dvct.bench.twins.volumes import fields, lit
from warp_dvct.kernels import gather, lobe_smoothing
from warp_dvct.passes.gather import Gatherer, glossy_hits
from warp_dvct.passes.lobe_smoothing import lobe_grid
from warp_dvct.passes.patches import bounce_field
from warp_dvct.scene import Material

MATERIALS = (
    Material(base_color=(0.6, 0.5, 0.4), roughness=0.4, ior=1.5),
    Material(base_color=(0.3, 0.5, 0.7), roughness=0.3, ior=1.8),
)
FAINT = 0.01 / np.pi  # of the even radiosity, below which a lobe's light is left out


def measure_glossy_rays(launcher: Any) -> list[Deviation]:
    """Gathered rays whose hits send light along their lobes, widened by what a ray stands for."""
    scene = replace(make_scene(POINT), materials=MATERIALS)
    twin, voxels, _, _ = lit(launcher, scene)
    points, position, normal, triangle = places(launcher, twin)
    hits = glossy_hits(launcher, scene, twin.device, bounce_field(launcher, None), 0)
    gatherer = Gatherer(twin.device, world_of(launcher, twin, voxels.volume), RAYS, 0, hits=hits)
    index = launcher.array(np.arange(COUNT, dtype=np.int32), wp.int32)
    got = gatherer.run(launcher, points, index, COUNT)

    field = fields(voxels)[0]
    total = np.zeros((COUNT, 2, 3))
    for k in range(RAYS):
        ray = GatherRay.trace(twin, position, normal, triangle, k)
        even = incident(ray, field)
        on_real = focused(ray, ray.real, 0, even)
        on_inserted = focused(ray, ray.synthetic, 1, np.stack([even[:, 1]] * 2, 1))
        after = np.where(ray.blocked[:, None], on_inserted[:, 1], on_real[:, 1])
        total += np.stack([on_real[:, 0], after], 1) / RAYS
    kernel = gather._gather_rays_glossy
    return [compare(kernel, name, got[s].numpy(), total[:, s]) for s, name in enumerate(("before", "after"))]


def focused(ray: GatherRay, met: tuple[np.ndarray, np.ndarray], material: int, even: np.ndarray) -> np.ndarray:
    """The even radiosity's diffuse share, and pi times the light in the lobe in place of its specular share."""
    distance, triangle = met
    found = np.isfinite(distance)
    s = glossy_surfaces(ray, np.where(found, distance, 0.0), triangle, MATERIALS[material])
    passed = 1.0 - s.f0 - (s.f90[:, None] - s.f0) / 21.0
    diffuse, specular = s.diffuse * passed**2, specular_albedo(s.f0, s.f90, s.alpha)
    s.alpha = np.minimum(np.sqrt(s.alpha**2 + ray.solid_angle / np.pi), 1.0)
    share = specular / specular_albedo(s.f0, s.f90, s.alpha)
    s.diffuse = np.zeros_like(s.diffuse)  # the lobe alone
    direction, reach, value = sample_light(POINT, s.position)
    f = brdf_cos(s, direction) * value
    f = np.where(f.max(-1, keepdims=True) > FAINT * even.max((1, 2))[:, None], f, 0.0)
    open_ = np.stack(seen(ray.twin, s, direction, 0.9999 * reach), 1)
    sent = (diffuse / (diffuse + specular))[:, None] * even + np.pi * (share * f)[:, None] * open_[..., None]
    return np.where(found[:, None, None], sent, 0.0)


def glossy_surfaces(ray: GatherRay, distance: np.ndarray, triangle: np.ndarray, material: Material) -> Surfaces:
    """What rays met, as the kernels see it."""
    s = Surfaces.__new__(Surfaces)
    normal = ray.twin.normals[triangle]
    s.normal = s.normal_g = np.where(dot(normal, ray.direction)[:, None] > 0.0, -normal, normal)
    s.position, s.triangle, s.view = ray.origin + ray.direction * distance[:, None], triangle, -ray.direction
    s.diffuse = np.broadcast_to(np.asarray(material.base_color), s.position.shape)
    f0 = ((material.ior - 1.0) / (material.ior + 1.0)) ** 2
    s.f0, s.f90 = np.full(s.position.shape, f0), np.full(len(distance), min(50.0 * f0, 1.0))
    s.alpha = np.full(len(distance), material.roughness**2)
    return s


def measure_lobe_smoothing(launcher: Any) -> list[Deviation]:
    """The mean of reflections over a bent sheet of pixels, every tap by a matrix of weights."""
    rng = np.random.default_rng(12)
    columns, rows = 13, 9
    count = columns * rows
    x, y = np.arange(count) % columns, np.arange(count) // columns
    place = np.stack([x, y, 0 * x], 1) * 0.01 + rng.normal(0, 2e-3, (count, 3))
    normal = rng.normal(0, 0.03, (count, 3)) + np.array([0.0, 0.0, 1.0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    alpha = rng.choice([0.2, 0.205, 0.3], count)
    role = rng.integers(0, 5, count) // 4
    f0 = rng.uniform(0.3, 0.36, (count, 3))
    listed = np.flatnonzero(rng.random(count) < 0.9).astype(np.int32)
    rank = np.full(count, -1, np.int32)
    rank[listed] = np.arange(len(listed))
    change, near = rng.normal(0, 1, (len(listed), 3)), rng.uniform(2.0, 6.0, len(listed))
    points = blank_points(launcher, count)
    points.position = launcher.array(place.astype(np.float32), wp.vec3)
    points.normal = points.normal_g = launcher.array(normal.astype(np.float32), wp.vec3)
    points.pixel = launcher.array(np.stack([x, y], 1).astype(np.int32), wp.vec2i)
    points.lobe = launcher.array(np.stack([0 * alpha + 1, alpha], 1).astype(np.float32), wp.vec2)
    points.f0 = launcher.array(f0.astype(np.float32), wp.vec3)
    points.role = launcher.array(role.astype(np.int32), wp.int32)
    points.footprint = launcher.full(count, 0.01, wp.float32)
    reflected = lobe_smoothing.Reflected()
    reflected.change = reflected.before = launcher.array(change.astype(np.float32), wp.vec3)
    reflected.nearness = launcher.array(near.astype(np.float32), wp.float32)
    grid = lobe_grid(launcher.array(rank, wp.int32), columns, rows)
    index = launcher.array(listed, wp.int32)
    eye, share = np.array([0.05, 0.05, 1.5]), 0.4
    light, before = (launcher.zeros(count, wp.vec3) for _ in range(2))
    given = [points, index, grid, wp.vec3(*eye), share, reflected, 1]
    launcher.launch(lobe_smoothing._smooth_lobes, len(listed), given, [light, before])

    place, normal, alpha, role, f0 = (v[listed] for v in (place, normal, alpha, role, f0))
    step = np.stack([x, y], 1)[listed][None] - np.stack([x, y], 1)[listed][:, None]
    around = (np.abs(step).max(-1) <= 1) & (role[:, None] == role[None])
    distance = around.sum(1) / (around @ near)
    width = share * 2.0 * alpha * distance / (1.0 + distance / np.linalg.norm(place - eye, axis=1))
    spacing = np.clip((0.5 * width / 0.01).astype(int), 1, 4)[:, None, None]
    tap = (step % spacing == 0).all(-1) & (np.abs(step) <= 2 * spacing).all(-1) & (width > 0.005)[:, None]
    tap &= (role[:, None] == role[None]) & (np.abs(alpha[None] - alpha[:, None]) <= 0.05 * alpha[:, None])
    tap &= np.abs(f0[None] - f0[:, None]).max(-1) <= 0.05
    offset = place[None] - place[:, None]
    turn = ((normal[None] - normal[:, None]) ** 2).sum(-1) / (0.25 * alpha[:, None]) ** 2
    gap = np.einsum("ijx,ix->ij", offset, normal) / 0.02
    weight = falloff((offset**2).sum(-1) / width[:, None] ** 2) * falloff(turn) * falloff(gap**2) * tap
    np.fill_diagonal(weight, 1.0)
    mean = weight @ change / weight.sum(1, keepdims=True)
    kernel = lobe_smoothing._smooth_lobes
    return [
        compare(kernel, "light", light.numpy()[listed], mean),
        compare(kernel, "before", before.numpy()[listed], np.where((role == 0)[:, None], mean, 0.0)),
    ]

"""Twins of indirect light: cones and rays into the radiosity volume, bounces between patches, reconstruction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.bench.twins.aim import Aims
from warp_dvct.bench.twins.deviation import Deviation, compare
from warp_dvct.bench.twins.numbers import (
    concentric_disk,
    cosine_hemisphere,
    dot,
    from_frame,
    hash2,
    sobol2,
    uint,
    unit_float,
)
from warp_dvct.bench.twins.stage import Twin
from warp_dvct.bench.twins.volumes import N, fields, lit
from warp_dvct.kernels import bounces, cones, gather, gather_cones, reconstruction, specular
from warp_dvct.kernels.aim import MOST
from warp_dvct.kernels.bounce_field import Patch
from warp_dvct.kernels.environment import Environment
from warp_dvct.kernels.gbuffer import Points
from warp_dvct.kernels.radiosity import World
from warp_dvct.launch import Launcher
from warp_dvct.passes.gather import Gatherer
from warp_dvct.passes.gbuffer import new_points
from warp_dvct.targets import make_targets

COUNT = 64
CONES, RAYS = 9, 16


def blank_points(launcher: Launcher, count: int) -> Any:
    """``Points`` all zero: of pixel (0, 0), whose samples start the picture's sequence."""
    points = new_points(launcher, count)
    for name in Points.vars:
        getattr(points, name).zero_()
    return points


def places(launcher: Launcher, twin: Twin) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray]:
    """Shading points spread over all triangles: for kernels, and as positions, normals and triangles in float64."""
    rng = np.random.default_rng(4)
    triangle = rng.integers(0, len(twin.corners), COUNT)
    weights = rng.dirichlet([1.0, 1.0, 1.0], COUNT)
    position = np.einsum("nk,nkx->nx", weights, twin.corners[triangle]).astype(np.float32)
    normal = twin.normals[triangle].astype(np.float32)
    points = blank_points(launcher, COUNT)
    points.position = launcher.array(position, wp.vec3)
    points.normal = points.normal_g = points.view = launcher.array(normal, wp.vec3)
    points.reach = launcher.array(np.abs(twin.corners[triangle]).max((1, 2)).astype(np.float32), wp.float32)
    points.role = launcher.array((triangle >= twin.reals).astype(np.int32), wp.int32)
    points.footprint = launcher.full(COUNT, 0.01, wp.float32)
    return points, position.astype(float), normal.astype(float), triangle


def world_of(launcher: Launcher, twin: Twin, volume: Any) -> Any:
    """``radiosity.World`` of one volume and no sky."""
    world = World()
    world.fine = world.coarse = volume
    world.env = Environment()
    world.env.before = world.env.after = launcher.zeros(1, wp.vec3)
    world.env.level_first = launcher.zeros(1, wp.int32)
    world.normals = twin.device_normals(launcher)
    return world


def faces_toward(direction: np.ndarray) -> np.ndarray:
    """The face of each axis whose outward normal is along a direction: int ``[n, 3]``."""
    return 2 * np.arange(3) + (direction < 0.0)


def sample(level: np.ndarray, place: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Trilinear sample of three faces, weighted: ``[n, solution, 4]``; ``place`` is in voxels of the level."""
    local = place - 0.5
    base = np.floor(local).astype(int)
    f = local - base
    total = np.zeros((len(place), 2, 4))
    for corner in np.ndindex(2, 2, 2):
        share = np.prod(np.where(np.array(corner) == 1, f, 1.0 - f), 1)
        at = base + corner
        inside = np.all((at >= 0) & (at < level.shape[0]), 1)
        at = np.clip(at, 0, level.shape[0] - 1)
        values = level[tuple(at.T)][np.arange(len(at))[:, None], faces]
        total += (share * inside)[:, None, None] * np.einsum("nk,nksc->nsc", weights, values)
    return total


def march(levels: list[np.ndarray], origin: np.ndarray, direction: np.ndarray, aperture: float) -> np.ndarray:
    """Front-to-back march in steps of one voxel of the level as wide as half the cone (Franke 2014, eqs. 3 and 4).

    Coverage adds up until it is whole, separately for the two solutions: ``[n, solution, 4]``.
    """
    total = np.zeros((len(origin), 2, 4))
    t = np.full(len(origin), -1.0 / N)
    spread = 2.0 * np.tan(0.5 * aperture)
    searching = np.ones(len(origin), bool)
    while searching.any():
        width = np.maximum(spread * 0.5 * t, 1.0 / N)
        level = np.clip(np.floor(np.log2(np.maximum(width * N, 1.0))).astype(int), 0, len(levels) - 1)
        size = 2.0**level / N
        middle = origin + direction * (t + 0.5 * size)[:, None]
        inside = np.all((middle >= -size[:, None]) & (middle <= 1.0 + size[:, None]), 1)
        searching &= inside & (t < 4.0)
        for k, field in enumerate(levels):
            here = searching & (level == k)
            if here.any():
                place = middle[here] / size[here, None]
                value = sample(field, place, faces_toward(-direction[here]), np.abs(direction[here]))
                alpha = np.where(value[..., 3:] > 0.0, value[..., 3:], 1.0)
                total[here] += value * np.clip((1.0 - total[here][..., 3:]) / alpha, 0.0, 1.0)
        t += size
        searching &= ~np.all(total[..., 3] >= 0.999, 1)
    return total


def measure_cones(launcher: Any) -> list[Deviation]:
    """Nine diffuse cones a point (Franke 2014, eq. 6, first sum), without the escape ray."""
    twin, voxels, _, _ = lit(launcher)
    points, position, normal, _ = places(launcher, twin)
    settings = cones.ConeSettings()
    settings.step, settings.detail, settings.start, settings.reach, settings.additive = 1.0, 0.5, 1.5, 4.0, 1
    gatherer = Gatherer(twin.device, world_of(launcher, twin, voxels.volume), RAYS, 0, CONES, settings)
    index = launcher.array(np.arange(COUNT, dtype=np.int32), wp.int32)
    got = gatherer.run(launcher, points, index, COUNT)

    levels = fields(voxels)
    key = hash2(hash2(hash2(uint(0), uint(0)), uint(0)), uint(13))
    turn = 2.0 * np.pi * unit_float(key)
    total = np.zeros((COUNT, 2, 3))
    for k in range(CONES):
        sine2 = (k + 0.5) / CONES
        cos, sine, phi = np.sqrt(1.0 - sine2), np.sqrt(sine2), 2.399963 * k + turn
        local = np.broadcast_to([sine * np.cos(phi), sine * np.sin(phi), cos], position.shape)
        aperture = 2.0 * np.arccos(1.0 - min(0.5 / (CONES * max(cos, 0.1)), 1.0))
        direction = from_frame(local, normal)
        total += march(levels, position + normal * 1.5 / N, direction, aperture)[..., :3] / CONES
    kernel = gather_cones._gather_cones
    return [compare(kernel, name, got[s].numpy(), total[:, s]) for s, name in enumerate(("before", "after"))]


def measure_specular(launcher: Any) -> list[Deviation]:
    """One cone around the mirror direction, as wide as the lobe (Franke 2014, eq. 6, second sum)."""
    twin, voxels, _, _ = lit(launcher)
    points, position, normal, triangle = places(launcher, twin)
    view = from_frame(cosine_hemisphere(np.random.default_rng(5).random((COUNT, 2))), normal).astype(np.float32)
    alpha, f0 = 0.3, 0.25
    points.view = launcher.array(view, wp.vec3)
    points.f0 = launcher.full(COUNT, wp.vec3(f0, f0, f0), wp.vec3)
    points.lobe = launcher.full(COUNT, wp.vec2(1.0, alpha), wp.vec2)
    settings = cones.ConeSettings()
    settings.step, settings.detail, settings.start, settings.reach, settings.additive = 1.0, 0.5, 1.5, 4.0, 1
    light, before = (launcher.zeros(COUNT, wp.vec3) for _ in range(2))
    index = launcher.array(np.arange(COUNT, dtype=np.int32), wp.int32)
    given = [points, index, twin.device.geometry, world_of(launcher, twin, voxels.volume), settings, 1]
    launcher.launch(specular._shade_specular_cones, COUNT, given, [light, before])

    cos = dot(normal, view.astype(float))
    mirror = normal * (2.0 * cos)[:, None] - view
    seen = march(fields(voxels), position + normal * 1.5 / N, mirror, 4.0 * np.arctan(alpha))[..., :3]
    weight = ((f0 + (1.0 - f0) * (1.0 - cos) ** 5) / np.pi)[:, None]
    real = (triangle < twin.reals)[:, None]
    expected = weight * np.where(real, seen[:, 1] - seen[:, 0], seen[:, 1])
    return [
        compare(specular._shade_specular_cones, "light", light.numpy(), expected),
        compare(specular._shade_specular_cones, "before", before.numpy(), np.where(real, weight * seen[:, 0], 0.0)),
    ]


def radiosity(field: np.ndarray, place: np.ndarray, normal: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Of surfaces, ``[n, sol., 3]``: from the voxel that holds them, where a ray is wider than it and a quarter of a
    face is surface; else interpolated."""
    cell = np.clip(np.floor(place * N).astype(int), 0, N - 1)
    faces, share = faces_toward(normal), np.abs(normal)
    held = field[tuple(cell.T)][np.arange(len(cell))[:, None], faces]
    single = np.einsum("nk,nksc->nsc", share * (share > 0.1), held)
    single *= (footprint > 1.0 / N)[:, None, None]
    smooth = sample(field, place * N, faces, share * (share > 0.01))
    pair = np.where((single[:, 1, 3] > 0.25)[:, None, None], single, smooth)
    alpha = pair[..., 3:]
    return np.where(alpha > 1e-6, pair[..., :3] / np.where(alpha > 1e-6, alpha, 1.0), 0.0)


def measure_rays(launcher: Any) -> list[Deviation]:
    """Rays that read the voxels they hit, before and after: cosine-distributed, and partly aimed at one box or two."""
    found = _gathered(launcher, 0.0, "") + _gathered(launcher, 0.25, ", aimed")
    return found + _gathered(launcher, 0.25, ", aimed at two", halves=True)


def _gathered(launcher: Any, aimed: float, what: str, *, halves: bool = False) -> list[Deviation]:
    """``halves``: The object's box is taken for two, a low one and a high one that overlap."""
    twin, voxels, _, _ = lit(launcher)
    if halves:
        low, high = (np.array([*v], float) for v in (twin.device.targets.center, twin.device.targets.extent))
        parts = np.array([[low - high, low + high * (1, 0.2, 1)], [low - high * (0.5, 0.1, 0.5), low + high]])
        twin = replace(twin, device=replace(twin.device, targets=make_targets(parts)))
    points, position, normal, triangle = places(launcher, twin)
    gatherer = Gatherer(twin.device, world_of(launcher, twin, voxels.volume), RAYS, 0, aimed=aimed)
    index = launcher.array(np.arange(COUNT, dtype=np.int32), wp.int32)
    got = gatherer.run(launcher, points, index, COUNT)

    field = fields(voxels)[0]
    few = round(RAYS * aimed)
    aims = Aims.of(twin.device.targets, position, normal, few)
    total = np.zeros((COUNT, 2, 3))
    for k in range(RAYS):
        disk = np.broadcast_to(concentric_disk(sobol2(0, 0, k, 11)), (COUNT, 2))
        total += weighted(twin, (position, normal, triangle), disk, ~aims.aimed / RAYS, field)
    for k in range(int(few * float(MOST))):
        even = concentric_disk(sobol2(0, 0, k, 11)) + np.zeros((COUNT, 1))
        for disk, count in ((even, few), (aims.draw(k, sobol2(0, 0, k, 12)), aims.rays.sum(0))):
            weight = (aims.aimed & (k < count)) / (few + aims.density(disk))
            total += weighted(twin, (position, normal, triangle), disk, weight, field)
    kernel = gather._gather_rays
    return [compare(kernel, name + what, got[s].numpy(), total[:, s]) for s, name in enumerate(("before", "after"))]


def weighted(twin: Twin, surfaces: Any, disk: np.ndarray, weight: np.ndarray, field: np.ndarray) -> np.ndarray:
    """What one ray of each point adds to its irradiance: ``[n, solution, 3]``."""
    position, normal, triangle = surfaces
    ray = GatherRay.along(twin, position, normal, triangle, disk, weight)
    return weight[:, None, None] * incident(ray, field)


@dataclass(frozen=True)
class GatherRay:
    """One ray of each point, and what it meets of each role: distance (inf where nothing) and triangle."""

    twin: Twin
    origin: np.ndarray
    direction: np.ndarray
    solid_angle: np.ndarray
    real: tuple[np.ndarray, np.ndarray]
    synthetic: tuple[np.ndarray, np.ndarray]

    @staticmethod
    def trace(twin: Twin, position: np.ndarray, normal: np.ndarray, triangle: np.ndarray, k: int) -> GatherRay:
        """Ray ``k`` of the picture's sequence, cosine-distributed."""
        disk = np.broadcast_to(concentric_disk(sobol2(0, 0, k, 11)), (len(position), 2))
        return GatherRay.along(twin, position, normal, triangle, disk, np.full(len(position), 1.0 / RAYS))

    @staticmethod
    def along(
        twin: Twin,
        position: np.ndarray,
        normal: np.ndarray,
        triangle: np.ndarray,
        disk: np.ndarray,
        weight: np.ndarray,
    ) -> GatherRay:
        """The ray over a point of the disk below the hemisphere, which stands for a share ``weight`` of the disk."""
        height = np.sqrt(np.maximum(1.0 - (disk**2).sum(-1), 0.0))
        direction = from_frame(np.concatenate([disk, height[:, None]], 1), normal)
        origin = twin.spawn(position, triangle, normal)
        met = (twin.nearest(origin, direction, part) for part in (twin.real, twin.synthetic))
        return GatherRay(twin, origin, direction, np.pi * weight / np.maximum(height, 0.05), *met)

    @property
    def blocked(self) -> np.ndarray:
        """Whether something synthetic is met first."""
        return self.synthetic[0] < self.real[0]


def incident(ray: GatherRay, field: np.ndarray) -> np.ndarray:
    """Radiosity where a ray ends, before and after: ``[n, solution, 3]``."""
    seen = []
    for t, hit in (ray.real, ray.synthetic):
        n = ray.twin.normals[hit]
        n = np.where(dot(n, ray.direction)[:, None] > 0.0, -n, n)
        at = np.where(np.isfinite(t), t, 0.0)
        light = radiosity(field, ray.origin + ray.direction * at[:, None], n, np.sqrt(ray.solid_angle) * at)
        seen.append(np.where(np.isfinite(t)[:, None, None], light, 0.0))
    return np.stack([seen[0][:, 0], np.where(ray.blocked[:, None], seen[1][:, 1], seen[0][:, 1])], 1)


def measure_bounces(launcher: Any) -> list[Deviation]:
    """One bounce along random links between patches, some of them synthetic, some links open."""
    rng = np.random.default_rng(8)
    count = 200
    link = rng.integers(-1, count, (count, RAYS, 2)).astype(np.int32)
    albedo, irradiance = rng.uniform(0, 1, (count, 3)), rng.uniform(0, 9, (count, 2, 3))
    real = rng.integers(0, 2, count).astype(np.int32)
    values: Any = np.zeros(count, Patch.numpy_dtype())
    values["albedo"], values["real"] = albedo, real
    patches = launcher.array(values, Patch)
    last = launcher.array(irradiance.reshape(-1, 3).astype(np.float32), wp.vec3)
    following, total = (launcher.zeros(2 * count, wp.vec3) for _ in range(2))
    links = launcher.array(link.reshape(-1, 2), wp.vec2i)
    launcher.launch(bounces._bounce, count, [patches, links, RAYS, last], [following, total])

    sent = albedo.astype(np.float32)[:, None] * irradiance.astype(np.float32).astype(float)
    before, after = (np.where((link[..., s] >= 0)[..., None], sent[link[..., s], s], 0.0) for s in (0, 1))
    usable = (link[..., 0] < 0) | (real[link[..., 0]] != 0)
    before = (before * usable[..., None]).sum(1) / np.maximum(usable.sum(1), 1)[:, None]
    twin = np.stack([before, after.sum(1) / RAYS], 1)
    return [compare(bounces._bounce, "irradiance", following.numpy().reshape(count, 6), twin.reshape(count, 6))]


def falloff(square: np.ndarray) -> np.ndarray:
    """What stands for exp(-square)."""
    return np.maximum(1.0 - square / 4.0, 0.0) ** 4


def measure_reconstruction(launcher: Any) -> list[Deviation]:
    """One a-trous step over the marked ones of gathered points of a bumpy grid, two to a triangle."""
    rng = np.random.default_rng(9)
    columns, rows = 9, 7
    count = columns * rows
    place = np.stack([*np.divmod(np.arange(count), columns), np.zeros(count)], 1) * 0.05
    place += rng.normal(0, 2e-3, (count, 3))
    normal = rng.normal(0, 0.2, (count, 3)) + np.array([0.0, 0.0, 1.0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    points = blank_points(launcher, count)
    points.position = launcher.array(place.astype(np.float32), wp.vec3)
    points.normal = points.normal_g = launcher.array(normal.astype(np.float32), wp.vec3)
    points.footprint = launcher.full(count, 0.01, wp.float32)
    guide = reconstruction.Guide()
    guide.stride, guide.columns, guide.rows, guide.radius = 6, columns, rows, 2
    guide.plane, guide.reach = 0.5, 0.25
    mark = rng.integers(0, 4, count) > 0
    gathered = reconstruction.Gathered()
    gathered.choice = launcher.array(np.arange(count, dtype=np.int32), wp.int32)
    triangle = np.arange(count) // 2
    spots: Any = np.zeros(count, reconstruction.Spot.numpy_dtype())
    spots["position"], spots["normal"], spots["normal_g"], spots["triangle"] = place, normal, normal, triangle
    gathered.spot = launcher.array(spots, reconstruction.Spot)
    light, nearness = rng.uniform(0, 3, (count, 3)), rng.uniform(0.3, 2.0, count)
    given = [launcher.array(light.astype(np.float32), wp.vec3)] * 2
    near = launcher.array(nearness.astype(np.float32), wp.float32)
    out = [launcher.empty(count, wp.vec3) for _ in range(2)]
    marked = launcher.array(mark.astype(np.int32), wp.int32)
    launcher.launch(reconstruction._smooth, count, [points, gathered, guide, 1, marked, *given, near], out)

    cell = np.stack([np.arange(count) % columns, np.arange(count) // columns], 1)
    close = np.abs(cell[:, None] - cell[None]).max(-1) <= 2
    offset = place[None] - place[:, None]
    facing = np.maximum(normal @ normal.T, 0.0)
    gap = np.maximum(np.abs(np.einsum("ijx,ix->ij", offset, normal)), np.abs(np.einsum("ijx,jx->ij", offset, normal)))
    gap[triangle[:, None] == triangle] = 0.0
    apart = np.linalg.norm(offset, axis=-1) * np.maximum(nearness[:, None], nearness[None]) / 0.25
    weight = facing**8 * falloff((gap / (0.5 * 6 * 0.01)) ** 2) * falloff(apart**2) * close
    weight = np.where((weight > 1e-3) & mark[:, None], weight, 0.0)
    np.fill_diagonal(weight, 1.0)
    twin = weight @ light / weight.sum(1, keepdims=True)
    return [compare(reconstruction._smooth, "before", out[0].numpy(), twin)]

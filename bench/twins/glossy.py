"""Twin of what glossy surfaces send along gathered rays (``kernels/glossy_hits.py``), under a light without extent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.bench.twins.deviation import Deviation, compare
from warp_dvct.bench.twins.direct import sample_light, seen
from warp_dvct.bench.twins.indirect import COUNT, RAYS, GatherRay, incident, places, world_of
from warp_dvct.bench.twins.numbers import dot
from warp_dvct.bench.twins.stage import POINT, make_scene
from warp_dvct.bench.twins.surfaces import Surfaces, brdf_cos, specular_albedo
from warp_dvct.bench.twins.volumes import fields, lit
from warp_dvct.kernels import gather
from warp_dvct.passes.gather import Gatherer, glossy_hits
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

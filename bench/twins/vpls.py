"""Twins of instant radiosity: hierarchical warping, VPLs' light with exact visibility, parabolic shadow maps."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_dvct.bench.twins.deviation import Deviation, compare
from warp_dvct.bench.twins.indirect import COUNT, places
from warp_dvct.bench.twins.numbers import cosine_hemisphere, dot, from_frame
from warp_dvct.bench.twins.stage import POINT, Twin, make_scene
from warp_dvct.kernels import ism, vpl_shading, warping
from warp_dvct.kernels import vpls as kernels
from warp_dvct.passes.ism import ray_sight
from warp_dvct.passes.vpl_shading import VplLight
from warp_dvct.passes.vpls import new_vpls
from warp_dvct.passes.warping import build_importance, texel_probabilities

VPLS = 48


def measure_warping(launcher: Any) -> list[Deviation]:
    """A texel's probability is its share of the whole, over eight decades and an odd size (Clarberg et al. 2005)."""
    image = (10.0 ** np.random.default_rng(2).uniform(-4, 4, (13, 21))).astype(np.float32)
    got = texel_probabilities(launcher, build_importance(launcher, image.ravel(), 21, 13))
    wide = image.astype(float)
    return [compare(warping._texel_probabilities, "probability", got.ravel(), (wide / wide.sum()).ravel())]


def random_vpls(launcher: Any, twin: Twin) -> tuple[Any, dict[str, np.ndarray]]:
    """VPLs in the room's air, real ones and synthetic ones, some behind objects; and their numbers."""
    rng = np.random.default_rng(3)
    numbers = {
        "position": rng.uniform(0.25, 0.75, (VPLS, 3)),
        "normal": from_frame(cosine_hemisphere(rng.random((VPLS, 2))), np.tile([0.0, -1.0, 0.0], (VPLS, 1))),
        "flux": rng.uniform(0, 1, (VPLS, 3)),
        "spread": rng.uniform(0.01, 0.1, VPLS) * (np.arange(VPLS) % 2),
        "real": rng.integers(0, 2, VPLS),
        "hidden": rng.integers(0, 2, VPLS),
    }
    numbers["hidden"] &= numbers["real"]
    vpls = new_vpls(launcher, VPLS)
    for name, values in numbers.items():
        dtype = wp.vec3 if values.ndim == 2 else (wp.float32 if name == "spread" else wp.int32)
        setattr(vpls, name, launcher.array(values.astype(np.int32 if dtype is wp.int32 else np.float32), dtype))
        if values.dtype.kind == "f":
            numbers[name] = values.astype(np.float32).astype(float)
    return vpls, numbers


def measure_vpls(launcher: Any) -> list[Deviation]:
    """Irradiance of points by all VPLs with exact rays (Knecht et al. 2012, eqs. 6-8); the discs that VPLs stand for;
    a level of a shadow map."""
    twin = Twin.upload(launcher, make_scene(POINT))
    points, position, normal, triangle = places(launcher, twin)
    vpls, numbers = random_vpls(launcher, twin)
    index = launcher.array(np.arange(COUNT, dtype=np.int32), wp.int32)
    got = VplLight(twin.device, vpls, ray_sight(launcher), 1, True).irradiance(launcher, points, index, COUNT)

    before, after = np.zeros((COUNT, 3)), np.zeros((COUNT, 3))
    origin = twin.spawn(position, triangle, normal)
    inserted = triangle >= twin.reals
    for k in range(VPLS):
        d = numbers["position"][k] - origin
        distance = np.linalg.norm(d, axis=-1)
        toward = d / distance[:, None]
        leaving, arriving = np.maximum(-toward @ numbers["normal"][k], 0.0), np.maximum(dot(toward, normal), 0.0)
        form = leaving * arriving / (np.pi * (distance**2 + numbers["spread"][k] ** 2))
        open_real, open_all = (
            twin.nearest(origin, toward, part)[0] >= 0.9999 * distance for part in (twin.real, slice(0, None))
        )
        light = form[:, None] * numbers["flux"][k]
        if numbers["real"][k]:
            before += light * (open_real & ~inserted)[:, None]
        if not numbers["hidden"][k]:
            after += light * open_all[:, None]
    kernel = vpl_shading._shade_vpls
    rows = [
        compare(kernel, "before", got[0].numpy()[~inserted], before[~inserted]),
        compare(kernel, "after", got[1].numpy(), after),
    ]
    return [*rows, spread_row(launcher, vpls, numbers), pull_row(launcher)]


def spread_row(launcher: Any, vpls: Any, numbers: dict[str, np.ndarray]) -> Deviation:
    """Half the distance of the fourth neighbour of the same kind that faces alike, and no more than it was."""
    launcher.launch(kernels._spread_vpls, VPLS, [vpls, 0, VPLS, 1.0, 0.3])
    apart = np.linalg.norm(numbers["position"][:, None] - numbers["position"][None], axis=-1)
    like = (numbers["normal"] @ numbers["normal"].T > 0.7) & (numbers["real"][:, None] == numbers["real"][None])
    most = np.where(numbers["spread"] > 0.0, np.minimum(0.3, 2.0 * numbers["spread"]), 0.3)[:, None]
    apart = np.where(like & ~np.eye(VPLS, dtype=bool), np.minimum(apart, most), most)
    return compare(kernels._spread_vpls, "vpls.spread", vpls.spread.numpy(), np.sort(apart, 1)[:, 3] / 2.0)


def pull_row(launcher: Any) -> Deviation:
    """A coarse texel of a shadow map is the mean of its filled ones, where three of four are."""
    size = 16
    rng = np.random.default_rng(7)
    fine = (rng.uniform(0.1, 9, (size, size)) * (rng.random((size, size)) < 0.7)).astype(np.float32)
    maps = ism.Ism()
    maps.size, maps.levels, maps.stride = size, 2, size * size + size * size // 4
    maps.inverse = launcher.array(np.concatenate([fine.ravel(), np.zeros(size * size // 4, np.float32)]), wp.float32)
    launcher.launch(ism._pull, size * size // 4, [0, maps, 1], [maps.inverse])
    quads = fine.astype(float).reshape(size // 2, 2, size // 2, 2)
    filled = (quads > 0).sum((1, 3))
    twin = np.where(filled >= 3, quads.sum((1, 3)) / np.maximum(filled, 1), 0.0)
    return compare(ism._pull, "inverse", maps.inverse.numpy()[size * size :], twin.ravel())

"""Twins of instant radiosity: hierarchical warping, VPLs' light with exact visibility, their further bounces, parabolic
shadow maps."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_dvct.bench.twins.deviation import Deviation, compare
from warp_dvct.bench.twins.indirect import COUNT, places
from warp_dvct.bench.twins.numbers import cosine_hemisphere, dot, from_frame, sobol2
from warp_dvct.bench.twins.stage import POINT, Twin, make_scene
from warp_dvct.kernels import ism, vpl_bounces, vpl_shading, warping
from warp_dvct.kernels import vpls as kernels
from warp_dvct.passes.ism import ray_sight
from warp_dvct.passes.vpl_shading import VplLight
from warp_dvct.passes.vpls import new_vpls
from warp_dvct.passes.warping import build_importance, texel_probabilities

VPLS = 48
DRAWS = 8


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


def measure_vpl_bounces(launcher: Any) -> list[Deviation]:
    """What points of surfaces send on of the VPLs that they draw by flux, apart for light that both solutions have
    (Knecht et al. 2012, eqs. 9 and 10)."""
    twin = Twin.upload(launcher, make_scene(POINT))
    _, position, normal, triangle = places(launcher, twin)
    vpls, numbers = random_vpls(launcher, twin)
    rng = np.random.default_rng(15)
    reach = 0.9
    cdf = np.concatenate([[0.0], np.cumsum(rng.uniform(0.2, 1.0, VPLS))]).astype(np.float32)
    cdf /= cdf[-1]
    area, albedo = (rng.uniform(0.1, 1.0, shape).astype(np.float32) for shape in (COUNT, (COUNT, 3)))
    inserted = triangle >= twin.reals
    cloud = ism.Cloud()
    cloud.count = cloud.block = COUNT
    cloud.position, cloud.normal, cloud.albedo = (
        launcher.array(v.astype(np.float32), wp.vec3) for v in (position, normal, albedo)
    )
    cloud.area, cloud.synthetic = launcher.array(area, wp.float32), launcher.array(inserted.astype(np.int32), wp.int32)
    sources = vpl_bounces.Sources()
    sources.count, sources.draws, sources.reach = VPLS, DRAWS, reach
    sources.cdf = launcher.array(cdf, wp.float32)
    out = []
    for _ in range(2):
        candidates = vpl_bounces.Candidates()
        for name, variable in vpl_bounces.Candidates.vars.items():
            setattr(candidates, name, launcher.zeros(COUNT, variable.type.dtype))
        out.append(candidates)
    given = [twin.device.geometry, cloud, ray_sight(launcher), sources, vpls]
    launcher.launch(vpl_bounces._light_candidates, COUNT, given, out)

    sums = np.zeros((2, COUNT, 3))
    for draw in range(DRAWS):
        u = sobol2(0, np.arange(COUNT), draw, 45)[:, 0]
        k = np.searchsorted(cdf, u.astype(np.float32), side="right") - 1
        flux, common = sent_on(twin, {n: v[k] for n, v in numbers.items()}, position, normal, inserted, reach)
        leaving = flux * albedo * (area / ((cdf[k + 1].astype(float) - cdf[k]) * DRAWS))[:, None]
        for s, chosen in enumerate((common, ~common)):
            sums[s] += leaving * chosen[:, None]
    return [
        compare(vpl_bounces._light_candidates, f"{name}.flux", got.flux.numpy(), twin_sum)
        for name, got, twin_sum in zip(("common", "changed"), out, sums, strict=True)
    ]


def sent_on(
    twin: Twin,
    vpl: dict[str, np.ndarray],
    position: np.ndarray,
    normal: np.ndarray,
    inserted: np.ndarray,
    reach: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance of each point, on the side that its VPL is on, and whether both solutions have it."""
    normal = np.where(dot(vpl["position"] - position, normal)[:, None] < 0.0, -normal, normal)
    origin = position + normal * (2.0e-6 * reach)
    d = vpl["position"] - origin
    distance = np.linalg.norm(d, axis=-1)
    toward = d / distance[:, None]
    leaving, arriving = -dot(toward, vpl["normal"]), dot(toward, normal)
    form = np.where((leaving > 0) & (arriving > 0), leaving * arriving, 0.0)
    past_real, past_inserted = (
        twin.nearest(origin, toward, part)[0] >= 0.9999 * distance for part in (twin.real, twin.synthetic)
    )
    real, hidden = vpl["real"] == 1, vpl["hidden"] == 1
    # Light of the picture before alone does not meet what is inserted; light that something inserted blocks goes on
    # as such, where all of its path is real.
    counts = past_real & ~(hidden & inserted) & (hidden | past_inserted | (real & ~inserted))
    light = vpl["flux"] * (form * counts / (np.pi * (distance**2 + vpl["spread"] ** 2)))[:, None]
    return light, real & ~hidden & past_inserted & ~inserted


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

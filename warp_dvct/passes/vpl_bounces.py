"""Virtual point lights of the second and further bounces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import vpl_bounces as kernels
from warp_dvct.kernels.vpl_bounces import Candidates, Sources
from warp_dvct.launch import Launcher
from warp_dvct.passes.point_cloud import SurfacePoints
from warp_dvct.passes.vpls import LUMINANCE, share_out

# Shares of the slots: of real surfaces by light that both solutions have, by light of one alone, of synthetic surfaces.
SHARES = (0.5, 0.25, 0.25)


@dataclass(frozen=True)
class _Class:
    """Points of one cloud and what they send on of one class of light."""

    cloud: Any
    candidates: Any
    weight: np.ndarray  # luminance of each point's flux, float64
    order: np.ndarray  # the points along a curve that keeps neighbours together


def bounce_vpls(
    launcher: Launcher,
    scene: DeviceScene,
    vpls: Any,
    points: SurfacePoints,
    sight: Any,
    source: tuple[int, int],
    start: int,
    count: int,
    *,
    draws: int,
    strongest: bool,
    reach: float,
    seed: int,
) -> int:
    """Make the VPLs of a further bounce in ``count`` slots from ``start`` on (Knecht et al. 2012, section 3.6).

    Every point of the clouds draws ``draws`` VPLs of the bounce before in proportion to their flux and asks ``sight``
    whether they see it; then points compete for slots. Light that both solutions have, light of one alone and synthetic
    surfaces have slots of their own: the first is most of all, and the others, which decide the difference, would
    rarely be drawn beside it.

    Args:
        source: First and number of the VPLs of the bounce before.
        strongest: Of every so-many-th points the strongest gets the slot with the flux of them all, as in the paper;
            else points are drawn in proportion to their flux, at even steps along a curve over the surfaces, and all
            slots of a class carry the same: that keeps the light where it is.
    Returns:
        How many were made: 0 where the bounce before carries no light that anything sees.
    """
    flux = vpls.flux.numpy()[source[0] : source[0] + source[1]] @ LUMINANCE
    if not flux.sum() > 0.0:
        return 0
    cdf = np.concatenate([[0.0], np.cumsum(flux) / flux.sum()])
    cdf[-1] = 1.0
    sources = Sources()
    sources.start, sources.count = source
    sources.draws, sources.seed, sources.reach = draws, seed, reach
    sources.cdf = launcher.array(cdf.astype(np.float32), wp.float32)
    classes = list(_light_clouds(launcher, scene, vpls, points, sight, sources))
    lit = [share if c.weight.sum() > 0.0 else 0.0 for c, share in zip(classes, SHARES, strict=True)]
    made = 0
    for number, (member, share) in enumerate(zip(classes, share_out(lit, count), strict=True)):
        if share == 0:
            continue
        chosen, gain = _strongest(member, share) if strongest else _drawn(member, share, seed + number)
        launcher.launch(
            kernels._fill_slots,
            len(chosen),
            [
                member.cloud,
                member.candidates,
                launcher.array(chosen.astype(np.int32), wp.int32),
                launcher.array(gain.astype(np.float32), wp.float32),
                int(strongest),
                start + made,
                reach,
                vpls,
            ],
        )
        made += len(chosen)
    return made


def _light_clouds(
    launcher: Launcher, scene: DeviceScene, vpls: Any, points: SurfacePoints, sight: Any, sources: Any
) -> Iterator[_Class]:
    """The classes of ``SHARES``; on synthetic surfaces all light is of one solution alone."""
    for cloud, order, synthetic in (
        (points.real, points.real_order, False),
        (points.synthetic, points.synthetic_order, True),
    ):
        common, changed = (_new_candidates(launcher, cloud.count) for _ in range(2))
        launcher.launch(
            kernels._light_candidates, cloud.count, [scene.geometry, cloud, sight, sources, vpls], [common, changed]
        )
        for candidates in (changed,) if synthetic else (common, changed):
            flux = candidates.flux.numpy()[: cloud.count]
            yield _Class(cloud, candidates, flux.astype(np.float64) @ LUMINANCE, order)


def _new_candidates(launcher: Launcher, count: int) -> Any:
    candidates = Candidates()
    for name, variable in Candidates.vars.items():
        setattr(candidates, name, launcher.zeros(max(1, count), variable.type.dtype))
    return candidates


def _drawn(member: _Class, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points in proportion to their flux, by systematic sampling, and what multiplies their flux."""
    ends = np.cumsum(member.weight[member.order])
    total = ends[-1]
    at = (np.arange(count) + np.random.default_rng(seed).random()) * (total / count)
    index = np.minimum(np.searchsorted(ends, at, side="right"), len(ends) - 1)
    chosen = member.order[index]
    return chosen, total / count / np.maximum(member.weight[chosen], 1e-300)


def _strongest(member: _Class, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Of every ``count``-th points the strongest, and the flux of all over its own; slots without light left out."""
    padded = np.zeros(-(-len(member.weight) // count) * count)
    padded[: len(member.weight)] = member.weight
    groups = padded.reshape(-1, count)
    best, total = groups.max(0), groups.sum(0)
    used = best > 0.0
    chosen = groups.argmax(0) * count + np.arange(count)
    return chosen[used], total[used] / best[used]

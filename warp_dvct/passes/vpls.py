"""Virtual point lights of the first bounce, and those on the sky."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import vpls as kernels
from warp_dvct.kernels.vpls import Vpls
from warp_dvct.launch import Launcher
from warp_dvct.passes.rsm import ShadowMaps, render_rsm
from warp_dvct.passes.warping import Importance, build_importance

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
SPREAD_LIMIT = 0.25  # largest radius that a VPL may stand for, in radii of the lit region


@dataclass(frozen=True)
class Region:
    """What maps have to cover, in volume space.

    Attributes:
        center, radius: Sphere around all that is lit and seen. start: Distance at which parallel beams start.
        focus, focus_radius: Sphere around the synthetic objects (or all, where there are none).
        reach: Largest coordinate of any surface: it scales rounding errors.
    """

    center: tuple[float, float, float]
    radius: float
    start: float
    focus: tuple[float, float, float]
    focus_radius: float
    reach: float


@dataclass(frozen=True)
class LightMaps:
    """One light's maps, ready to be sampled.

    Attributes:
        maps: ``kernels.vpls.Maps``.
        real, synthetic: Importance of the two maps.
        synthetic_share: Probability of the synthetic map.
        fluxes: Luminance of the flux that is reflected by seen real surfaces, by real ones behind synthetic ones, and
            by synthetic ones (or, of an added light, by all).
    """

    light: int
    maps: Any
    real: Importance
    synthetic: Importance
    synthetic_share: float
    fluxes: tuple[float, float, float]

    @property
    def flux(self) -> float:
        """The sum of ``fluxes``."""
        return sum(self.fluxes)


def new_vpls(launcher: Launcher, count: int) -> Any:
    """``Vpls`` with room for ``count`` entries, all dark."""
    vpls = Vpls()
    vpls.count = count
    for name, variable in Vpls.vars.items():
        if name != "count":
            setattr(vpls, name, launcher.zeros(max(1, count), variable.type.dtype))
    return vpls


def light_maps(
    launcher: Launcher,
    scene: DeviceScene,
    light: int,
    *,
    added: bool,
    size: int,
    region: Region,
    focus: float,
    least: float,
    single: bool,
    seed: int,
) -> LightMaps:
    """Render a light's pair of reflective shadow maps and the importance of their texels.

    Args:
        added: Whether the light is an added one: then all its surfaces go into one map.
        size: Texels an edge.
        focus: Share of the VPLs that go by nearness to the synthetic objects, 0 … 1; the others go by flux alone.
        least: Least share of VPLs on synthetic surfaces and on real ones behind them, where there are any; 0 is the
            paper's choice by covered pixels.
        single: The method of 2010: one map of the front-most surfaces, without VPL3.
    """
    rsm = render_rsm(
        launcher, scene, light, size, center=region.center, radius=region.radius, start=region.start, seed=seed
    )
    maps = _maps(rsm, added, single)
    look = kernels.Focus()
    look.center, look.radius = wp.vec3(*region.focus), region.focus_radius
    count = size * size
    real, synthetic = (launcher.empty(count, wp.float32) for _ in range(2))
    hidden = launcher.empty(count, wp.int32)
    sums = []
    for look.everywhere, look.near in ((1.0, 0.0), (0.0, 1.0)):
        launcher.launch(kernels._rsm_importance, count, [maps, look, 1.0], [real, synthetic, hidden])
        sums.append(float(real.numpy().sum(dtype=np.float64) + synthetic.numpy().sum(dtype=np.float64)))
    # A share ``focus`` of the VPLs follows the nearness, however small the part of the map that is near.
    look.everywhere = 1.0 - focus if sums[1] > 0.0 else 1.0
    look.near = focus * sums[0] / sums[1] if sums[1] > 0.0 else 0.0
    launcher.launch(kernels._rsm_importance, count, [maps, look, 1.0], [real, synthetic, hidden])
    gain = _hidden_gain(real.numpy(), hidden.numpy(), least)
    if gain != 1.0:
        launcher.launch(kernels._rsm_importance, count, [maps, look, gain], [real, synthetic, hidden])
    covered_real = int((real.numpy() > 0).sum())
    covered_synthetic = int((synthetic.numpy() > 0).sum())
    share = 0.0
    if covered_synthetic:
        share = max(covered_synthetic / (covered_real + covered_synthetic), least) if covered_real else 1.0
    return LightMaps(
        light,
        maps,
        build_importance(launcher, real, size, size),
        build_importance(launcher, synthetic, size, size),
        share,
        _reflected(rsm, added, single),
    )


def _maps(rsm: ShadowMaps, added: bool, single: bool) -> Any:
    maps = kernels.Maps()
    maps.size, maps.added, maps.single = rsm.size, int(added), int(single)
    for name in ("position", "normal", "flux", "role"):
        for when in ("after", "before"):
            setattr(maps, f"{name}_{when}", getattr(rsm, f"{name}_{when}"))
    return maps


def _hidden_gain(real: np.ndarray, hidden: np.ndarray, least: float) -> float:
    """What multiplies the importance of texels behind synthetic surfaces so that they get their least share."""
    behind = float(real[hidden == 1].sum(dtype=np.float64))
    front = float(real[hidden == 0].sum(dtype=np.float64))
    if behind <= 0.0 or front <= 0.0 or behind / (behind + front) >= least:
        return 1.0
    return least / (1.0 - least) * front / behind


def _reflected(rsm: ShadowMaps, added: bool, single: bool) -> tuple[float, float, float]:
    """Luminance of the reflected flux of each class of VPLs."""
    after, before = rsm.role_after.numpy(), rsm.role_before.numpy()

    def total(flux: Any, chosen: np.ndarray) -> float:
        return float(flux.numpy()[chosen].sum(0, dtype=np.float64) @ LUMINANCE)

    if added:
        return 0.0, 0.0, total(rsm.flux_after, after >= 0)
    hidden = 0.0 if single else total(rsm.flux_before, (before == 0) & (after == 1))
    return total(rsm.flux_before, (before == 0) & (after != 1)), hidden, total(rsm.flux_after, after == 1)


def share_out(weights: list[float], count: int) -> list[int]:
    """Split ``count`` by weights, the largest remainders first; what has weight gets at least one where it can be."""
    total = sum(weights)
    if total <= 0.0 or count <= 0:
        return [0] * len(weights)
    exact = [count * w / total for w in weights]
    shares = [int(e) for e in exact]
    shares = [max(s, 1) if w > 0.0 else 0 for s, w in zip(shares, weights, strict=True)]
    order = sorted(range(len(weights)), key=lambda i: shares[i] - exact[i])
    for step in range(max(0, count - sum(shares))):
        shares[order[step % len(order)]] += 1
    while sum(shares) > count and max(shares) > 1:
        shares[shares.index(max(shares))] -= 1
    return shares


def choose_vpls(
    launcher: Launcher, lights: list[LightMaps], vpls: Any, start: int, count: int, *, reach: float, seed: int
) -> int:
    """Make ``count`` VPLs of the first bounce from ``start`` on, shared out among the lights by reflected flux.

    Returns:
        How many were made: 0 where no light's importance is above zero anywhere.
    """
    usable = [m if m.real.total + m.synthetic.total > 0.0 else None for m in lights]
    shares = share_out([m.flux if m else 0.0 for m in usable], count)
    made = 0
    for maps, share in zip(usable, shares, strict=True):
        if maps is None or share == 0:
            continue
        launcher.launch(
            kernels._choose_vpls,
            share,
            [
                maps.maps,
                maps.real.chain,
                maps.synthetic.chain,
                maps.synthetic_share,
                maps.light,
                share,
                seed,
                reach,
                start + made,
                vpls,
            ],
        )
        _balance(launcher, maps, vpls, start + made, share)
        made += share
    return made


def _balance(launcher: Launcher, maps: LightMaps, vpls: Any, start: int, count: int) -> None:
    """Scale each class of a light's VPLs to the flux that its maps hold: a few VPLs then carry the right light, if not
    from quite the right places. The ratio's own bias falls as 1 / N."""
    end = start + count
    flux = vpls.flux.numpy()[start:end] @ LUMINANCE
    real, hidden = vpls.real.numpy()[start:end] == 1, vpls.hidden.numpy()[start:end] == 1
    factors = []
    for members, expected in zip((real & ~hidden, hidden, ~real), maps.fluxes, strict=True):
        found = float(flux[members].sum(dtype=np.float64))
        factors.append(expected / found if found > 0.0 else 1.0)
    launcher.launch(kernels._scale_vpls, count, [start, *factors, vpls])


def choose_sky(launcher: Launcher, env: Any, vpls: Any, start: int, count: int, *, seed: int) -> int:
    """Make ``count`` VPLs on the sphere of the environment from ``start`` on; they are direct light.

    Args:
        env: ``kernels.environment.Environment``.
    Returns:
        How many were made: 0 where there is no dome, or a black one.
    """
    if env.levels == 0 or count == 0:
        return 0
    texels = env.width * env.height
    skies = []
    for added in (0, 1):
        importance = launcher.empty(texels, wp.float32)
        launcher.launch(kernels._sky_importance, texels, [env, added], [importance])
        skies.append(build_importance(launcher, importance, env.width, env.height))
    made = 0
    for added, (sky, share) in enumerate(zip(skies, share_out([s.total for s in skies], count), strict=True)):
        launcher.launch(kernels._choose_sky, share, [env, sky.chain, added, share, seed, start + made, vpls])
        made += share
    return made


def spread_vpls(launcher: Launcher, vpls: Any, start: int, count: int, *, scale: float, region: Region) -> None:
    """Set the radius of the disc that each of ``count`` VPLs from ``start`` on stands for; ``scale`` 0 clamps nothing.

    A VPL lights as a disc of that radius does on its axis, 1 / (d² + R²) for 1 / d²: bounded near surfaces, and
    unbiased in the limit because R falls as the VPLs grow in number. No disc is larger than the one that it has
    already, where it has one.
    """
    if scale > 0.0:
        limit = SPREAD_LIMIT * region.radius
        launcher.launch(kernels._spread_vpls, count, [vpls, start, count, scale, limit])
    else:
        vpls.spread[start : start + count].zero_()

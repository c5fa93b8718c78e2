"""Eq. 9 of Franke 2014, measured: how far Cµ + C∆ is from Cρ, for the cone march's forms.

Cρ and Cµ are gathered in volumes of their own, the scene with the synthetic objects and without them, by the same cones
at the same points; C∆ is what a form takes for the delta. E = Cρ - (Cµ + C∆) is then the error of the form alone: one
occupancy for two scenes (split), which ``dual`` avoids. What the cones themselves miss shows in the last column, where
C∆ is compared with the delta by exact rays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from warp_dvct.device_scene import DeviceScene
from warp_dvct.errors import OptionError
from warp_dvct.kernels import cones
from warp_dvct.launch import Launcher
from warp_dvct.methods.light_field import LightField, light_volumes
from warp_dvct.passes.gather import Gatherer, gather_all
from warp_dvct.passes.gbuffer import render_gbuffer
from warp_dvct.plan import Plan, make_plan
from warp_dvct.scene import Role, Scene
from warp_dvct.settings import Settings, make_settings

FORMS: dict[str, dict[str, str]] = {
    "dual": {"cones.delta": "dual", "cones.filter": "directional", "cones.coverage": "additive"},
    "split": {"cones.delta": "split", "cones.filter": "directional", "cones.coverage": "additive"},
    "paper": {
        "cones.delta": "split",
        "cones.filter": "isotropic",
        "cones.coverage": "product",
        "cones.escape": "volume",
    },
}
REFERENCE_RAYS = 512


@dataclass(frozen=True)
class DeltaError:
    """One form's figures over the points; all but ``before`` and ``delta`` are relative to the mean of Cµ.

    Attributes:
        form: Name in ``FORMS``.
        before, delta: Means of Cµ and of Cρ - Cµ, W m^-2.
        mean, rms, worst: Of E: mean of its absolute value, root mean square, largest absolute value.
        against_rays: Root mean square of C∆ less the delta by exact rays.
    """

    form: str
    before: float
    delta: float
    mean: float
    rms: float
    worst: float
    against_rays: float


def delta_error(
    launcher: Launcher,
    scene: Scene,
    *,
    width: int = 96,
    quality: str = "balanced",
    settings: dict[str, Any] | None = None,
) -> list[DeltaError]:
    """E of each form, at one bounce, over the real surfaces that the camera sees.

    Args:
        width: Pixels across; a point per pixel.
        settings: Over the quality's preset; each form's own come last.
    Raises:
        OptionError: The scene has nothing synthetic, or no real surface is in view.
    """
    if scene.bounds(Role.SYNTHETIC) is None:
        raise OptionError("the stage has nothing synthetic, so there is no delta to measure")
    rows = []
    for form, own in FORMS.items():
        made = make_settings(quality, {**(settings or {}), "bounces": 1, "gather": "cones", **own})
        rows.append(_measure(launcher, scene, form, made, width))
    return rows


def _measure(launcher: Launcher, scene: Scene, form: str, settings: Settings, width: int) -> DeltaError:
    height = max(1, round(width / scene.camera.aspect))
    plan = make_plan(scene, settings, "delta-cones", width, height)
    device_scene = _upload(launcher, scene, plan)
    buffer = render_gbuffer(launcher, device_scene, width, height, edge_samples=0, behind=False)
    real = buffer.points.role.numpy()[: buffer.count] == Role.REAL
    if not real.any():
        raise OptionError("the camera sees no real surface; nothing to measure")

    def gather(what: Scene, how: Any) -> tuple[np.ndarray, np.ndarray]:
        there = device_scene if what is scene else _upload(launcher, what, plan)
        lit = light_volumes(launcher, what, there, plan)
        before, after = gather_all(launcher, buffer.points, buffer.count, how(there, lit))
        return tuple(a.numpy()[: buffer.count][real].astype(np.float64) for a in (before, after))

    def by_cones(delta: int) -> Any:
        return lambda there, lit: Gatherer(
            there, lit.world, settings.gather_rays, settings.seed, settings.cones_count, _cone(plan, delta)
        )

    def by_rays(there: DeviceScene, lit: LightField) -> Gatherer:
        return Gatherer(there, lit.world, REFERENCE_RAYS, settings.seed)

    without = replace(scene, meshes=tuple(m for m in scene.meshes if m.role == Role.REAL))
    together = replace(scene, meshes=tuple(replace(m, role=Role.REAL) for m in scene.meshes))
    c_mu = gather(without, by_cones(cones.DUAL))[0]
    c_rho = gather(together, by_cones(cones.DUAL))[0]
    before, after = gather(scene, by_cones(cones.DUAL if settings.cones_delta == "dual" else cones.SPLIT))
    c_delta = after - before
    exact = gather(scene, by_rays)
    error = c_rho - (c_mu + c_delta)
    scale = float(c_mu.mean())
    return DeltaError(
        form,
        scale,
        float((c_rho - c_mu).mean()),
        float(np.abs(error).mean()) / scale,
        float(np.sqrt((error**2).mean())) / scale,
        float(np.abs(error).max()) / scale,
        float(np.sqrt(((c_delta - (exact[1] - exact[0])) ** 2).mean())) / scale,
    )


def _upload(launcher: Launcher, scene: Scene, plan: Plan) -> DeviceScene:
    return DeviceScene.upload(launcher, scene, np.asarray(plan.origin), plan.scale)


def _cone(plan: Plan, delta: int) -> Any:
    from warp_dvct.methods.delta_cone_tracing import _cone as cone_of

    cone = cone_of(plan)
    cone.split = delta
    return cone


def format_rows(stage: str, rows: list[DeltaError]) -> str:
    """A table for a terminal."""
    lines = [
        f"{stage}: E = Cρ - (Cµ + C∆), irradiance on real surfaces at one bounce, relative to each form's mean Cµ",
        f"{'form':8}{'Cµ W/m²':>10}{'(Cρ-Cµ)/Cµ':>12}{'mean |E|':>11}{'rms E':>11}{'max |E|':>11}{'rms C∆ - rays':>15}",
    ]
    lines += [
        f"{r.form:8}{r.before:10.4g}{r.delta / r.before:12.4f}{r.mean:11.2e}{r.rms:11.2e}{r.worst:11.2e}"
        f"{r.against_rays:15.4f}"
        for r in rows
    ]
    return "\n".join(lines)

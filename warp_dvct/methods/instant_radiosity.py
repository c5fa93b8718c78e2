"""Differential instant radiosity (Knecht et al. 2012): relight a real scene by virtual point lights.

What it costs: a pair of reflective shadow maps per light, two imperfect shadow maps per VPL, and one visibility test
per pixel and VPL of its interleaved set. Where it is wrong: VPLs are few, so indirect light has their pattern; near
surfaces they light as discs, which is too dark in corners; imperfect shadow maps lose what is thinner than their
points' distances; VPLs are diffuse, so light that a glossy surface focuses onto others is spread.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kept import content_key
from warp_dvct.kernels import specular
from warp_dvct.kernels.vpls import Vpls
from warp_dvct.launch import Launcher
from warp_dvct.layers import Radiance
from warp_dvct.passes.environment import build_environment
from warp_dvct.passes.gather import shade_indirect
from warp_dvct.passes.gbuffer import GBuffer, render_gbuffer
from warp_dvct.passes.history import Blender, History
from warp_dvct.passes.ism import draw_isms, new_isms, ray_sight
from warp_dvct.passes.lobe_smoothing import Smoothing, lobe_grid
from warp_dvct.passes.point_cloud import SurfacePoints, sample_surfaces
from warp_dvct.passes.resolve import resolve
from warp_dvct.passes.shading import direct_settings, shade_direct
from warp_dvct.passes.specular import find_glossy
from warp_dvct.passes.vpl_bounces import bounce_vpls
from warp_dvct.passes.vpl_memory import check_memory, surface_vpls
from warp_dvct.passes.vpl_shading import (
    VplLight,
    light_picture,
    light_points,
    shade_direct_single,
    shade_glossy,
)
from warp_dvct.passes.vpls import Region, choose_sky, choose_vpls, light_maps, new_vpls, spread_vpls
from warp_dvct.plan import Plan
from warp_dvct.scene import Light, LightKind, LightRole, Notice, Role, Scene

SEED_STEP = 104_729  # between the random numbers of a shot's frames


@dataclass(frozen=True)
class VplSet:
    """The VPLs of all bounces, which depend on geometry and lights but not on the camera.

    Attributes:
        vpls: ``kernels.vpls.Vpls``: those on the sky first, then bounce after bounce.
        sight: ``kernels.ism.Sight``, by which they see.
        ends: Where each part ends: the sky, then each bounce.
        env: ``kernels.environment.Environment``.
        region: What was covered.
        notices: What could not be done.
    """

    vpls: Any
    sight: Any
    ends: tuple[int, ...]
    env: Any
    region: Region
    notices: tuple[Notice, ...]


def make_vpls(launcher: Launcher, scene: Scene, device_scene: DeviceScene, plan: Plan) -> VplSet:
    """Place VPLs on the sky, on what the lights light, and on what those light (sections 3.3, 3.6 and 3.7)."""
    settings = plan.settings
    check_memory(launcher, settings, lights=len(scene.lights), dome=has_dome(scene.lights))
    region = lit_region(scene, device_scene, plan)
    env = build_environment(launcher, scene.lights)
    sky = settings.vpls_sky if env.levels else 0
    maps = surface_vpls(settings)
    vpls = new_vpls(launcher, sky + maps)
    with launcher.scope("vpls"):
        start = choose_sky(launcher, env, vpls, 0, sky, seed=settings.seed)
    single = settings.shadow_maps == "single"
    if settings.visibility == "ray":
        sight = ray_sight(launcher, single=single)
    else:
        with launcher.scope("ism"):
            sight = new_isms(launcher, maps, size=settings.ism_size, bias=settings.ism_bias, first=start, single=single)
    builder = _Builder(launcher, scene, device_scene, plan, region, vpls, sight, start)
    if settings.bounces:
        builder.first_bounce()
    for bounce in range(2, settings.bounces + 1):
        builder.next_bounce(bounce)
    vpls.count = builder.ends[-1]
    return VplSet(vpls, sight, tuple(builder.ends), env, region, tuple(builder.notices))


class _Builder:
    """Fills the VPL buffer part by part behind the ``sky`` VPLs; each part gets its shadow maps before the next one
    needs them."""

    def __init__(
        self,
        launcher: Launcher,
        scene: Scene,
        device_scene: DeviceScene,
        plan: Plan,
        region: Region,
        vpls: Any,
        sight: Any,
        sky: int,
    ) -> None:
        self.launcher, self.scene, self.device_scene, self.plan = launcher, scene, device_scene, plan
        self.region, self.vpls, self.sight = region, vpls, sight
        self.ends = [sky]
        self.notices: list[Notice] = []
        self._points: SurfacePoints | None = None

    @property
    def points(self) -> SurfacePoints:
        """The clouds, sampled when first asked for."""
        if self._points is None:
            settings = self.plan.settings
            with self.launcher.scope("point cloud"):
                self._points = sample_surfaces(
                    self.launcher,
                    self.device_scene,
                    self.region,
                    block=settings.ism_points,
                    blocks=settings.ism_blocks,
                    seed=settings.seed,
                    scans=self.scene.point_clouds,
                )
        return self._points

    def extend(self, made: int) -> None:
        """Take ``made`` VPLs on surfaces into the set: their discs and their shadow maps."""
        start = self.ends[-1]
        self.ends.append(start + made)
        settings = self.plan.settings
        if made:
            spread_vpls(self.launcher, self.vpls, start, made, scale=settings.vpls_clamp, region=self.region)
        if made and not self.sight.rays:
            points = self.points
            with self.launcher.scope("ism"):
                draw_isms(self.launcher, self.sight, self.vpls, points, start, made, grow=settings.ism_grow)

    def first_bounce(self) -> None:
        """VPLs on what the lights light directly."""
        settings = self.plan.settings
        with self.launcher.scope("rsm"):
            maps = [
                light_maps(
                    self.launcher,
                    self.device_scene,
                    i,
                    added=light.role == LightRole.ADDED,
                    size=settings.vpls_map,
                    region=self.region,
                    focus=settings.vpls_focus,
                    least=settings.vpls_least,
                    single=settings.shadow_maps == "single",
                    seed=settings.seed,
                )
                for i, light in enumerate(self.scene.lights)
            ]
        for light, found in zip(self.scene.lights, maps, strict=True):
            if found.real.total + found.synthetic.total <= 0.0:
                self.notices.append(
                    Notice(light.path, "it lights nothing in reach: no virtual point lights are made of it")
                )
        with self.launcher.scope("vpls"):
            made = choose_vpls(
                self.launcher,
                maps,
                self.vpls,
                self.ends[-1],
                settings.vpls_count,
                reach=self.region.reach,
                seed=settings.seed,
            )
        self.extend(made)

    def next_bounce(self, bounce: int) -> None:
        """VPLs on what those of the last bounce light."""
        settings = self.plan.settings
        source = (self.ends[-2], self.ends[-1] - self.ends[-2])
        points = self.points
        with self.launcher.scope("bounces"):
            made = bounce_vpls(
                self.launcher,
                self.device_scene,
                self.vpls,
                points,
                self.sight,
                source,
                self.ends[-1],
                settings.vpls_further,
                draws=settings.vpls_sources,
                strongest=settings.vpls_slots == "strongest",
                reach=self.region.reach,
                seed=settings.seed + 7919 * bounce,
            )
        self.extend(made)


def lit_region(scene: Scene, device_scene: DeviceScene, plan: Plan) -> Region:
    """The sphere around the part of the scene that the plan's volumes cover, and the one around what is synthetic."""
    box = plan.coarse or plan.fine
    low, high = _bounds(scene, device_scene, None)
    low = np.maximum(low, np.asarray(box.low))
    high = np.minimum(high, np.asarray(box.low) + box.edge)
    center, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(np.maximum(high - low, 0.0))) * 1.001
    focus, focus_radius = center, radius
    if scene.bounds(Role.SYNTHETIC) is not None:
        low, high = _bounds(scene, device_scene, Role.SYNTHETIC)
        focus, focus_radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    reach = float(np.abs(device_scene.triangles_vs).max()) if len(device_scene.triangles_vs) else 1.0
    floor = 1e-6 * max(reach, 1.0)
    return Region(
        (float(center[0]), float(center[1]), float(center[2])),
        max(radius, floor),
        plan.start + radius,
        (float(focus[0]), float(focus[1]), float(focus[2])),
        max(focus_radius, floor),
        max(reach, 1.0),
    )


def _bounds(scene: Scene, device_scene: DeviceScene, role: Role | None) -> tuple[np.ndarray, np.ndarray]:
    bounds = scene.bounds(role) or (np.zeros(3), np.ones(3))
    low, high = ((b - device_scene.origin) * device_scene.scale for b in bounds)
    return low, high


class Shot:
    """Frames of one scene in which nothing but the camera moves: a moved light or object begins another shot.

    With ``vpls.frames`` at 1 all frames have the same VPLs and equal frames from scratch. Above, each frame draws its
    own and is blended with those before it; as a mean of k frames has k times the VPLs, their discs shrink alike, so
    that the clamp's bias vanishes too. The first frame equals one from scratch always.
    """

    def __init__(self, launcher: Launcher, scene: Scene, device_scene: DeviceScene, plan: Plan) -> None:
        self.lights: VplSet | None = make_vpls(launcher, scene, device_scene, plan)
        self._frame = 0
        self._history: History | None = None

    @property
    def notices(self) -> tuple[Notice, ...]:
        """What could not be done in the last frame."""
        return self.lights.notices if self.lights is not None else ()

    def render(
        self, launcher: Launcher, scene: Scene, device_scene: DeviceScene, plan: Plan, *, with_before: bool
    ) -> Radiance:
        """The next frame; ``scene`` and ``plan`` may differ from the last one's in camera, picture size and plate.

        Args:
            with_before: Also render the real scene alone, to serve as the plate.
        """
        most = plan.settings.vpls_frames
        this = frame_plan(plan, self._frame)
        if self._frame > 0 and most > 1:
            self.lights = None  # free the last frame's maps first
            self.lights = make_vpls(launcher, scene, device_scene, this)
        assert self.lights is not None
        with launcher.scope("gbuffer"):
            buffer = render_gbuffer(
                launcher,
                device_scene,
                plan.width,
                plan.height,
                edge_samples=plan.settings.antialias,
                behind=with_before,
                paint=with_before or not scene.captured,
                seed=plan.settings.seed,
            )
        blender = None
        if most > 1 and (plan.changes or with_before):
            view = content_key(scene.camera, plan.width, plan.height, with_before)
            known = self._history if self._history is not None and self._history.with_before == with_before else None
            blender = Blender(launcher, known, buffer, view, with_before, device_scene.camera, most)
        shader = _Shader(launcher, scene, device_scene, self.lights, this, with_before, blender)
        radiance = shader.picture(buffer)
        self._history = blender.history() if blender is not None else None
        self._frame += 1
        return radiance


def frame_plan(plan: Plan, frame: int) -> Plan:
    """The plan with the random numbers of frame 0, 1 … of a shot, and discs for the VPLs of all frames up to it."""
    settings = plan.settings
    if frame == 0 or settings.vpls_frames == 1:
        return plan
    frames = min(frame + 1, settings.vpls_frames)
    seed = (settings.seed + SEED_STEP * frame) % 2**31
    return replace(plan, settings=replace(settings, seed=seed, vpls_clamp=settings.vpls_clamp / frames**0.5))


@dataclass(frozen=True)
class _Shader:
    """Shades what the camera sees in both solutions at once (eqs. 1-8): direct, reflections, VPLs, resolve."""

    launcher: Launcher
    scene: Scene
    device_scene: DeviceScene
    lights: VplSet
    plan: Plan
    with_before: bool
    blender: Blender | None

    def picture(self, buffer: GBuffer) -> Radiance:
        """Shade a G-buffer and average its points."""
        launcher = self.launcher
        light = launcher.zeros(buffer.count, wp.vec3)
        before = launcher.zeros(buffer.count if self.with_before else 1, wp.vec3)
        hidden_before = launcher.zeros(max(1, buffer.behind_count), wp.vec3)
        if self.plan.changes or self.with_before:
            self._shade_buffer(buffer, light, before)
            if self.with_before:
                self._shade_behind(buffer, hidden_before)
        with launcher.scope("resolve"):
            return resolve(
                launcher,
                self.device_scene,
                buffer,
                self.lights.env,
                light=light,
                before=before,
                behind_before=hidden_before,
                with_before=self.with_before,
            )

    def _shade_buffer(self, buffer: GBuffer, light: Any, before: Any) -> None:
        """Write the light of all points: after on synthetic ones, after - before on real ones, and before."""
        self._seen(buffer.points, buffer.count, light, before, (buffer.width, buffer.height))
        if self.blender is not None:
            self.blender.seen("light", light)
            self.blender.seen("before", before)
        with self.launcher.scope("vpl shading"):
            irradiance = light_picture(self.launcher, buffer, self._source)
            if self.blender is not None:
                self.blender.irradiance(*irradiance)
            self._reflect(buffer.points, buffer.count, irradiance, light, before)

    def _shade_behind(self, buffer: GBuffer, before: Any) -> None:
        """Write the light before of the real surfaces behind synthetic points."""
        points, count = buffer.behind, buffer.behind_count
        spare = self.launcher.zeros(max(1, count), wp.vec3)
        self._seen(points, count, spare, before)
        with self.launcher.scope("vpl shading"):
            irradiance = light_points(self.launcher, points, count, self._source)
            self._reflect(points, count, irradiance, spare, before)
        if self.blender is not None:
            self.blender.seen("behind", before)

    @property
    def _source(self) -> VplLight:
        return VplLight(
            self.device_scene, self.lights.vpls, self.lights.sight, self.plan.settings.vpls_tiles, self.with_before
        )

    def _seen(self, points: Any, count: int, light: Any, before: Any, size: tuple[int, int] = (0, 0)) -> None:
        """Write direct light and add glossy reflections, averaged over the pixels of a picture of ``size``."""
        with self.launcher.scope("direct"):
            self._direct(points, count, light, before)
        if self.plan.glossy and (self.plan.settings.bounces or self.lights.env.levels):
            with self.launcher.scope("glossy"):
                self._glossy(points, count, light, before, size)

    def _reflect(self, points: Any, count: int, irradiance: tuple[Any, Any], light: Any, before: Any) -> None:
        """Add diffusely reflected irradiance."""
        shade_indirect(
            self.launcher,
            points,
            count,
            irradiance,
            alpha_max=self.plan.alpha_max,
            light=light,
            before=before,
            with_before=self.with_before,
        )

    def _direct(self, points: Any, count: int, light: Any, before: Any) -> None:
        """Direct light of all but domes (eqs. 1-5)."""
        plan, settings = self.plan, self.plan.settings
        shown = plan.glossy and (settings.bounces or has_dome(self.scene.lights))
        rays = settings.glossy_rays if shown else 0
        direct = direct_settings(plan, glossy_rays=rays, with_before=self.with_before)
        if settings.shadow_maps == "single":
            shade_direct_single(
                self.launcher,
                self.device_scene,
                points,
                count,
                direct,
                self.lights.sight,
                self.lights.region.start,
                light=light,
                before=before,
            )
        else:
            shade_direct(self.launcher, self.device_scene, points, count, direct, light=light, before=before)

    def _glossy(self, points: Any, count: int, light: Any, before: Any, size: tuple[int, int]) -> None:
        plan, settings = self.plan, self.plan.settings
        glossy = specular.Glossy()
        glossy.rays, glossy.light_samples, glossy.seed = settings.glossy_rays, settings.shadows_samples, settings.seed
        glossy.alpha_max, glossy.again = plan.alpha_max, int(settings.bounces > 0)
        rank, index, found = find_glossy(self.launcher, points, count, plan.alpha_max)
        # What a reflection shows has made one bounce already: the last bounce's VPLs would be one too many.
        ends = self.lights.ends
        shown = replace(self._source, vpls=first_vpls(self.lights.vpls, ends[max(0, len(ends) - 2)]))
        smoothing = Smoothing(lobe_grid(rank, *size), settings.glossy_smoothing)
        shade_glossy(
            self.launcher, shown, self.lights.env, points, index, found, glossy, smoothing, out=light, before=before
        )


def first_vpls(vpls: Any, count: int) -> Any:
    """The first ``count`` of ``vpls``, on the same arrays."""
    fewer = Vpls()
    for name in Vpls.vars:
        setattr(fewer, name, getattr(vpls, name))
    fewer.count = count
    return fewer


def has_dome(lights: tuple[Light, ...]) -> bool:
    """Whether any light is a dome."""
    return any(light.kind == LightKind.DOME for light in lights)

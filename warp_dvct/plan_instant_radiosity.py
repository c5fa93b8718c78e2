"""The passes of differential instant radiosity: which a scene needs, why, and their memory."""

from __future__ import annotations

from warp_dvct.passes.vpl_memory import CLOUD_BYTES, VPL_BYTES, map_texels, surface_vpls, vpl_count
from warp_dvct.plan import LAYERED_PIXEL_BYTES, MAP_BYTES, POINT_BYTES, PassPlan
from warp_dvct.scene import LightKind, Scene
from warp_dvct.settings import Settings


def plan_passes(
    scene: Scene, settings: Settings, pixels: int, glossy: bool, changes: bool, has_plate: bool
) -> tuple[PassPlan, ...]:
    """Passes in the order in which they run.

    Args:
        pixels: Of the picture.
        glossy: Whether any material has a lobe that is traced by rays.
        changes: Whether anything is synthetic or any light is added.
        has_plate: Whether a plate is given.
    """
    idle = "nothing is synthetic and no light is added: the plate stays as it is"
    lit = changes or not has_plate
    dome = any(light.kind == LightKind.DOME for light in scene.lights)
    bounced = lit and settings.bounces > 0
    further = max(0, settings.bounces - 1)
    sky = settings.vpls_sky if dome else 0
    first = settings.vpls_count if settings.bounces else 0
    count = vpl_count(settings, dome=dome)
    needs_vpls = lit and count > 0
    no_vpls = idle if not lit else "bounces=0 and no dome: direct light only"
    maps = lit and settings.bounces > 0 and settings.visibility == "ism"
    cloud = maps or (bounced and further > 0)
    tiles = settings.vpls_tiles
    single = settings.shadow_maps == "single"
    pair = "one map of the front-most surface a light" if single else "a pair of maps a light, VPL3 behind blockers"
    return (
        PassPlan("gbuffer", True, "what the camera sees", int(1.2 * pixels * POINT_BYTES)),
        PassPlan(
            "rsm",
            bounced,
            f"{pair}, {settings.vpls_map}^2" if bounced else no_vpls,
            len(scene.lights) * settings.vpls_map**2 * (MAP_BYTES + 24),
        ),
        PassPlan(
            "vpls",
            needs_vpls,
            f"{sky} on the sky, {first} of the first bounce, {further} x {settings.vpls_further} of further ones"
            if needs_vpls
            else no_vpls,
            count * VPL_BYTES,
        ),
        PassPlan(
            "point cloud",
            cloud,
            f"{settings.ism_blocks} sets of {settings.ism_points} points" if cloud else "no maps and no further bounce",
            2 * settings.ism_points * settings.ism_blocks * CLOUD_BYTES,
        ),
        PassPlan(
            "ism",
            maps,
            f"2 x {settings.ism_size}^2 a VPL on surfaces" if maps else "exact rays instead" if needs_vpls else no_vpls,
            2 * 4 * surface_vpls(settings) * map_texels(settings.ism_size),
        ),
        PassPlan(
            "bounces",
            bounced and further > 0,
            f"{further} by the points of the cloud" if bounced and further else "a single bounce or none",
        ),
        PassPlan("direct", lit, f"{settings.shadows_samples} samples a light" if lit else idle, pixels * 24),
        PassPlan(
            "vpl shading",
            needs_vpls,
            f"1 VPL in {tiles**2} at a pixel, merged over {tiles} x {tiles}" if needs_vpls else no_vpls,
            pixels * 48,
        ),
        PassPlan(
            "history",
            lit and settings.vpls_frames > 1,
            f"mean of up to {settings.vpls_frames} frames while only the camera moves"
            if settings.vpls_frames > 1
            else "vpls.frames=1: each frame by itself",
            int(1.2 * pixels * (POINT_BYTES + 76)) if settings.vpls_frames > 1 else 0,
        ),
        PassPlan(
            "glossy",
            lit and glossy,
            "by rays" if lit and glossy else "no material has a specular lobe smoother than glossy.roughness",
        ),
        _before(settings, has_plate),
        PassPlan("composite", True, "layers and the finished picture", pixels * LAYERED_PIXEL_BYTES),
    )


def _before(settings: Settings, has_plate: bool) -> PassPlan:
    if not has_plate:
        return PassPlan("before", True, "no plate: the real scene is one")
    if settings.difference == "tonemapped":
        return PassPlan("before", True, "for the difference of tone-mapped solutions")
    also = "; rendered all the same where its file holds a display's codes" if settings.difference == "auto" else ""
    return PassPlan("before", False, "a plate is given" + also)

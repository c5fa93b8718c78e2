"""What a frame of instant radiosity costs: the counts of :mod:`warp_dvct.cost` for its passes."""

from __future__ import annotations

import math

from warp_dvct.cost import direct_work, draws, frame_work, tree_depth
from warp_dvct.cost_model import Counts
from warp_dvct.passes.vpl_memory import surface_vpls, vpl_count
from warp_dvct.settings import Settings
from warp_dvct.survey import Survey

# Passes that share a name with one of delta-cones but not its costs.
RENAMED = {"rsm": "vpl rsm", "bounces": "vpl bounces", "glossy": "vpl glossy"}


def count_vpl_work(settings: Settings, survey: Survey, width: int, height: int) -> dict[str, Counts]:
    """Counts by pass of an instant-radiosity frame, as :func:`warp_dvct.cost.count_work`."""
    pixels = width * height * 1e-6
    edges = settings.antialias * survey.outline * width * 1e-6
    passes = frame_work(survey, pixels, edges)
    if not (survey.changes or not survey.plate):
        return passes
    passes["direct"] = direct_work(settings, survey, pixels, edges)
    count = vpl_count(settings, dome=survey.dome) * 1e-6
    if settings.bounces > 0:
        maps = float(len(survey.maps))
        texels = maps * settings.vpls_map**2 * 1e-6
        passes["vpl rsm"] = {"maps": maps, "texels": texels, "texels deep": texels * tree_depth(survey)}
    if count <= 0.0:
        return passes
    further = max(0, settings.bounces - 1)
    points = 2.0 * settings.ism_points * settings.ism_blocks * 1e-6  # real and synthetic
    passes["vpls"] = {"frame": 1, "vpls": count}
    maps = surface_vpls(settings) * 1e-6 if settings.visibility == "ism" else 0.0
    if maps > 0.0 or further:
        passes["point cloud"] = {"frame": 1, "points": points, "triangles": survey.triangles * 1e-6}
    if maps > 0.0:
        splats, texels = 2.0 * maps * settings.ism_points, maps * settings.ism_size**2
        # A splat is as large as its point's share of the surface: all of them together cover the map.
        passes["ism"] = {"frame": 1, "maps": 1e6 * maps, "splats": splats, "texels": texels}
    if further:
        candidates = further * points
        passes["vpl bounces"] = {"maps": further, "points": candidates, "met": candidates * survey.met}
    passes["vpl shading"] = _shading(settings, survey, pixels, edges, count)
    if survey.roughness is not None:
        rays = sum(
            draws(settings.glossy_rays, settings, share * pixels, at_edge * edges)
            for share, at_edge in ((survey.sharp, survey.edge.sharp), (survey.blurred, survey.edge.blurred))
        )
        passes["vpl glossy"] = {
            "frame": 1,
            "rays": rays,
            "rays deep": rays * tree_depth(survey),
            "rays times vpls": rays * 1e6 * count,
        }
    return passes


def _shading(settings: Settings, survey: Survey, pixels: float, edges: float, count: float) -> Counts:
    """Pairs of points and VPLs: a tile's pixels share these out, each point then looks at all of its tile, and some
    points at edges take all.

    In a closed scene more VPLs of further bounces carry light; the more maps there are, the fewer of them caches hold.
    """
    hidden = 0.0 if survey.plate else survey.object * pixels + survey.edge.object * edges
    pairs = 1e6 * count * (pixels / settings.vpls_tiles**2 + hidden / settings.vpls_tiles)
    if settings.vpls_tiles == 1:
        pairs += 1e6 * count * edges
    alone = 1e6 * count * edges if settings.vpls_tiles > 1 else 0.0
    merged = (pixels + edges) * settings.vpls_tiles**2 if settings.vpls_tiles > 1 else 0.0
    return {
        "frame": 1,
        "points": pixels + edges,
        "merged": merged,
        "pairs": pairs,
        "pairs met": pairs * survey.met,
        "pairs met by root": pairs * survey.met * math.sqrt(1e6 * count),
        "edge pairs": alone,
    }

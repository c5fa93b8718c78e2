"""What a frame costs: counts of rays, voxels, texels and points known before it is rendered, times unit costs.

The counts, here, follow from the settings and the scene's survey alone; the unit costs are those of
:mod:`warp_dvct.cost_model`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

from warp_dvct.cost_cones import by_cones, gathered_by_cones, glossy_cones, shadow_cones
from warp_dvct.cost_model import Counts
from warp_dvct.gather_need import GatherNeed
from warp_dvct.passes.gather import GATHER_PARTS, HIDDEN, OBJECT_PARTS, REAL_PARTS, rays_of
from warp_dvct.pilot import VolumeNeed
from warp_dvct.settings import Settings
from warp_dvct.survey import MapNeed, PointNeed, Survey

REST = "rest"  # of a frame's time, what is in no pass
CHOOSING = "choosing"  # the search for settings
PROBE = "probe"  # work of a known amount, by which a plan sees how fast the machine is just now
# A point's first rays find less in the processor's caches than its later ones: 16, 64 and 256 rays a point took 1.27,
# 1.13 and 1.07 times as long each as many (mean of eight bundled stages, one thread).
FIRST_RAYS = 1.1


def count_work(settings: Settings, survey: Survey, width: int, height: int) -> dict[str, Counts]:
    """Counts by pass of a delta-cones frame, each ``unit: how many`` in millions; ``frame`` is 1.

    A pass that the scene does not need has no entry.
    """
    pixels = width * height * 1e-6
    edges = settings.antialias * survey.outline * width * 1e-6
    before = not survey.plate
    lit = survey.changes or before
    indirect = lit and settings.bounces > 0
    glossy = lit and survey.roughness is not None
    gathered = indirect or (lit and survey.dome)
    diffuse_cones, shadow_cone, glossy_cone = by_cones(settings)
    cones = (gathered and diffuse_cones) or (lit and shadow_cone) or (glossy and glossy_cone)
    passes = frame_work(survey, pixels, edges)
    if indirect or glossy or cones:
        volumes = _volumes(settings, survey, indirect)
        passes |= volumes
        records = volumes["voxelize"]["records"]
        passes[REST] |= {"records": records}  # to free them
        if cones:
            passes["voxelize"] |= {"records above": records / 3.0}  # a quarter as many at each level
            passes["pyramid"] = {"frame": 1, "records above": records / 3.0}
    if lit:
        passes["direct"] = (_direct_by_cones if shadow_cone else direct_work)(settings, survey, pixels, edges)
    if gathered:
        gather = _gather_by_cones if diffuse_cones else _gather
        passes["gather"] = gather(settings, survey, width, height, edges)
    if glossy:
        passes["specular"] = _specular(settings, survey, pixels, edges)
    return passes


def frame_work(survey: Survey, pixels: float, edges: float) -> dict[str, Counts]:
    """Counts of the passes that every method has; ``pixels`` and ``edges`` are points in millions."""
    triangles = survey.triangles * 1e-6
    return {
        "upload": {"frame": 1, "triangles": triangles},
        "gbuffer": {
            "frame": 1,
            "pixels": pixels,
            "edge points": edges,
            "rays deep": (pixels + edges) * tree_depth(survey),
        },
        "resolve": {"frame": 1, "points": pixels + edges},
        "composite": {"frame": 1, "pixels": pixels},
        REST: {"frame": 1, "pixels": pixels, "triangles": triangles},
    }


def count_survey(survey: Survey) -> Counts:
    """Of the survey itself."""
    return {"frame": 1, "triangles": survey.triangles * 1e-6, "lights": len(survey.maps)}


def tree_depth(survey: Survey) -> float:
    """Levels that a ray descends in the trees of real and of synthetic triangles."""
    return math.log2(2.0 + survey.real_triangles) + math.log2(2.0 + survey.synthetic_triangles)


def _volumes(settings: Settings, survey: Survey, indirect: bool) -> dict[str, Counts]:
    """Voxels, light maps, and further bounces."""
    sizes = [(survey.fine, settings.volume_resolution)]
    if survey.coarse is not None and settings.volume_coarse > 0:
        sizes.append((survey.coarse, settings.volume_coarse))
    records = 1e-6 * sum(need.records_at(n) for need, n in sizes)
    fragments = 1e-6 * sum(need.fragments_at(n) for need, n in sizes)
    triangles = survey.triangles * 1e-6
    passes: dict[str, Counts] = {
        "voxelize": {"frame": 1, "records": records, "fragments": fragments, "triangles": triangles},
        "light faces": {"frame": 1, "records": records},
    }
    if not indirect:
        return passes
    maps = float(len(survey.maps) * len(sizes))
    texels = 1e-6 * sum(_texels(need, settings, len(sizes)) for need in survey.maps)
    passes["rsm"] = {"maps": maps, "texels": texels, "texels deep": texels * tree_depth(survey)}
    passes["inject"] = {"maps": maps, "texels": texels, "records": records}
    if settings.bounces > 1:
        rays = 1e-6 * _patches(settings, survey, *sizes[-1]) * settings.patches_rays
        passes["bounces"] = {
            "frame": 1,
            "rays": rays,
            "met": rays * survey.met,
            "rays deep": rays * tree_depth(survey),
            "transfers": rays * (settings.bounces - 2),
            "faces": 1e-6 * sizes[-1][0].records_at(sizes[-1][1]),  # of the last volume, sorted into patches
            "records": records,
            "fragments": fragments,
        }
    return passes


def _texels(need: MapNeed, settings: Settings, volumes: int) -> float:
    """Of a light's maps, of the fine and of the coarse volume."""
    sizes = ((need.fine, settings.volume_resolution), (need.coarse, settings.volume_coarse))
    edges = (min(max(16, math.ceil(x * n * settings.rsm_density)), settings.rsm_texels) for x, n in sizes[:volumes])
    return sum(float(edge) ** 2 for edge in edges)


def _patches(settings: Settings, survey: Survey, need: VolumeNeed, n: int) -> float:
    """Patches of the level that ``passes.bounces.choose_patches`` takes: the next one holds a quarter."""
    records = need.records_at(n)
    while 2.0 * records > settings.patches_count and n > 1:
        records, n = 0.25 * records, (n + 1) // 2
    return records * survey.patches


def direct_work(settings: Settings, survey: Survey, pixels: float, edges: float) -> Counts:
    """The direct pass.

    Real points trace the samples that may meet an object, and most stop after the probes; objects' points trace the
    probes and, where these disagree, the rest.
    """
    depth = math.log2(2.0 + survey.synthetic_triangles)
    probes = draws(min(settings.shadows_probes, settings.shadows_samples), settings, pixels, edges)
    samples = draws(settings.shadows_samples, settings, pixels, edges)
    on_objects = survey.object * pixels, survey.edge.object * edges
    object_probes = draws(min(settings.shadows_probes, settings.shadows_samples), settings, *on_objects)
    object_samples = draws(settings.shadows_samples, settings, *on_objects)
    return {
        "frame": 1,
        "probes": probes * survey.lights,
        "near probes deep": survey.near * probes * depth,
        "near deep": survey.near * samples * depth,
        "object probes deep": object_probes * survey.lights * tree_depth(survey),
        "object deep": object_samples * survey.lights * tree_depth(survey),
        "before deep": 0.0 if survey.plate else samples * survey.lights * tree_depth(survey),
        "points": pixels + edges,
    }


def _direct_by_cones(settings: Settings, survey: Survey, pixels: float, edges: float) -> Counts:
    """Samples say how much light there is, one cone a light how much of it is left."""
    drawn = draws(settings.shadows_samples, settings, pixels, edges) * survey.lights
    real = survey.real * pixels + (1.0 - survey.edge.object) * edges
    cones = shadow_cones(settings, survey, real, survey.object * pixels + survey.edge.object * edges)
    return {"frame": 1, "points": pixels + edges, "drawn": drawn, **cones}


def draws(each: int, settings: Settings, pixels: float, edges: float) -> float:
    """Samples of all points: an edge pixel's centre draws all, and its edge points share them out."""
    shared = math.ceil(each / settings.antialias) if settings.antialias else 0
    return each * pixels + shared * edges


def _specular(settings: Settings, survey: Survey, pixels: float, edges: float) -> Counts:
    """Rays of sharp lobes end in a surface that is lit by every light; those of blurred ones in voxels."""
    points = (survey.sharp + survey.blurred) * pixels + (survey.edge.sharp + survey.edge.blurred) * edges
    if settings.glossy == "cones":
        return {"frame": 1, "points": points, **glossy_cones(settings, survey, points)}
    sharp = draws(settings.glossy_rays, settings, survey.sharp * pixels, survey.edge.sharp * edges)
    blurred = draws(settings.glossy_rays, settings, survey.blurred * pixels, survey.edge.blurred * edges)
    return {
        "frame": 1,
        "sharp": sharp,
        "sharp deep": sharp * tree_depth(survey) * (1 + len(survey.maps)),
        "blurred": blurred,
        "blurred deep": blurred * tree_depth(survey),
        "points": points,
    }


def _gather_by_cones(settings: Settings, survey: Survey, width: int, height: int, edges: float) -> Counts:
    """Cones of all gathered points; no detail is halved."""
    plain = replace(settings, gather_detail=0.0)
    points = gather_points(plain, survey, width, height)
    objects = sum(points[part] for part in OBJECT_PARTS)
    real = sum(points.values()) - objects
    pixels = width * height * 1e-6
    counts = gathered_by_cones(settings, survey, 1e-6 * real, 1e-6 * objects)
    return {"frame": 1, "points by cones": pixels + edges, **counts}


def _gather(settings: Settings, survey: Survey, width: int, height: int, edges: float) -> Counts:
    """Rays of all gathered points, and what is done with them."""
    pixels = width * height * 1e-6
    blocks = pixels / settings.gather_stride**2 + pixels / settings.gather_object_stride**2
    counts = {"frame": 1, "points": pixels + edges, "blocks": blocks, **gathered(survey, survey.on_real, 0.0, 1)}
    for part, points in gather_points(settings, survey, width, height).items():
        for unit, count in gather_part(settings, survey, part, points).items():
            counts[unit] += count
    return counts


def gather_points(settings: Settings, survey: Survey, width: int, height: int) -> dict[str, float]:
    """How many points are gathered by ``GATHER_PARTS``, in the order of the gather."""
    pixels, edges = float(width * height), settings.antialias * survey.outline * width
    detail, on_edges = settings.gather_detail, survey.edge.object * edges
    first, again, alone, at_edges = _points(survey.on_real.need, settings.gather_stride, width, height, detail)
    real = first, again, alone * survey.real * pixels + at_edges * (edges - on_edges)
    first, again, alone, at_edges = _points(survey.on_object.need, settings.gather_object_stride, width, height, detail)
    objects = first, again, alone * survey.object * pixels + at_edges * on_edges
    hidden = 0.0 if survey.plate else survey.object * pixels + on_edges
    return dict(zip(GATHER_PARTS, (*objects, *real, hidden), strict=True))


def gather_part(settings: Settings, survey: Survey, part: str, points: float) -> Counts:
    """Rays of ``points`` of one of ``GATHER_PARTS``, by what they cost."""
    real, rays = survey.on_real, rays_of(part, settings.gather_rays)
    if part == HIDDEN:
        return gathered(survey, real, points, rays, entered=real.entered_again)
    if part not in REAL_PARTS:
        return gathered(survey, survey.on_object, points, rays_of(part, settings.gather_object_rays))
    first = part == REAL_PARTS[0]
    entered, aimed, toward = real.entered, real.aimed, real.toward
    if not first:
        entered, aimed, toward = real.entered_again, real.aimed_again, real.toward_again
    # A share of the points sends fewer rays, and a part of them at the objects.
    few = int(rays * settings.gather_aimed) if survey.plate else 0
    far = points * aimed if few > 0 else 0.0
    counts = gathered(survey, real, points - far, rays, entered=entered)
    aimed_counts = gathered(survey, real, far, few * (1.0 + toward), entered=(entered + toward) / (1.0 + toward))
    return {unit: count + aimed_counts[unit] for unit, count in counts.items()}


def gathered(survey: Survey, where: PointNeed, points: float, rays: float, *, entered: float | None = None) -> Counts:
    """Rays of points by what they cost: all descend the real tree, some the synthetic one, some read voxels.

    Args:
        entered: Share of the rays that pass the objects' box, where it is not that of all points.
    """
    traced = 1e-6 * points * (rays + FIRST_RAYS * math.sqrt(rays))
    entered = where.entered if entered is None else entered
    return {
        "gathered": 1e-6 * points,
        "rays": traced,
        "met": traced * where.met,
        "real deep": traced * math.log2(2.0 + survey.real_triangles),
        "synthetic deep": traced * entered * math.log2(2.0 + survey.synthetic_triangles),
        "focused": traced * float(survey.focuses),
    }


@lru_cache(maxsize=512)
def _points(need: GatherNeed, stride: int, width: int, height: int, detail: float) -> tuple[float, float, float, float]:
    """``GatherNeed.points`` and ``alone``, which a search for settings asks for again and again."""
    return *need.points(stride, width, height, detail), *need.alone(stride, width, detail)

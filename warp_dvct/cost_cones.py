"""What cones take, for budgets in which ``gather``, ``shadows`` or ``glossy`` ask for them: steps of their marches."""

from __future__ import annotations

import math
from functools import lru_cache

from warp_dvct.cost_model import Counts
from warp_dvct.settings import Settings
from warp_dvct.survey import Survey

TYPICAL_COSINE = 2.0 / 3.0  # to the normal, of cones that share the cosine-weighted hemisphere out
HALF_OF_LOBE = 4.0  # aperture of a glossy cone over atan(alpha), see ``kernels.specular``
WIDEST, NARROWEST = 3.0, 1e-3  # radians of aperture
MIDWAY = 0.5  # of a volume's edge: about how far a march comes in it before it leaves or meets a wall


def by_cones(settings: Settings) -> tuple[bool, bool, bool]:
    """Whether diffuse light, shadows and reflections are found by cones."""
    return settings.gather == "cones", settings.shadows == "cone", settings.glossy == "cones"


def gathered_by_cones(settings: Settings, survey: Survey, real: float, objects: float) -> Counts:
    """Diffuse cones of points in millions on real surfaces and on objects (Franke 2014, eq. 6's first sum)."""
    aperture = math.radians(settings.cones_aperture)
    if aperture <= 0.0:
        aperture = 2.0 * math.acos(1.0 - min(0.5 / (settings.cones_count * TYPICAL_COSINE), 1.0))
    # In the paper's form a real surface without a plate is marched twice: with and without the objects.
    twice = 2.0 if settings.cones_delta == "split" and not survey.plate else 1.0
    each = float(settings.cones_count)
    steps = each * (twice * real * _steps(settings, survey, aperture, near=False))
    steps += each * objects * _steps(settings, survey, aperture, near=True)
    return {"cones": each * (real + objects), "steps": steps}


def shadow_cones(settings: Settings, survey: Survey, real: float, objects: float) -> Counts:
    """One cone from each point in millions to each light, as wide as the light (the paper's Cs)."""
    steps = 0.0
    for aperture in (max(need.aperture, NARROWEST) for need in survey.maps if need.aperture is not None):
        steps += real * _steps(settings, survey, aperture, near=False)
        steps += objects * _steps(settings, survey, aperture, near=True)
    return {"shadow cones": (real + objects) * survey.lights, "shadow steps": steps}


def glossy_cones(settings: Settings, survey: Survey, points: float) -> Counts:
    """One cone around the mirror direction of each point in millions, as wide as the lobe (eq. 6's second sum)."""
    alpha = (survey.roughness or 0.0) ** 2
    aperture = max(min(HALF_OF_LOBE * math.atan(alpha), WIDEST), NARROWEST)
    return {"cones": points, "steps": points * _steps(settings, survey, aperture, near=False)}


def _steps(settings: Settings, survey: Survey, aperture: float, *, near: bool) -> float:
    """Of one march through this scene's volumes; ``near``: from an object, in the fine volume."""
    coarse = survey.reach / settings.volume_coarse if survey.coarse is not None and settings.volume_coarse else 0.0
    spread = 2.0 * math.tan(0.5 * aperture) * settings.cones_detail
    return march_steps(1.0 / settings.volume_resolution, coarse, survey.reach, spread, settings.cones_step, near=near)


@lru_cache(maxsize=4096)
def march_steps(fine: float, coarse: float, reach: float, spread: float, step: float, *, near: bool) -> float:
    """Steps until about the middle of the scene, as ``kernels.cones.march_cone`` takes them.

    Args:
        fine, coarse: Edges of a voxel, in edges of the fine volume; ``coarse`` is 0 where there is no such volume.
        reach: Edge of the coarse volume. spread: Voxel edge over distance. step: In voxels of the level.
        near: Whether the march begins in the fine volume.
    """
    inner = MIDWAY if near or coarse == 0.0 else 0.0
    far = max(MIDWAY * reach, inner) if coarse > 0.0 else inner
    at, steps = 0.0, 0
    while at < far:
        voxel = fine if at < inner else coarse
        width = max(spread * at, fine)
        at += step * voxel * 2.0 ** max(0, math.floor(math.log2(width / voxel)))
        steps += 1
    return float(steps)

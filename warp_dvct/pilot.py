"""The small picture that a survey renders: what the objects change in it, by how much, and how noisy that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kept import Kept
from warp_dvct.launch import Launcher
from warp_dvct.layers import Layers
from warp_dvct.methods import delta_cone_tracing
from warp_dvct.methods.light_field import light_volumes
from warp_dvct.metrics import affected_mask, smooth_delta, to_display
from warp_dvct.passes.composite import composite
from warp_dvct.passes.gather import glossy_hits
from warp_dvct.passes.voxels import Voxels
from warp_dvct.passes.vpls import LUMINANCE
from warp_dvct.plan import Plan, make_plan
from warp_dvct.scene import Scene
from warp_dvct.settings import make_settings

WIDTH = 80
FRAGMENTS_PER_RECORD = 1.15  # of triangles larger than voxels
ALL_BOUNCES = 8  # as the truths that errors are measured against
FLIP_POWER = 0.7  # of a pixel's difference in colour that LDR-FLIP takes (Andersson et al. 2020, "FLIP", section 4.1)
COARSE = {
    "bounces": ALL_BOUNCES,
    "antialias": 0,
    "volume.resolution": 32,
    "volume.coarse": 32,
    "rsm.texels": 96,
    "rsm.density": 1,
    "shadows.samples": 4,
    "shadows.probes": 4,
    "gather.rays": 16,
    "gather.aimed": 0,  # the same rays with the light before as without: their noise cancels in differences
    "gather.object_rays": 16,
    "gather.stride": 4,
    "gather.object_stride": 2,
    "glossy.rays": 2,
    "patches.count": 2400,
    "patches.rays": 4,
}


@dataclass(frozen=True)
class VolumeNeed:
    """What a volume held when it had ``n`` voxels an edge: voxels with surface, and pieces of triangles in them."""

    n: int
    records: int
    fragments: int

    def records_at(self, n: int) -> float:
        """Voxels that hold surface go by the square of those along an edge."""
        return self.records * (n / self.n) ** 2

    def fragments_at(self, n: int) -> float:
        """Pieces of triangles: inside of a voxel one each; across voxels' borders by the voxels along an edge; of what
        is larger than a voxel by the voxels' number."""
        more = self.records_at(n) - self.records
        small = max(self.fragments - FRAGMENTS_PER_RECORD * self.records, 0.0)
        return max(self.fragments + FRAGMENTS_PER_RECORD * more + 0.01 * small * (n - self.n), self.records_at(n))


@dataclass(frozen=True)
class PictureNeed:
    """What the picture shows; see :class:`warp_dvct.survey.Survey`. All is 0 where nothing changes."""

    affected: float = 0.0
    change: float = 0.0
    shown: float = 0.0
    noise: float = 0.0
    outlined: float = 0.0
    later: float = 0.0
    decay: float = 0.0


@dataclass(frozen=True)
class Pilot:
    """The coarse picture and its volumes. ``layers`` is None where nothing changes; the others as in ``Survey``."""

    fine: VolumeNeed
    coarse: VolumeNeed | None
    patches: float
    picture: PictureNeed
    layers: Layers | None
    shape: tuple[int, int]
    focuses: bool

    def changed(self, least: float) -> np.ndarray:
        """Pixels whose light changes by more than a share ``least`` of it, bool ``[h, w]``."""
        if self.layers is None or least <= 0.0:
            return np.ones(self.shape, bool)
        # Fewer rays see a small change in fewer places: half of it counts.
        size = np.abs(self.layers.delta).max(-1) >= 0.5 * least * self.layers.plate.max(-1)
        return size | (self.layers.mask_synthetic > 0.0)


def plan_pilot(scene: Scene, height: int, settings: Mapping[str, Any]) -> Plan:
    """Of the small picture, with ``settings`` over ``COARSE``."""
    return make_plan(scene, make_settings("balanced", {**COARSE, **settings}), "delta-cones", WIDTH, height)


def make_pilot(
    scene: Scene, device_scene: DeviceScene, launcher: Launcher, plan: Plan, once: Plan, again: Plan
) -> Pilot:
    """Volumes of few voxels, and pictures that say how much the objects change, how much of it comes after one bounce,
    and how much is noise.

    Args:
        once: ``plan`` with a single bounce. again: ``plan`` with another seed.
    """
    kept = Kept()
    lit = light_volumes(launcher, scene, device_scene, plan, kept)
    needs = [VolumeNeed(v.box.n, v.level_records[0], v.fragments.count) for v in lit.volumes]
    fine = needs[0] if needs else VolumeNeed(plan.fine.n, 0, 0)
    patches = 0.0
    if lit.bounces.present:
        records = lit.volumes[-1].level_records[lit.bounces.level]
        patches = lit.bounces.irradiance.shape[0] // 2 / max(records, 1)  # before and after
    focusing = glossy_hits(launcher, scene, device_scene, lit.bounces, 0) is not None
    coarse = needs[1] if len(needs) > 1 else None
    shape, picture, layers = (plan.height, plan.width), PictureNeed(), None
    if plan.changes:
        radiance = delta_cone_tracing.render(
            launcher, scene, device_scene, lambda: lit, plan, with_before=True, kept=kept
        )
        layers = composite(launcher, radiance, None)
        first = light_volumes(launcher, scene, device_scene, once, kept)
        others = []
        for light, other in ((first, once), (lit, again)):
            radiance = delta_cone_tracing.render(
                launcher, scene, device_scene, lambda light=light: light, other, with_before=False, kept=kept
            )
            others.append(composite(launcher, radiance, layers.plate).comp)
        picture = _compare(layers, *others, decay=_decay(_light(lit.volumes), _light(first.volumes)))
    return Pilot(fine, coarse, patches, picture, layers, shape, focusing)


def _compare(layers: Layers, first: np.ndarray, again: np.ndarray, *, decay: float) -> PictureNeed:
    """Of the picture, of one with a single bounce and of one by other random numbers."""
    mask = affected_mask(smooth_delta(layers.delta, layers.mask_synthetic), layers.mask_synthetic)
    level = float(np.abs(layers.comp).mean())
    counts = mask.any() and level > 0.0
    return PictureNeed(
        affected=float(mask.mean()) if counts else 0.0,
        change=float(np.abs(layers.comp - layers.plate)[mask].mean()) / level if counts else 0.0,
        shown=_difference(layers.comp, layers.plate),
        noise=_difference(layers.comp, again),
        outlined=_outlined(layers),
        later=_difference(layers.comp, first),
        decay=decay,
    )


def _difference(picture: np.ndarray, other: np.ndarray) -> float:
    """About what LDR-FLIP says, over a constant: the mean of its power of the change in display luma."""
    return float(((np.abs(to_display(picture) - to_display(other)) @ LUMINANCE) ** FLIP_POWER).mean())


def _outlined(layers: Layers) -> float:
    """See ``Survey.outlined``."""
    change = (to_display(layers.comp) - to_display(layers.plate)) @ LUMINANCE
    steps = 0.0
    for axis in (0, 1):
        edge = np.abs(np.diff(layers.mask_synthetic, axis=axis)) > 0.5
        steps += float((np.abs(np.diff(change, axis=axis))[edge] ** FLIP_POWER).sum())
    return steps / len(change)


def _light(volumes: Sequence[Voxels]) -> float:
    """Flux that leaves the surfaces after, in arbitrary units."""
    total = 0.0
    for voxels in volumes:
        count = voxels.level_records[0]
        field = voxels.field()[:count]
        total += float(field[:, :, 1, :3].sum(dtype=np.float64)) * voxels.box.voxel**2
    return total


def _decay(every: float, first: float) -> float:
    """The ratio of the geometric series of ``ALL_BOUNCES`` terms whose sum over its first term is ``every / first``."""
    low, high = 0.0, 1.0
    for _ in range(20):
        ratio = 0.5 * (low + high)
        less = sum(ratio**k for k in range(ALL_BOUNCES)) * first < every
        low, high = (ratio, high) if less else (low, ratio)
    return low

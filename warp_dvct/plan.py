"""Scene + settings → plan: what will be modelled, in what box, at what size, and what is left out and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from warp_dvct.frame import VolumeFrame, share_beyond, volume_frame
from warp_dvct.passes.voxels import Box, level_bricks
from warp_dvct.scene import Light, LightKind, LightRole, Role, Scene
from warp_dvct.settings import Settings

COARSE_MARGIN = 1.02  # the coarse volume is this much larger than what it holds, so that no wall lies on its border
MOST_BEYOND = 0.05  # share of the directions around the objects that may meet surfaces left out of the volumes
MAP_BYTES = 80  # of a texel of an RSM pair
RECORD_BYTES = 12 * 16
TRIANGLES_AT_ONCE = 2**13
POINT_BYTES = 120
LAYERED_PIXEL_BYTES = 100  # of the finished layers and what they are made of
TRACED_PIXEL_BYTES = 168  # of path tracing: float64 sums, and the picture with its guides


@dataclass(frozen=True)
class PassPlan:
    """One pass: whether it runs, why (or why not), and about how many bytes it keeps."""

    name: str
    needed: bool
    why: str
    bytes: int = 0


@dataclass(frozen=True)
class MapPlan:
    """The reflective shadow maps of one light.

    Attributes:
        light: Index into the scene's lights. path: Its prim.
        shape: How directions are spread: ``sphere``, ``cap``, ``perspective``, ``hemisphere`` or ``orthographic``.
        size, coarse_size: Texels an edge of the map for the fine and the coarse volume.
        pair: Whether the synthetic objects can be in its light, so that after and before differ.
        limited: Whether ``rsm.texels`` made the map coarser than the voxels.
    """

    light: int
    path: str
    shape: str
    size: int
    coarse_size: int
    pair: bool
    limited: bool


@dataclass(frozen=True)
class Plan:
    """What a method will do. Boxes are in volume space, whose unit is the fine volume's edge.

    Attributes:
        origin, scale: Volume space is ``(world - origin) * scale``, metres.
        fine, coarse: The volumes; ``coarse`` is None where the fine one holds the whole scene.
        start: Distance, in volume space, from which parallel light starts.
        maps: Per light.
        glossy: Whether any material has a lobe that the specular pass treats.
        changes: Whether anything is synthetic or any light is added; if not, the plate stays as it is.
        passes: In the order in which they run.
    """

    method: str
    settings: Settings
    width: int
    height: int
    origin: tuple[float, float, float]
    scale: float
    fine: Box
    coarse: Box | None
    start: float
    maps: tuple[MapPlan, ...]
    glossy: bool
    changes: bool
    passes: tuple[PassPlan, ...]

    @property
    def alpha_max(self) -> float:
        """Roughest GGX alpha that the specular pass treats; -1 where it does not run."""
        return self.settings.glossy_roughness**2 if self.glossy else -1.0

    def describe(self) -> str:
        """A table for people: each pass needed or left out, why, and its memory."""
        edge = 1.0 / self.scale
        lines = [
            f"method {self.method}, {self.width} x {self.height} pixels",
            f"fine volume: {self.fine.n}^3, edge {edge:.4g} m, voxel {edge / self.fine.n * 1e3:.4g} mm",
        ]
        if self.coarse is not None:
            size = self.coarse.edge * edge
            lines.append(
                f"coarse volume: {self.coarse.n}^3, edge {size:.4g} m, voxel {size / self.coarse.n * 1e3:.4g} mm"
            )
        width = max(len(p.name) for p in self.passes)
        for p in self.passes:
            state = "needed  " if p.needed else "left out"
            memory = f"{p.bytes / 2**20:8.1f} MiB" if p.needed else " " * 12
            lines.append(f"  {p.name:<{width}}  {state}  {memory}  {p.why}")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """The plan as JSON-ready values."""
        return asdict(self)


def make_plan(
    scene: Scene, settings: Settings, method: str, width: int, height: int, *, has_plate: bool = False
) -> Plan:
    """Decide, on the host and before any kernel runs, what the picture needs.

    Args:
        method: ``delta-cones``, ``instant-radiosity`` or ``path-trace``.
        has_plate: Whether a plate will be given; without one the picture before is rendered as well.
    """
    synthetic = scene.bounds(Role.SYNTHETIC)
    added = any(light.role == LightRole.ADDED for light in scene.lights)
    frame = volume_frame(scene, settings.volume_scale)
    origin, scale = frame.origin, 1.0 / frame.edge
    coarse = _coarse_box(scene, frame, settings)
    across = float(np.linalg.norm(frame.high - frame.low))
    fine = Box(_corner(frame.fine), 1.0, settings.volume_resolution)
    maps = tuple(_plan_map(i, x, origin, scale, fine, coarse, synthetic, settings) for i, x in enumerate(scene.lights))
    glossy = _is_glossy(scene, settings)
    changes = synthetic is not None or added
    if method == "path-trace":
        why = f"{settings.samples} samples a pixel, {settings.bounces} bounces"
        passes = (
            PassPlan("path trace", True, why, width * height * TRACED_PIXEL_BYTES),
            PassPlan("composite", True, "layers and the finished picture", width * height * LAYERED_PIXEL_BYTES),
        )
    elif method == "instant-radiosity":
        from warp_dvct.plan_instant_radiosity import plan_passes

        passes = plan_passes(scene, settings, width * height, glossy, changes, has_plate)
    else:
        held = _volume_bytes(scene, [fine] if coarse is None else [fine, coarse], scale, origin)
        passes = _passes(scene, settings, width * height, held, maps, glossy, changes, has_plate)
    return Plan(
        method,
        settings,
        width,
        height,
        _corner(origin),
        scale,
        fine,
        coarse,
        min(across + 1.0, 1e4),
        maps,
        glossy,
        changes,
        passes,
    )


def for_plate(plan: Plan, scene: Scene, has_plate: bool) -> Plan:
    """The plan of the same picture where a plate will be given, or will not."""
    if plan.method != "delta-cones":
        return make_plan(scene, plan.settings, plan.method, plan.width, plan.height, has_plate=has_plate)
    pixels = plan.width * plan.height
    held = next(p.bytes for p in plan.passes if p.name == "voxelize")  # all triangles would have to be looked at
    passes = _passes(scene, plan.settings, pixels, held, plan.maps, plan.glossy, plan.changes, has_plate)
    return replace(plan, passes=passes)


def _coarse_box(scene: Scene, frame: VolumeFrame, settings: Settings) -> Box | None:
    """The cube around the scene, cut to ``volume.reach``; None where the fine volume holds everything.

    What is left out reflects nothing. Of an open ground that is a line at the horizon; of the room around a small
    object it would be all its walls: as long as too much is left out, the reach is doubled.
    """
    low, high, middle = frame.low, frame.high, frame.middle
    if settings.volume_coarse == 0 or (np.all(low >= frame.fine) and np.all(high <= frame.fine + 1.0)):
        return None
    half = 0.5 * settings.volume_reach
    while (np.any(low < middle - half) or np.any(high > middle + half)) and (
        share_beyond(scene, frame.origin + middle * frame.edge, half * frame.edge) > MOST_BEYOND
    ):
        half *= 2.0
    low, high = np.maximum(low, middle - half), np.minimum(high, middle + half)
    edge = COARSE_MARGIN * max(float(np.max(high - low)), 1.0)
    return Box(_corner(0.5 * (low + high) - 0.5 * edge), edge, settings.volume_coarse)


def _corner(point: np.ndarray) -> tuple[float, float, float]:
    return float(point[0]), float(point[1]), float(point[2])


def _plan_map(
    index: int,
    light: Light,
    origin: np.ndarray,
    scale: float,
    fine: Box,
    coarse: Box | None,
    synthetic: Any,
    settings: Settings,
) -> MapPlan:
    shape, wanted = _texels(light, origin, scale, fine)
    limit = settings.rsm_texels
    size = min(max(16, math.ceil(wanted * settings.rsm_density)), limit)
    coarse_size = 0
    if coarse is not None:
        coarse_size = min(max(16, math.ceil(_texels(light, origin, scale, coarse)[1] * settings.rsm_density)), limit)
    pair = synthetic is not None and _lights_box(light, *synthetic)
    return MapPlan(index, light.path, shape, size, coarse_size, pair, wanted * settings.rsm_density > limit)


def _texels(light: Light, origin: np.ndarray, scale: float, box: Box) -> tuple[str, float]:
    """Shape of a light's map, and the edge at which a texel at the volume's far side is as large as a voxel."""
    radius = box.edge * math.sqrt(3.0) / 2.0
    if light.kind in (LightKind.DISTANT, LightKind.DOME):
        return "orthographic", math.sqrt(math.pi) * radius / box.voxel
    center = np.asarray(box.low) + 0.5 * box.edge
    distance = float(np.linalg.norm((np.asarray(light.position) - origin) * scale - center))
    far = (distance + radius) / box.voxel
    bound = radius + scale * (light.radius + np.linalg.norm(light.axis_x) + np.linalg.norm(light.axis_y))
    cap = 2.0 if distance <= bound else 1.0 - math.sqrt(1.0 - (bound / distance) ** 2)
    if light.kind in (LightKind.RECT, LightKind.DISK):
        if cap < 0.5:
            return "cap", math.sqrt(2.0 * math.pi * cap) * far
        return "hemisphere", math.sqrt(math.pi) * far
    spot = 1.0 - math.cos(light.cone_angle) if light.cone_angle < math.pi else 2.0
    if spot < cap:
        return "perspective", math.sqrt(2.0 * math.pi * spot) * far
    return ("sphere" if cap == 2.0 else "cap"), math.sqrt(2.0 * math.pi * cap) * far


def _lights_box(light: Light, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether a box can be in a light's beam; true where in doubt."""
    if light.kind in (LightKind.DISTANT, LightKind.DOME):
        return True
    center, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    toward = center - np.asarray(light.position)
    distance = float(np.linalg.norm(toward))
    bound = radius + light.radius + float(np.linalg.norm(light.axis_x) + np.linalg.norm(light.axis_y))
    if distance <= bound:
        return True
    angle = math.acos(float(np.clip(np.dot(toward, light.direction) / distance, -1.0, 1.0)))
    limit = light.cone_angle
    if light.kind in (LightKind.RECT, LightKind.DISK):
        limit = min(limit, 0.5 * math.pi)
    return limit >= math.pi or angle <= limit + math.asin(bound / distance)


def _is_glossy(scene: Scene, settings: Settings) -> bool:
    used = {int(i) for mesh in scene.meshes for i in np.unique(mesh.materials)}
    for index in used:
        material = scene.materials[index]
        if material.reflects and (
            material.roughness_texture is not None or material.roughness <= settings.glossy_roughness
        ):
            return True
    return False


def surface_areas(scene: Scene, boxes: Sequence[Box], scale: float, origin: np.ndarray) -> list[float]:
    """About the surface inside of each volume, in volume space; a triangle that crosses a border counts up to twice
    the area of a side."""
    areas = [0.0 for _ in boxes]
    for mesh in scene.meshes:
        # Coordinates apart ([3, t]): three times as fast as [t, 3]. This runs for every frame, on blocks of triangles
        # whose arrays the processor's caches hold.
        points = np.ascontiguousarray(((mesh.points - origin) * scale).T)
        found = np.zeros((len(boxes), 3))
        for start in range(0, len(mesh.triangles), TRIANGLES_AT_ONCE):
            triangles = mesh.triangles[start : start + TRIANGLES_AT_ONCE]
            a, b, c = (np.take(points, triangles[:, k], axis=1) for k in range(3))
            low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
            u, v = b - a, c - a
            cross = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
            size = 0.5 * np.sqrt(cross[0] ** 2 + cross[1] ** 2 + cross[2] ** 2)
            for k, box in enumerate(boxes):
                found[k] += _inside(size, (a + b + c) / 3.0, low, high, box)
        for k, (whole, cut, crossing) in enumerate(found):
            areas[k] += whole + min(cut, 2.0 * boxes[k].edge ** 2 * crossing)
    return areas


def _inside(
    size: np.ndarray, middle: np.ndarray, low: np.ndarray, high: np.ndarray, box: Box
) -> tuple[float, float, int]:
    """Area of the triangles whose middle is inside, area of those that cross a border besides, and how many these are.

    Args:
        size: Areas, ``[t]``. middle, low, high: Of each triangle, ``[3, t]``.
    """
    first = np.asarray(box.low)[:, None]
    last = first + box.edge
    if np.all(low.min(1, keepdims=True) >= first) and np.all(high.max(1, keepdims=True) <= last):
        return float(size.sum()), 0.0, 0
    if np.any(low.min(1, keepdims=True) > last) or np.any(high.max(1, keepdims=True) < first):
        return 0.0, 0.0, 0
    inside = np.all((middle >= first) & (middle <= last), 0)
    crossing = ~inside & np.all(low <= last, 0) & np.all(high >= first, 0)
    return float(size[inside].sum()), float(size[crossing].sum()), int(crossing.sum())


def _volume_bytes(scene: Scene, boxes: Sequence[Box], scale: float, origin: np.ndarray) -> int:
    """About what lit volumes keep: records for the surface inside, and the bricks around them."""
    total = 0
    for box, area in zip(boxes, surface_areas(scene, boxes, scale, origin), strict=True):
        records = 1.5 * area / box.voxel**2 * 4.0 / 3.0
        bricks = records / 64.0
        total += int(records * RECORD_BYTES + bricks * 2048 + 4 * sum(level_bricks(box.n, k) ** 3 for k in range(1)))
    return total


def _passes(
    scene: Scene,
    settings: Settings,
    pixels: int,
    volume_bytes: int,
    maps: tuple[MapPlan, ...],
    glossy: bool,
    changes: bool,
    has_plate: bool,
) -> tuple[PassPlan, ...]:
    idle = "nothing is synthetic and no light is added: the plate stays as it is"
    lit = changes or not has_plate
    indirect = lit and settings.bounces > 0
    dome = any(light.kind == LightKind.DOME for light in scene.lights)
    no_indirect = idle if not lit else "bounces=0 and no dome: direct light only"
    gathered = indirect or (lit and dome)
    cones = (
        (gathered and settings.gather == "cones")
        or (lit and settings.shadows == "cone")
        or (lit and glossy and settings.glossy == "cones")
    )
    needs_volume = indirect or cones or (lit and glossy)
    passes = [
        PassPlan("gbuffer", True, "what the camera sees", int(1.2 * pixels * POINT_BYTES)),
        PassPlan(
            "voxelize",
            needs_volume,
            "real and synthetic surfaces" if needs_volume else no_indirect,
            volume_bytes,
        ),
    ]
    for m in maps:
        why = f"{m.shape} of directions, {m.size}^2" + (f" and {m.coarse_size}^2" if m.coarse_size else "")
        why += "" if m.pair else "; no synthetic object in its light: before and after are one map"
        why += "; rsm.texels keeps texels larger than voxels" if m.limited else ""
        biggest = max(m.size, m.coarse_size)
        passes.append(PassPlan(f"rsm {m.path}", indirect, why if indirect else no_indirect, biggest**2 * MAP_BYTES))
    more = indirect and settings.bounces > 1
    passes += [
        PassPlan(
            "bounces",
            more,
            f"{settings.bounces - 1} re-injections by about {settings.patches_count} patches"
            if more
            else "a single bounce was asked for",
            settings.patches_count * (settings.patches_rays * 8 + 100) if more else 0,
        ),
        PassPlan("pyramid", cones, "cones read it" if cones else "no cones: rays read level 0 alone"),
        PassPlan(
            "direct",
            lit,
            f"shadow {settings.shadows}s, {settings.shadows_samples} samples a light" if lit else idle,
            pixels * 24,
        ),
        PassPlan(
            "gather",
            gathered,
            f"{settings.gather} at 1 in {settings.gather_stride**2} pixels" if gathered else no_indirect,
            pixels * 48,
        ),
        PassPlan(
            "specular",
            lit and glossy,
            f"by {settings.glossy}"
            if lit and glossy
            else "no material has a specular lobe smoother than glossy.roughness",
        ),
        PassPlan(
            "before",
            not has_plate,
            "no plate: the real scene is rendered as one" if not has_plate else "a plate is given",
        ),
        PassPlan("composite", True, "layers and the finished picture", pixels * LAYERED_PIXEL_BYTES),
    ]
    return tuple(passes)

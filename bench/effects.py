"""Each effect by each method: the error of the change that the objects make, and its cost; pictures of failures."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.bench.delta_error import FORMS
from warp_dvct.bench.error import read, stage_file
from warp_dvct.bench.pictures import codes, heat
from warp_dvct.bench.references import Reference, ReferenceStore, combine
from warp_dvct.bench.scaling import ball
from warp_dvct.errors import FileError, OptionError
from warp_dvct.launch import Launcher
from warp_dvct.metrics import flip_ldr, import_flip, region_masks, smooth_delta, to_display
from warp_dvct.scene import LightKind, Role, Scene

KIND = "effects"
WALL = 0.1  # metres from thin_wall's wall in which a gather point of a neighbouring pixel may lie in the other room


@dataclass(frozen=True)
class Effect:
    """One effect, shown alone as far as a scene can.

    Attributes:
        bounces: Of truth and methods: 0 shows direct light and skies, 1 one bounce.
        region: Of ``metrics.REGIONS``, or ``changed``: all real pixels that change.
        make: The bundled stage's scene to the effect's.
    """

    name: str
    stage: str
    bounces: int
    region: str
    make: Callable[[Scene], Scene] = lambda scene: scene


def _small_light(scene: Scene) -> Scene:
    """Area lights of 2 cm with the power they had: shadows with hard edges."""
    lights = []
    for light in scene.lights:
        edge = 2.0 * max(float(np.linalg.norm(light.axis_x)), 1e-9)
        shrink = 0.02 / edge
        axes = {k: tuple(shrink * v for v in getattr(light, k)) for k in ("axis_x", "axis_y")}
        lights.append(replace(light, **axes, radiance=tuple(v / shrink**2 for v in light.radiance)))
    return replace(scene, lights=tuple(lights))


def _mirror_floor(scene: Scene) -> Scene:
    materials = [replace(m, roughness=0.0, metallic=1.0) if m.name.endswith("Floor") else m for m in scene.materials]
    return replace(scene, materials=tuple(materials))


def _sky_alone(scene: Scene) -> Scene:
    return replace(scene, lights=tuple(x for x in scene.lights if x.kind == LightKind.DOME))


def _small_objects(scene: Scene) -> Scene:
    """A ball of 12 cm on the floor, and one far from it under the ceiling: the volume is large, a ball a few voxels."""
    real = tuple(m for m in scene.meshes if m.role == Role.REAL)
    material = int(next(m for m in scene.meshes if m.role == Role.SYNTHETIC).materials[0])
    places = (np.array([0.2, 0.06, -0.4]), np.array([1.6, 2.0, -1.6]))
    balls = tuple(ball(place, 0.06, 2000, material) for place in places)
    return replace(scene, meshes=(*real, *balls))


EFFECTS = (
    Effect("hard shadow", "room_area", 0, "shadow", _small_light),
    Effect("soft shadow", "room_area", 0, "shadow"),
    Effect("diffuse bounce", "room_area", 1, "bounce"),
    Effect("glossy", "room_glossy", 1, "reflection"),
    Effect("mirror", "room_glossy", 1, "reflection", _mirror_floor),
    Effect("blocked sky", "ground_dome", 0, "changed", _sky_alone),
    Effect("small objects", "room_area", 1, "changed", _small_objects),
)
THIN_WALLS = "thin walls"
LEAK_STOPS = 3.0  # a leak of some percent shows then
LEAK_PANELS = ("path-trace, 16 spp", "delta-cones", "gather=cones")
PAPER = {"shadows": "cone", "gather": "cones", "glossy": "cones", **FORMS["paper"]}
METHODS: dict[str, tuple[str, dict[str, str]]] = {
    "delta-cones": ("delta-cones", {}),
    "gather=cones": ("delta-cones", {"gather": "cones"}),
    "the paper's form": ("delta-cones", PAPER),
    "instant-radiosity": ("instant-radiosity", {}),
    "path-trace, 16 spp": ("path-trace", {"samples": "16", "seed": "77"}),
}
# Failure: effect, method of METHODS or a setting, stops that make it visible.
FAILURES: dict[str, tuple[str, str, dict[str, str], float]] = {
    "shadow_cone": ("hard shadow", "delta-cones", {"shadows": "cone"}, 0.0),
    "paper_bounce": ("diffuse bounce", "the paper's form", {}, 0.0),
    "vpls": ("diffuse bounce", "instant-radiosity", {}, 0.0),
    "glossy_cone": ("glossy", "delta-cones", {"glossy": "cones"}, 0.0),
    "focused_light": ("glossy", "delta-cones", {}, 0.0),
    "few_samples": ("diffuse bounce", "path-trace, 16 spp", {"samples": "4"}, 0.0),
    "small_objects": ("small objects", "delta-cones", {"shadows": "cone"}, 0.0),
}


@dataclass(frozen=True)
class EffectOptions:
    """What is measured; the fields are the command's flags. ``samples`` are of the truth, in two independent parts."""

    effects: tuple[str, ...] = ()
    quality: str = "balanced"
    width: int = 320
    samples: int = 128
    seed: int = 1
    cache: Path = Path()
    images: Path | None = None
    device: str = "cpu"
    threads: int | None = None


@dataclass
class _Stage:
    """An effect's scene with its truth in two independent parts."""

    effect: Effect
    options: EffectOptions
    scene: Scene
    parts: tuple[Reference, Reference]
    region: np.ndarray
    pictures: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def plate(self) -> np.ndarray:
        return 0.5 * (self.parts[0].before + self.parts[1].before)

    @property
    def truth(self) -> np.ndarray:
        """The composite of both parts' mean."""
        a, b = self.parts
        return combine(self.plate, 0.5 * (a.delta + b.delta), 0.5 * (a.synthetic + b.synthetic))


def measure(
    options: EffectOptions, report: Callable[[dict[str, Any]], None] = lambda row: None
) -> list[dict[str, Any]]:
    """A row per effect and method; with ``images``, pictures of each failure as well.

    Raises:
        OptionError: An unknown effect, or a size or number of samples that is too small.
    """
    import_flip()
    names = [*(e.name for e in EFFECTS), THIN_WALLS]
    for name in options.effects:
        if name not in names:
            raise OptionError(f"there is no effect '{name}'; choose from {', '.join(names)}")
    if options.width < 32 or options.samples < 2:
        raise OptionError("--width is at least 32 and --spp at least 2: the truth is traced in two parts")
    launcher = Launcher(options.device, options.threads)
    rows: list[dict[str, Any]] = []

    def add(row: dict[str, Any]) -> None:
        rows.append({"kind": KIND, "quality": options.quality, "width": options.width, **row})
        report(rows[-1])

    for effect in EFFECTS:
        if options.effects and effect.name not in options.effects:
            continue
        stage = _prepare(effect, options, launcher)
        for name, (method, settings) in METHODS.items():
            comp, stats = _render(stage, method, settings)
            add({"effect": effect.name, "method": name, **_figures(stage, comp), "cpu_seconds": stats["cpu_seconds"]})
        if options.images is not None:
            _draw_failures(stage, options.images)
    if not options.effects or THIN_WALLS in options.effects:
        plates: dict[str, np.ndarray] = {}
        for name, (method, settings) in METHODS.items():
            figures, before = _leak(method, settings, options)
            add({"effect": THIN_WALLS, "method": name, **figures})
            plates[name] = before
        if options.images is not None:
            shown = [to_display(plates[name], LEAK_STOPS) for name in LEAK_PANELS]
            write_jpeg(options.images / "failure_thin_walls.jpg", np.concatenate([codes(p) for p in shown], 1))
    return rows


def _prepare(effect: Effect, options: EffectOptions, launcher: Launcher) -> _Stage:
    scene = effect.make(read(stage_file(effect.stage)))
    height = max(1, round(options.width / scene.camera.aspect))
    stores = [
        ReferenceStore(
            scene,
            options.width,
            height,
            samples=-(-options.samples // 2),
            seed=seed,
            cache=options.cache,
            launcher=launcher,
        )
        for seed in (options.seed, options.seed + 1)
    ]
    one, two = (s.get(effect.bounces) for s in stores)
    cover = 0.5 * (one.coverage + two.coverage)
    delta = smooth_delta(0.5 * (one.delta + two.delta), cover)
    direct = delta
    if effect.bounces:
        direct = smooth_delta(np.mean([s.get(0).delta for s in stores], 0), cover)
    masks = region_masks(direct, delta, cover, stores[0].glossy_mask())
    masks["changed"] = (cover <= 0) & (np.abs(delta).max(-1) > 0.01)
    if not masks[effect.region].any():
        raise OptionError(f"no pixel shows the effect '{effect.name}' at this size; raise --width")
    return _Stage(effect, options, scene, (one, two), masks[effect.region])


def _render(stage: _Stage, method: str, settings: dict[str, str]) -> tuple[np.ndarray, dict[str, Any]]:
    from warp_dvct.relighter import Relighter

    options = stage.options
    shared = {"method": method, "quality": options.quality, "device": options.device, "threads": options.threads}
    made = {**settings, "bounces": str(stage.effect.bounces)}
    Relighter(stage.scene, width=32, settings={**made, "samples": "1"}, **shared).render()  # compiles
    height, width = stage.region.shape
    relighter = Relighter(stage.scene, width=width, height=height, settings=made, **shared)
    return relighter.render(plate=stage.plate).comp, relighter.stats


def _figures(stage: _Stage, comp: np.ndarray) -> dict[str, float]:
    """Error of the change over its size, both root mean squares over the region and without the truth's noise; FLIP."""
    region = stage.region
    found = comp[region].astype(np.float64)
    one, two = (combine(stage.plate, p.delta, p.synthetic)[region] for p in stage.parts)
    plate = stage.plate[region]
    error = float(((found - one) * (found - two)).mean())  # independent noise of the parts has no mean
    size = float(((one - plate) * (two - plate)).mean())
    flip = flip_ldr(stage.truth, comp)[1]
    return {
        "error": math.sqrt(max(error, 0.0) / max(size, 1e-12)),
        "flip": float(flip[region].mean()),
        "share": float(region.mean()),
    }


def _leak(method: str, settings: dict[str, str], options: EffectOptions) -> tuple[dict[str, float], np.ndarray]:
    """Mean indirect light of the dark room of ``thin_wall`` over the lit one's, before, one bounce; and the picture."""
    from warp_dvct.relighter import Relighter

    scene = read(stage_file("thin_wall"))
    shared = {"method": method, "quality": options.quality, "device": options.device, "threads": options.threads}
    pictures, seconds = [], 0.0
    for bounces in ("1", "0"):
        relighter = Relighter(scene, width=options.width, settings={**settings, "bounces": bounces}, **shared)
        pictures.append(relighter.render())
        seconds = seconds or relighter.stats["cpu_seconds"]
    one, direct = pictures
    indirect, x = np.abs(one.plate - direct.plate), one.position[..., 0]
    real = one.mask_synthetic == 0
    lit, dark = indirect[real & (x > WALL)].mean(), indirect[real & (x < -WALL)].mean()
    return {"error": float(dark / lit), "flip": math.nan, "share": math.nan, "cpu_seconds": seconds}, one.plate


def _draw_failures(stage: _Stage, folder: Path) -> None:
    """``failure_NAME.jpg``: the truth, the method and the FLIP map, side by side."""
    for name, (effect, method, settings, stops) in FAILURES.items():
        if effect != stage.effect.name:
            continue
        kind, base = METHODS[method]
        comp, _ = _render(stage, kind, {**base, **settings})
        error = flip_ldr(stage.truth, comp, stops)[1]
        panels = [to_display(stage.truth, stops), to_display(comp, stops), heat(error)]
        write_jpeg(folder / f"failure_{name}.jpg", np.concatenate([codes(p) for p in panels], 1))


def write_jpeg(file: Path, pixels: np.ndarray, quality: int = 85) -> None:
    """Write 8-bit ``[h, w, 3]`` as JPEG.

    Raises:
        OptionError: Pillow is not installed. FileError: The file cannot be written.
    """
    try:
        image = importlib.import_module("PIL.Image")
    except ImportError as error:
        raise OptionError("pictures need Pillow: pip install 'warp-dvct[bench]'") from error
    temporary = file.with_name(f".{file.name}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        image.fromarray(pixels).save(temporary, "JPEG", quality=quality)
        temporary.replace(file)
    except OSError as error:
        raise FileError(f"{file} cannot be written: {error.strerror or error}") from error


def format_table(rows: Sequence[dict[str, Any]]) -> str:
    """A Markdown table: a line per effect, a cell per method with error and processor seconds."""
    methods = list(dict.fromkeys(r["method"] for r in rows))
    lines = ["| effect | " + " | ".join(methods) + " |", "| --- " * (len(methods) + 1) + "|"]
    for effect in dict.fromkeys(r["effect"] for r in rows):
        own = {r["method"]: r for r in rows if r["effect"] == effect}
        cells = [_cell(own[m]) if m in own else "–" for m in methods]
        lines.append(f"| {effect} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(row: dict[str, Any]) -> str:
    flip = "" if row["flip"] is None or math.isnan(row["flip"]) else f" / {row['flip']:.3f}"
    return f"{100 * row['error']:.3g} %{flip} / {row['cpu_seconds']:.2f} s"

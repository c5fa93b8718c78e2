"""What a user would pick instead: Mitsuba 3 before and after with a common seed, with and without Intel's denoiser."""

from __future__ import annotations

import functools
import importlib
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.bench.error import read, stage_file
from warp_dvct.bench.mitsuba_scene import describe_materials, mitsuba_description
from warp_dvct.bench.references import Reference, ReferenceStore
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.metrics import affected_mask, flip_ldr, import_flip, rmse, smooth_delta
from warp_dvct.scene import Role, Scene
from warp_dvct.settings import QUALITIES

VARIANTS = ("llvm_ad_rgb", "scalar_rgb")
PROBE = """
import sys, mitsuba as mi
mi.set_variant(sys.argv[1])
film = {"type": "hdrfilm", "width": 8, "height": 8}
sensor = {"type": "perspective", "film": film, "to_world": mi.ScalarTransform4f().translate([0, 0, -3])}
path = {"type": "path", "max_depth": 3, "rr_depth": 100}
ball = {"type": "sphere", "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
scene = {"type": "scene", "integrator": path, "sensor": sensor, "ball": ball, "sky": {"type": "constant"}}
sys.exit(not mi.TensorXf(mi.render(mi.load_dict(scene), spp=2)).array[0] > 0)
"""
NO_LLVM = "no LLVM variant (DRJIT_LIBLLVM_PATH has to name an LLVM of 17 or later): times are those of the scalar one"


@dataclass(frozen=True)
class PeerOptions:
    """What is measured; the fields are the command's flags. ``peer_samples`` are those per pixel of each picture."""

    peer_samples: tuple[int, ...] = (4, 16, 64)
    qualities: tuple[str, ...] = QUALITIES
    width: int = 320
    samples: int = 128
    bounces: int = 1
    seed: int = 1
    cache: Path = Path()
    device: str = "cpu"
    threads: int | None = None


@dataclass(frozen=True)
class PeerRow:
    """One way to the composite: wall and processor seconds without loading and compiling, errors against our truth."""

    name: str
    seconds: float
    cpu_seconds: float
    flip: float
    flip_affected: float
    rmse: float


@dataclass(frozen=True)
class PeerReport:
    """All rows of a stage; ``left_out`` says which peers are missing and why; ``notes`` how the stage was mapped."""

    stage: str
    width: int
    height: int
    truth_noise: float
    rows: list[PeerRow]
    left_out: list[str]
    notes: str


def measure(stage: str, options: PeerOptions) -> PeerReport:
    """Composites of a stage by our method, by our path tracer and by the peers that are installed.

    All change the same plate, the truth's 'before'. Ours render with ``bounces=1`` where the truth has one bounce, else
    with their presets' bounces.

    Raises:
        DvctError: As the relighter raises; OptionError for a missing flip-evaluator.
    """
    import_flip()
    launcher = Launcher(options.device, options.threads)
    scene = read(stage_file(stage))
    store = ReferenceStore.of(scene, options, launcher)
    truth = store.get(options.bounces)
    affected = affected_mask(smooth_delta(truth.delta, truth.coverage), truth.coverage)
    rows: list[PeerRow] = []

    def add(name: str, picture: Callable[[], np.ndarray]) -> None:
        comp, wall, cpu = timed(picture)
        error = flip_ldr(truth.comp, comp)[1]
        rows.append(
            PeerRow(name, wall, cpu, float(error.mean()), float(error[affected].mean()), rmse(truth.comp, comp))
        )

    _add_ours(add, scene, truth, options)
    left_out, notes = add_mitsuba(add, scene, truth, options)
    return PeerReport(Path(stage).stem, options.width, store.height, truth.noise, rows, left_out, notes)


def timed(picture: Callable[[], np.ndarray]) -> tuple[np.ndarray, float, float]:
    """A picture, and the seconds that it took: of the clock, and of all threads."""
    wall, cpu = time.perf_counter(), time.process_time()
    made = picture()
    return made, time.perf_counter() - wall, time.process_time() - cpu


def _add_ours(add: Callable[..., None], scene: Scene, truth: Reference, options: PeerOptions) -> None:
    from warp_dvct.relighter import Relighter

    height, width = truth.coverage.shape
    ways = [(f"delta-cones {q}", "delta-cones", q, {}) for q in options.qualities]
    ways += [
        (f"path-trace {n} spp", "path-trace", "balanced", {"samples": str(n), "seed": "77"})
        for n in options.peer_samples
    ]
    for name, method, quality, settings in ways:
        if options.bounces == 1 or method == "path-trace":
            settings = {**settings, "bounces": str(options.bounces)}
        shared = {"method": method, "quality": quality, "device": options.device, "threads": options.threads}
        small = {**settings, "samples": "1", "volume.resolution": "32"}
        Relighter(scene, width=32, settings=small, **shared).render()  # compiles
        relighter = Relighter(scene, width=width, height=height, settings=settings, **shared)
        add(name, lambda relighter=relighter: relighter.render(plate=truth.before).comp)


def add_mitsuba(
    add: Callable[..., None], scene: Scene, truth: Reference, options: PeerOptions
) -> tuple[list[str], str]:
    """Rows of Mitsuba; returns who is left out, and how the materials were mapped."""
    try:
        mi = load_mitsuba(options.threads)
    except ImportError as error:
        return [f"Mitsuba 3: {error}; pip install 'warp-dvct[bench]'"], ""
    denoise, left_out = None, []
    try:
        denoise = importlib.import_module("pyoidn").denoise
    except (ImportError, OSError) as error:
        left_out.append(f"Intel Open Image Denoise: {error}; pip install 'warp-dvct[bench]'")
    with tempfile.TemporaryDirectory() as folder:
        try:
            plain, with_guides = (
                MitsubaPair(mi, scene, truth, Path(folder), options.bounces, g) for g in (False, True)
            )
        except OptionError as error:
            return [*left_out, f"Mitsuba 3: {error}"], ""
        for samples in options.peer_samples:
            plain.composite(samples)  # compiles
            add(f"Mitsuba {samples} spp", lambda n=samples: plain.composite(n))
        for samples in options.peer_samples if denoise else ():
            with_guides.composite(samples, denoise)
            add(f"Mitsuba {samples} spp, OIDN", lambda n=samples: with_guides.composite(n, denoise))
    if mi.variant() == "scalar_rgb":
        left_out.append(f"Mitsuba 3: {NO_LLVM}")
    return left_out, f"Mitsuba {mi.__version__} {mi.variant()}, materials: {describe_materials(scene)}"


def load_mitsuba(threads: int | None = None) -> Any:
    """Mitsuba with its LLVM variant, or the scalar one where that does not work.

    Raises:
        ImportError: Mitsuba is not installed, or no variant starts.
    """
    mi = importlib.import_module("mitsuba")
    for variant in VARIANTS:
        if variant_works(variant):
            mi.set_variant(variant)
            if threads is not None and variant.startswith("llvm"):
                importlib.import_module("drjit").set_thread_count(threads)
            return mi
    raise ImportError(f"none of its variants {', '.join(VARIANTS)} renders here")


@functools.cache
def variant_works(variant: str) -> bool:
    """Whether a variant of Mitsuba renders; tried in a process of its own, which an unsuitable LLVM library aborts."""
    done = subprocess.run([sys.executable, "-c", PROBE, variant], capture_output=True, text=True)
    return done.returncode == 0


class MitsubaPair:
    """The real scene alone and the whole scene, loaded; :meth:`composite` renders both with one seed.

    Args:
        truth: Gives plate, coverage and size. folder: Takes meshes. guides: Also render albedo and normals.
    Raises:
        OptionError: The scene has something without a counterpart in Mitsuba.
    """

    def __init__(self, mi: Any, scene: Scene, truth: Reference, folder: Path, bounces: int, guides: bool) -> None:
        self._mi, self._truth, self._guides = mi, truth, guides
        height, width = truth.coverage.shape
        size = {"width": width, "height": height, "bounces": bounces, "aov": guides}
        self._scenes = [
            mi.load_dict(mitsuba_description(mi, scene, roles, folder, **size)) for roles in ((Role.REAL,), tuple(Role))
        ]

    def composite(self, samples: int, denoise: Callable[..., np.ndarray] | None = None, seed: int = 5) -> np.ndarray:
        """Plate + (after - before) on real pixels, after on synthetic ones, mixed by the true coverage."""
        before, after = (self.picture(scene, samples, seed, denoise) for scene in self._scenes)
        free = 1 - self._truth.coverage[..., None]
        return np.maximum(after + free * (self._truth.before - before), 0).astype(np.float32)

    def picture(self, scene: Any, samples: int, seed: int, denoise: Callable[..., np.ndarray] | None) -> np.ndarray:
        """One picture, linear ``[h, w, 3]``; denoised with albedo and normals where ``denoise`` is given."""
        pixels = np.array(self._mi.render(scene, spp=samples, seed=seed), np.float32)
        color = np.ascontiguousarray(pixels[..., :3])
        if denoise is None:
            return color
        albedo, normal = (np.ascontiguousarray(pixels[..., k : k + 3]) for k in (3, 6))
        return denoise(color, albedo=np.clip(albedo, 0, 1), normal=np.clip(normal, -1, 1), hdr=True)


def format_report(report: PeerReport) -> str:
    """A line per way to the composite, then who is left out."""
    lines = [
        f"{report.stage} {report.width}x{report.height}; the truth's noise is FLIP {report.truth_noise:.4f}",
        f"{'':28}{'seconds':>9}{'CPU s':>8}{'FLIP':>9}{'affected':>10}{'RMSE':>9}",
    ]
    for row in report.rows:
        values = f"{row.flip:9.4f}{_number(row.flip_affected):>10}{row.rmse:9.4f}"
        lines.append(f"{row.name:28}{row.seconds:9.2f}{row.cpu_seconds:8.2f}{values}")
    lines += [report.notes] if report.notes else []
    lines += [f"left out: {reason}" for reason in report.left_out]
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4f}"

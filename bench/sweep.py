"""One stage under several settings against the one-bounce truth: error of the picture and of its indirect light.

``bench curve`` turns every knob up together, ``bench compare`` takes the settings to try from the command line.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.bench.error import read, stage_file
from warp_dvct.bench.references import Reference, ReferenceStore, combine, is_glossy
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.layers import Layers
from warp_dvct.metrics import affected_mask, flip_ldr, import_flip, smooth_delta
from warp_dvct.scene import Scene

# Joint quality: the name is a factor on the rays, 1 being the balanced preset.
_KNOBS = (
    *("gather.rays", "gather.object_rays", "gather.stride", "gather.object_stride", "gather.detail"),
    *("gather.smoothing", "rsm.texels", "rsm.density", "shadows.samples", "shadows.probes"),
    *("glossy.rays", "glossy.smoothing", "patches.count", "volume.resolution", "volume.coarse", "antialias"),
)
_CURVE = {
    "1/4": (16, 16, 16, 8, 0.3, 1, 256, 1.0, 2, 2, 2, 0.5, 1024, 32, 32, 2),
    "1/2": (32, 32, 8, 4, 0.3, 1, 512, 1.5, 4, 4, 4, 0.4, 4096, 48, 48, 4),
    "1": (64, 64, 8, 4, 0.15, 1, 1024, 2.0, 8, 8, 8, 0.3, 8192, 64, 64, 8),
    "2": (128, 128, 4, 2, 0.15, 1, 1024, 3.0, 32, 16, 16, 0.25, 16384, 96, 64, 12),
    "4": (256, 256, 2, 1, 0.0, 0, 2048, 3.0, 64, 32, 32, 0.2, 32768, 128, 128, 16),
    "8": (512, 512, 1, 1, 0.0, 0, 4096, 4.0, 128, 128, 64, 0.15, 65536, 256, 256, 32),
}
CURVE = {name: dict(zip(_KNOBS, map(str, values), strict=True)) for name, values in _CURVE.items()}
WARM_UP = {"volume.resolution": "32", "volume.coarse": "32", "gather.rays": "4", "patches.rays": "4"}
WARM_UP_WIDTH = 32


@dataclass(frozen=True)
class SweepOptions:
    """What is measured; the fields are the commands' flags.

    ``samples`` are those of the truth in all: it is traced in two independent parts, so that its noise drops out of the
    mean squared errors.
    """

    method: str = "delta-cones"
    quality: str = "balanced"
    settings: Mapping[str, str] = field(default_factory=dict)
    width: int = 320
    samples: int = 64
    seed: int = 1
    cache: Path = Path()
    device: str = "cpu"
    threads: int | None = None


@dataclass(frozen=True)
class Trial:
    """One setting's figures.

    Attributes:
        name: As given. seconds, cpu_seconds: Of one frame from scratch with a plate, without loading and compiling;
            processor seconds are of all threads and move less on a busy machine.
        flip, flip_affected: Mean LDR-FLIP over the picture and over affected pixels.
        delta_error: Root mean square error of the change of indirect light on real pixels, over the mean of
            indirect light before.
        energy_before, energy_after: Indirect light over the truth's: of the whole picture, or of ``Truth.real`` where
            the scene has glossy surfaces.
    """

    name: str
    seconds: float
    cpu_seconds: float
    flip: float
    flip_affected: float
    delta_error: float
    energy_before: float
    energy_after: float


@dataclass(frozen=True)
class Indirect:
    """What one bounce adds to a picture: before, delta on real surfaces, synthetic (premultiplied); ``[h, w, 3]``."""

    before: np.ndarray
    delta: np.ndarray
    synthetic: np.ndarray

    def after(self, coverage: np.ndarray) -> np.ndarray:
        """Of the whole picture with the synthetic objects in it; ``coverage`` is ``[h, w]``."""
        return (1 - coverage[..., None]) * self.before + self.delta + self.synthetic


@dataclass(frozen=True)
class Truth:
    """The truth in two independent parts, and their mean.

    Attributes:
        whole: One bounce. parts: Its indirect light, twice. noise: FLIP that the noise of ``whole`` is worth.
        real: Pixels without synthetic coverage whose surface is not glossy: a glossy one mirrors lit surfaces even in
            the frame of direct light that indirect light is the difference to.
        counted: Pixels whose energy is compared. affected: Pixels that the synthetic objects change.
    """

    whole: Reference
    parts: tuple[Indirect, Indirect]
    noise: float
    real: np.ndarray
    counted: np.ndarray
    affected: np.ndarray


def truth_of(scene: Scene, width: int, height: int, options: SweepOptions, launcher: Launcher) -> Truth:
    """Trace (or load) the truth of one bounce and what of it is indirect.

    Raises:
        OptionError: A size below 16 pixels, or samples below 2. FileError: The cache cannot be written.
    """
    if min(width, height) < 16:
        raise OptionError(f"the picture is {width} x {height}; FLIP needs at least 16 pixels, raise --width")
    if options.samples < 2:
        raise OptionError(f"--spp is {options.samples}; give at least 2, the truth is traced in two parts")
    ones, indirect, glossy = [], [], np.zeros((height, width), bool)
    for seed in (options.seed, options.seed + 1):
        store = ReferenceStore(
            scene,
            width,
            height,
            samples=-(-options.samples // 2),
            seed=seed,
            cache=options.cache,
            launcher=launcher,
        )
        direct, one, glossy = store.get(0), store.get(1), store.glossy_mask()
        ones.append(one)
        indirect.append(
            Indirect(one.before - direct.before, one.delta - direct.delta, (one.synthetic - direct.synthetic)[..., :3])
        )
    a, b = ones
    before, delta, synthetic = (a.before + b.before) / 2, (a.delta + b.delta) / 2, (a.synthetic + b.synthetic) / 2
    noise = flip_ldr(combine(before, a.delta, a.synthetic), combine(before, b.delta, b.synthetic))[0] / 2
    whole = Reference(before, delta, synthetic, noise)
    affected = affected_mask(smooth_delta(delta, whole.coverage), whole.coverage)
    real = (whole.coverage <= 0) & ~glossy
    counted = real if any(is_glossy(m) for m in scene.materials) else np.ones_like(real)
    return Truth(whole, (indirect[0], indirect[1]), noise, real, counted, affected)


def measure(
    stage: str,
    trials: Mapping[str, Mapping[str, str]],
    options: SweepOptions,
    report: Callable[[Trial], None] | None = None,
) -> tuple[Truth, list[Trial]]:
    """Render a stage under each of ``trials`` (settings over ``options.settings``) at one bounce.

    Args:
        stage: A bundled stage's name, or a USD file.
        report: Called with each trial as it is done.
    Raises:
        DvctError: As the relighter raises; OptionError also for a missing flip-evaluator.
    """
    import_flip()
    launcher = Launcher(options.device, options.threads)
    scene = read(stage_file(stage))
    height = max(1, round(options.width / scene.camera.aspect))
    truth = truth_of(scene, options.width, height, options, launcher)
    done = []
    for name, settings in trials.items():
        done.append(_measure_one(name, scene, truth, {**options.settings, **settings}, options))
        if report is not None:
            report(done[-1])
    return truth, done


def _measure_one(name: str, scene: Scene, truth: Truth, settings: Mapping[str, str], options: SweepOptions) -> Trial:
    height, width = truth.real.shape
    relighter = _relighter(scene, {**settings, **WARM_UP, "bounces": "1"}, options, WARM_UP_WIDTH, None)
    relighter.render()  # compiles
    relighter = _relighter(scene, {**settings, "bounces": "1"}, options, width, height)
    start = time.process_time()
    comp = relighter.render(plate=truth.whole.before).comp
    cpu_seconds, stats = time.process_time() - start, relighter.stats
    one = relighter.render()
    direct = _relighter(scene, {**settings, "bounces": "0"}, options, width, height).render()
    error_map = flip_ldr(truth.whole.comp, comp)[1]
    delta_error, energy_before, energy_after = compare_indirect(truth, indirect_of(one, direct))
    return Trial(
        name,
        float(stats["render_seconds"]),
        cpu_seconds,
        float(error_map.mean()),
        float(error_map[truth.affected].mean()),
        delta_error,
        energy_before,
        energy_after,
    )


def indirect_of(one: Layers, direct: Layers) -> Indirect:
    """Indirect light of a method: a frame of one bounce less one of direct light; both without a plate."""
    return Indirect(one.plate - direct.plate, one.delta - direct.delta, (one.rgba - direct.rgba)[..., :3])


def compare_indirect(truth: Truth, found: Indirect) -> tuple[float, float, float]:
    """Error of the delta over the mean indirect light before, both on real pixels; energy before; energy after.

    The mean squared error is taken as the mean of (found - part 1)(found - part 2): with independent noise in the parts
    its expectation is the error against a truth without noise. It is 0 where that is negative.
    """
    coverage, real, counted, parts = truth.whole.coverage, truth.real, truth.counted, truth.parts
    first, second = (found.delta[real] - part.delta[real] for part in parts)
    mean_square = float((first.astype(np.float64) * second).mean())
    scale = float(np.mean([part.before[real].mean() for part in parts]))
    before = float(np.mean([part.before[counted].mean() for part in parts]))
    after = float(np.mean([part.after(coverage)[counted].mean() for part in parts]))
    error = float(np.sqrt(max(mean_square, 0.0))) / max(scale, 1e-12)
    found_before, found_after = (float(p[counted].mean()) for p in (found.before, found.after(coverage)))
    return error, found_before / before, found_after / after


def _relighter(scene: Scene, settings: Mapping[str, str], options: SweepOptions, width: int, height: int | None) -> Any:
    from warp_dvct.relighter import Relighter

    return Relighter(
        scene,
        method=options.method,
        quality=options.quality,
        settings=settings,
        width=width,
        height=height,
        device=options.device,
        threads=options.threads,
    )


def parse_trials(texts: Sequence[str]) -> dict[str, dict[str, str]]:
    """``"key=value key=value"`` (or ``"label: key=value"``) to settings by name; an empty text is the preset itself.

    Raises:
        OptionError: Something that is not ``key=value``, or a name twice.
    """
    trials: dict[str, dict[str, str]] = {}
    for text in texts:
        label, colon, pairs = text.rpartition(":")
        name = label.strip() if colon else (pairs.strip() or "preset")
        settings = {}
        for pair in pairs.split():
            key, equals, value = pair.partition("=")
            if not equals or not key:
                raise OptionError(f"--try {text!r}: {pair!r} is not KEY=VALUE")
            settings[key] = value
        if name in trials:
            raise OptionError(f"--try {name!r} is given twice; put a label before a colon to tell them apart")
        trials[name] = settings
    return trials


def format_head(stage: str, options: SweepOptions, names: Sequence[str]) -> str:
    """The lines above the trials."""
    wide = max(len("setting"), *map(len, names))
    what = f"{Path(stage).stem}, {options.width} pixels wide, {options.method} {options.quality}, one bounce"
    columns = f"{'FLIP':>8}{'affected':>10}{'delta err':>11}{'E before':>10}{'E after':>9}"
    return f"{what}; truth of {options.samples} spp\n{'setting':{wide}}{'seconds':>9}{'CPU s':>8}{columns}"


def format_trial(trial: Trial, names: Sequence[str]) -> str:
    """One line, under :func:`format_head`; errors of the delta in percent."""
    wide = max(len("setting"), *map(len, names))
    return (
        f"{trial.name:{wide}}{trial.seconds:9.2f}{trial.cpu_seconds:8.2f}{trial.flip:8.4f}{trial.flip_affected:10.4f}"
        f"{100 * trial.delta_error:10.2f}%{trial.energy_before:10.4f}{trial.energy_after:9.4f}"
    )

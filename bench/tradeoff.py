"""Speed against accuracy: every knob of every method timed and compared with the path-traced truth; resumable."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.bench.error import MANY_BOUNCES, read, stage_file
from warp_dvct.bench.knobs import Trial, choose_trials
from warp_dvct.bench.motion import flicker_of, shot
from warp_dvct.bench.pareto import cost, front, words
from warp_dvct.bench.pictures import save_pictures, save_truth
from warp_dvct.bench.references import Reference, ReferenceStore
from warp_dvct.bench.rows import append_row, now, provenance, read_rows
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.metrics import affected_mask, flip_ldr, import_flip, rel_mse, rmse, smooth_delta
from warp_dvct.scene import Role, Scene
from warp_dvct.settings import make_settings

KIND = "tradeoff"
ROWS = "rows.jsonl"
SHOT_FRAMES = 60  # the moving shot of bench motion, of which flicker takes the first frames
PEER_SAMPLES = (1, 4, 16, 64)
SMALL = {"volume.resolution": "32", "volume.coarse": "32", "patches.count": "64", "samples": "1", "vpls.count": "16"}


@dataclass(frozen=True)
class TradeoffOptions:
    """What is measured; the fields are the command's flags.

    Attributes:
        settings: Of every point, under its own.
        bounces: Of the truth, of the path tracers and of all points but presets.
        samples: Per pixel of the truth. flicker: Frames of the moving shot; 0 for none. repeats: Timed frames a point.
        peers: Whether Mitsuba 3 is measured too, where it is installed.
    """

    methods: tuple[str, ...] = ()
    knobs: tuple[str, ...] = ()
    settings: dict[str, str] = field(default_factory=dict)
    width: int = 320
    samples: int = 128
    bounces: int = MANY_BOUNCES
    flicker: int = 3
    repeats: int = 2
    peers: bool = True
    seed: int = 1
    cache: Path = Path()
    out: Path = Path("tradeoff")
    device: str = "cpu"
    threads: int | None = None


@dataclass
class Bench:
    """One stage, its truth, and the points measured so far.

    Args:
        stage: A bundled stage's name, or a USD file.
        report: Called with each row as it is measured, and whether it was there already.
    Raises:
        DvctError: As the relighter raises; OptionError for a size below 16 pixels or a missing flip-evaluator;
            FileError for a broken file of rows, before anything is traced.
    """

    stage: str
    options: TradeoffOptions
    report: Callable[[dict[str, Any], bool], None] = lambda row, known: None
    left_out: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        import_flip()
        options = self.options
        if options.repeats < 1 or options.flicker < 0 or options.flicker == 1:
            raise OptionError("--repeats is at least 1, and --flicker is 0 or a number of at least 2 frames")
        self.file = options.out / ROWS
        self.known = {row["key"]: row for row in read_rows(self.file, KIND)}
        self.scene = read(stage_file(self.stage))
        self.height = max(1, round(options.width / self.scene.camera.aspect))
        if min(options.width, self.height) < 16:
            raise OptionError(
                f"the picture is {options.width} x {self.height}; FLIP needs at least 16 pixels, raise --width"
            )
        self.launcher = Launcher(options.device, options.threads)
        self.store = self._store(self.scene)
        self.taken = provenance()

    def _store(self, scene: Scene) -> ReferenceStore:
        o = self.options
        return ReferenceStore(
            scene,
            o.width,
            self.height,
            samples=o.samples,
            seed=o.seed,
            cache=o.cache,
            launcher=self.launcher,
        )

    @cached_property
    def truth(self) -> Reference:
        """The converged picture."""
        return self.store.get(self.options.bounces)

    @cached_property
    def areas(self) -> dict[str, np.ndarray]:
        """Masks by name: the whole picture, what changes in it, real pixels alone, synthetic ones alone."""
        cover = self.truth.coverage
        affected = affected_mask(smooth_delta(self.truth.delta, cover), cover)
        return {
            "picture": np.ones(cover.shape, bool),
            "affected": affected,
            "real": cover <= 0,
            "object": cover > 0,
        }

    @cached_property
    def moments(self) -> tuple[list[Scene], list[Reference]]:
        """Scenes of the first frames of the moving shot, and their truths."""
        if not self.options.flicker or self.scene.bounds(Role.SYNTHETIC) is None:
            return [], []
        scenes = shot(self.scene, SHOT_FRAMES, False)[: self.options.flicker]
        return scenes, [self._store(scene).get(self.options.bounces) for scene in scenes]

    def run(self) -> list[dict[str, Any]]:
        """Measure what is not in the file yet, and return the rows of all points asked for."""
        from warp_dvct.relighter import Relighter

        options = self.options
        glossy = Relighter(self.scene, width=64).plan.glossy
        trials, left_out = choose_trials(options.methods, options.knobs, options.bounces, glossy)
        self.left_out += left_out
        warm: set[str] = set()
        rows = []
        for trial in trials:
            trial = replace(trial, settings={**options.settings, **trial.settings})
            settings = asdict(make_settings(trial.quality, trial.settings, trial.method))
            row = self._point(self._key(trial.method, settings), trial, warm)
            # One picture may be a point of several sweeps.
            rows.append({**row, "group": trial.group, "value": trial.value, "name": trial.name})
        if options.peers and not options.knobs:
            rows += self._peers()
        save_truth(options.out, Path(self.stage).stem, self.truth)
        return rows

    def _key(self, method: str, settings: Mapping[str, Any]) -> str:
        """What a point depends on besides the machine and the methods' sources, which the row names."""
        o = self.options
        content = [self.store.key(o.bounces), method, dict(sorted(settings.items())), o.flicker, o.device]
        return hashlib.sha256(json.dumps([*content, o.threads]).encode()).hexdigest()[:24]

    def _point(self, key: str, trial: Trial, warm: set[str]) -> dict[str, Any]:
        if key in self.known:
            self.report(self.known[key], True)
            return self.known[key]
        if trial.method not in warm:
            self._relighter(trial, self.scene, {**trial.settings, **SMALL}, 32).render()
            warm.add(trial.method)
        frames, comp = [], np.zeros(0)
        for _ in range(self.options.repeats):
            relighter = self._relighter(trial, self.scene, trial.settings)
            comp = relighter.render(plate=self.truth.before).comp
            frames.append(relighter.stats)
        best = min(frames, key=lambda f: f["cpu_seconds"])
        figures = {
            "seconds": [f["render_seconds"] for f in frames],
            "cpu_seconds": [f["cpu_seconds"] for f in frames],
            "passes": best["passes"],
            "cpu_passes": best["cpu_passes"],
            "bytes": best["peak_bytes"],
            "flicker": self._flicker(trial),
        }
        settings = {k: str(v) for k, v in trial.settings.items()}
        case = {"method": trial.method, "quality": trial.quality, "settings": settings}
        # Presets change from commit to commit: what they stood for here is part of the row.
        case["resolved"] = asdict(make_settings(trial.quality, trial.settings, trial.method))
        return self._add(key, {**case, "group": trial.group, "value": trial.value, "name": trial.name}, figures, comp)

    def _add(self, key: str, case: dict[str, Any], figures: dict[str, Any], comp: np.ndarray) -> dict[str, Any]:
        error_map = flip_ldr(self.truth.comp, comp)[1]
        errors = {
            "FLIP": {n: _mean(error_map[m]) for n, m in self.areas.items()},
            "RMSE": {n: rmse(self.truth.comp, comp, m) for n, m in self.areas.items()},
            "relMSE": {n: rel_mse(self.truth.comp, comp, m) for n, m in self.areas.items()},
        }
        truth = {"samples": self.store.samples, "bounces": self.options.bounces, "noise": self.truth.noise}
        size = {"width": self.options.width, "height": self.height}
        row = {
            "kind": KIND,
            "key": key,
            "stage": Path(self.stage).stem,
            **size,
            "device": self.options.device,
            **case,
            **figures,
            "errors": errors,
            "truth": truth,
            "truth_key": self.store.key(self.options.bounces),
            **self.taken,
            "time": now(),
        }
        save_pictures(self.options.out, key, comp, error_map)
        append_row(self.file, row)
        self.known[key] = row
        self.report(row, False)
        return row

    def _relighter(self, trial: Trial, scene: Scene, settings: Mapping[str, str], width: int | None = None) -> Any:
        from warp_dvct.relighter import Relighter

        return Relighter(
            scene,
            method=trial.method,
            quality=trial.quality,
            settings=settings,
            width=width or self.options.width,
            height=None if width else self.height,
            device=self.options.device,
            threads=self.options.threads,
        )

    def _flicker(self, trial: Trial) -> float | None:
        """Mean FLIP by which a frame's error changes to the next, over the moving shot on a plate that stays."""
        scenes, truths = self.moments
        if not scenes:
            return None
        relighter = self._relighter(trial, scenes[0], trial.settings)
        pictures = []
        for scene in scenes:
            relighter.set_scene(scene)
            pictures.append(relighter.render(plate=truths[0].before).comp)
        expected = [t.comp - (1.0 - t.coverage[..., None]) * (t.before - truths[0].before) for t in truths]
        return flicker_of(pictures, expected)

    def _peers(self) -> list[dict[str, Any]]:
        """Mitsuba 3 with and without OIDN on the same stage: who is missing, or cannot load it, is named."""
        from warp_dvct.bench import peers

        names = [f"Mitsuba {n} spp{end}" for end in ("", ", OIDN") for n in PEER_SAMPLES]
        keys = {name: self._key(name, {}) for name in names}
        rows = []
        for name in names:
            if keys[name] in self.known:
                rows.append(self.known[keys[name]])
                self.report(rows[-1], True)
        if len(rows) == len(names):
            return rows

        def add(name: str, picture: Callable[[], np.ndarray]) -> None:
            if keys[name] in self.known:
                return
            timed = [peers.timed(picture) for _ in range(self.options.repeats)]
            figures = {"seconds": [t[1] for t in timed], "cpu_seconds": [t[2] for t in timed], "passes": {}}
            figures |= {"cpu_passes": {}, "bytes": None, "flicker": None}
            method = "mitsuba-oidn" if name.endswith("OIDN") else "mitsuba"
            case = {"method": method, "quality": "", "settings": {"samples": name.split()[1]}}
            case |= {"group": "samples", "value": name.split()[1], "name": name}
            rows.append(self._add(keys[name], case, figures, timed[0][0]))

        options = peers.PeerOptions(
            peer_samples=PEER_SAMPLES,
            width=self.options.width,
            bounces=self.options.bounces,
            threads=self.options.threads,
        )
        left_out, _ = peers.add_mitsuba(add, self.scene, self.truth, options)
        self.left_out += left_out
        return rows


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")


def format_row(row: Mapping[str, Any]) -> str:
    """A line for a terminal, under :data:`HEAD`."""
    flip, others = row["errors"]["FLIP"], (row["errors"]["RMSE"]["picture"], row["errors"]["relMSE"]["picture"])
    cells = [flip["picture"], flip["affected"], flip["real"], *others, row["flicker"]]
    values = "".join(f"{'-':>10}" if v is None else f"{v:10.4f}" for v in cells)
    return f"{row['name']:44}{cost(row):8.3f}{values}"


HEAD = f"{'':44}{'CPU s':>8}" + "".join(
    f"{name:>10}" for name in ("FLIP", "affected", "real", "RMSE", "relMSE", "flicker")
)


def summarise(rows: Sequence[Mapping[str, Any]]) -> str:
    """What each knob buys, in words, and the fronts of each method."""
    best = front([cost(r) for r in rows], [r["errors"]["FLIP"]["picture"] for r in rows])
    lines = ["the front, from cheap to exact:", *(f"  {format_row(rows[i])}" for i in best), "", "what each knob buys:"]
    return "\n".join([*lines, *(f"  {line}" for line in words(rows))])

"""Whether ``relight --budget`` keeps its word: budgets over stages, predicted against actual time and error."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from warp_dvct.bench.error import MANY_BOUNCES, read, stage_file
from warp_dvct.bench.references import Reference, ReferenceStore
from warp_dvct.bench.rows import commit
from warp_dvct.budget import check_request
from warp_dvct.cost_model import load_model
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.metrics import flip_ldr, import_flip
from warp_dvct.settings import make_settings

KIND = "budget"
LATEST = 1.25  # of the budget: never later
NEAR = 0.25  # of the budget: how near the actual time is to be
ERROR_FACTOR = 1.5  # between predicted and measured error


@dataclass(frozen=True)
class BudgetOptions:
    """What is measured; the fields are the command's flags. ``samples`` are of the truth; 0 measures no error. Of
    ``repeats`` the one with the median time counts."""

    budgets: tuple[float, ...] = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
    width: int = 320
    samples: int = 384
    repeats: int = 1
    method: str = "delta-cones"
    settings: dict[str, str] = field(default_factory=dict)
    seed: int = 1
    cache: Path = Path()
    device: str = "cpu"
    threads: int | None = None


def measure(
    stage: str,
    options: BudgetOptions,
    report: Callable[[dict[str, Any], bool], None] = lambda row, known: None,
    known: Mapping[str, dict[str, Any]] = MappingProxyType({}),
) -> list[dict[str, Any]]:
    """A row per budget: a frame with a plate after a small warm-up; budgets below the floor say so.

    Args:
        report: Called with each row as soon as it is measured, and with whether it was known.
        known: Rows by their ``key``, which are not measured again.
    Raises:
        OptionError: No budget, one that is not a positive number, no repeat, a setting that there is not, or as the
            relighter raises.
    """
    if not options.budgets or options.repeats < 1:
        raise OptionError("there is no budget to keep; give --budget SECONDS, and --repeats of at least 1")
    for budget in options.budgets:
        check_request(budget, None)
    make_settings("balanced", options.settings)  # what is wrong in them is no budget's fault
    if options.samples:
        import_flip()
    bench = _Bench(stage, options)
    rows = []
    for budget in options.budgets:
        key = bench.key(budget)
        rows.append(known[key] if key in known else bench.measure(key, budget))
        report(rows[-1], key in known)
    return rows


class _Bench:
    """One stage; its truth and its kernels are made when the first budget is measured."""

    def __init__(self, stage: str, options: BudgetOptions) -> None:
        self.options = options
        self.scene = read(stage_file(stage))
        self.name = Path(stage).stem
        height = max(1, round(options.width / self.scene.camera.aspect))
        self.size = {"width": options.width, "height": height, "device": options.device, "threads": options.threads}
        launcher = Launcher(options.device, options.threads)
        self.store = ReferenceStore.of(self.scene, replace(options, samples=options.samples or 1), launcher)

    def key(self, budget: float) -> str:
        """What a row depends on besides the machine's mood: scene, size, truth, settings, sources, unit costs."""
        o = self.options
        model = None if o.method == "path-trace" else asdict(load_model(o.device))
        content = [self.store.key(MANY_BOUNCES), o.samples, o.method, dict(sorted(o.settings.items())), o.repeats]
        content += [o.device, o.threads, commit(), model, budget]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:24]

    @cached_property
    def truth(self) -> Reference | None:
        """None where no error is measured."""
        return self.store.get(MANY_BOUNCES) if self.options.samples else None

    @cached_property
    def plate(self) -> np.ndarray:
        """For all frames; kernels are compiled by then."""
        from warp_dvct.relighter import Relighter

        o = self.options
        small = Relighter(self.scene, method=o.method, width=48, device=o.device, threads=o.threads)
        small.render(np.full((small.height, 48, 3), 0.5, np.float32))
        return self.truth.before if self.truth else np.full((self.size["height"], o.width, 3), 0.5, np.float32)

    def measure(self, key: str, budget: float) -> dict[str, Any]:
        """The row of a budget."""
        size = {"width": self.size["width"], "height": self.size["height"]}
        row: dict[str, Any] = {"kind": KIND, "key": key, "stage": self.name, **size, "budget": budget}
        row |= {"method": self.options.method, "settings": self.options.settings}
        try:
            tries = [
                _keep(self.scene, budget, self.plate, self.options, self.size) for _ in range(self.options.repeats)
            ]
        except OptionError as error:
            return {**row, "refused": str(error)}
        middle = sorted(tries, key=lambda t: t["seconds"])[len(tries) // 2]
        comp = middle.pop("comp")
        flip = None
        if self.truth is not None:
            flip = math.sqrt(max(flip_ldr(self.truth.comp, comp)[0] ** 2 - self.truth.noise**2, 0.0))
        return {**row, **middle, "flip": flip}


def _keep(scene: Any, budget: float, plate: np.ndarray, options: BudgetOptions, size: dict[str, Any]) -> dict[str, Any]:
    """Choose, render, and say what both took."""
    from warp_dvct.relighter import Relighter

    relighter = Relighter(scene, method=options.method, settings=options.settings, **size)
    start, cpu = time.perf_counter(), time.process_time()
    choice = relighter.keep_budget(budget, has_plate=True)
    planning, planning_cpu = time.perf_counter() - start, time.process_time() - cpu
    comp = relighter.render(plate).comp
    stats = relighter.stats
    return {
        "predicted": choice.to_dict(),  # with what was settled during the frame
        "seconds": planning + stats["render_seconds"],
        "cpu_seconds": planning_cpu + stats["cpu_seconds"],
        "passes": stats["passes"],
        "cpu_passes": stats["cpu_passes"],
        "comp": comp,
    }


HEAD = (
    f"{'':17}{'budget':>8}{'predicted':>11}{'actual':>8}{'ratio':>7}{'CPU s':>8}{'planned':>14}{'settled':>9}"
    f"{'slowness':>10}{'FLIP pred.':>12}{'actual':>8}{'ratio':>7}"
)


def format_row(row: dict[str, Any]) -> str:
    """A line under :data:`HEAD`; ratios are actual time over budget and actual over predicted error, ``planned`` and
    ``settled`` are rays a point or samples a pixel, ``slowness`` is what the frame had taken over its prediction when
    the rays were settled, or what all samples took over theirs."""
    if "refused" in row:
        return f"{row['stage']:17}{row['budget']:8.2f}  {row['refused']}"
    predicted, flip, settled = row["predicted"], row["flip"], row["predicted"].get("settled")
    line = (
        f"{row['stage']:17}{row['budget']:8.2f}{predicted['seconds']:11.2f}{row['seconds']:8.2f}"
        f"{row['seconds'] / row['budget']:7.2f}{row['cpu_seconds']:8.2f}"
    )
    if settled is not None:
        line += f"{settled['planned']:14}{settled.get('rays', settled.get('samples')):9}{settled['slowness']:10.2f}"
    else:
        line += f"{'-':>14}{'-':>9}{'-':>10}"
    if flip is not None and predicted["error"] is not None:
        ratio = f"{flip / predicted['error']:7.2f}" if predicted["error"] > 0 else f"{'-':>7}"
        line += f"{predicted['error']:12.4f}{flip:8.4f}{ratio}"
    return line + ("  more would not show" if predicted.get("enough") else "")


def summarise(rows: Sequence[dict[str, Any]]) -> str:
    """How many budgets were kept by the clock, how fast the machine was, and how many errors were predicted."""
    kept = [r for r in rows if "refused" not in r]
    if not kept:
        return "every budget was below the floor"
    full = [r for r in kept if not r["predicted"].get("enough")]
    clock = [r["seconds"] / r["budget"] for r in full]
    lines = []
    if full:
        lines.append(
            f"of {len(full)} budgets, {_share(clock, 1 - NEAR, LATEST)} were kept within {NEAR:.0%} by the clock, and"
            f" the latest took {max(clock):.2f} of its budget"
        )
    if len(full) < len(kept):
        most = max(r["seconds"] / r["budget"] for r in kept if r["predicted"].get("enough"))
        lines.append(
            f"in {len(kept) - len(full)} more it was said that more time would not show; they took {most:.2f} of theirs"
            " at most"
        )
    slowness = [r["predicted"]["settled"]["slowness"] for r in kept if r["predicted"].get("settled")]
    if slowness:
        lines.append(
            f"the frames' {'samples' if kept[0].get('method') == 'path-trace' else 'first passes'} took from"
            f" {min(slowness):.2f} to {max(slowness):.2f} of their prediction"
        )
    errors = [r["flip"] / r["predicted"]["error"] for r in kept if r["flip"] and r["predicted"]["error"]]
    if errors:
        near = _share(errors, 1 / ERROR_FACTOR, ERROR_FACTOR)
        lines.append(
            f"of {len(errors)} errors, {near} were predicted within a factor of {ERROR_FACTOR:g}; from"
            f" {min(errors):.2f} to {max(errors):.2f} of the prediction"
        )
    return "\n".join(lines)


def _share(ratios: Sequence[float], low: float, high: float) -> int:
    return sum(low <= ratio <= high for ratio in ratios)

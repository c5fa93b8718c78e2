"""The same picture on every backend: seconds per pass, compile time, bytes, and whether the layers agree."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median, stdev
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.bench.error import read, stage_file
from warp_dvct.bench.rows import machine_line
from warp_dvct.errors import OptionError
from warp_dvct.scene import Scene

if TYPE_CHECKING:
    from warp_dvct.layers import Layers

KIND = "backends"
TOLERANCE = 1e-3  # relative, and of the layer's mean where it is near 0
PARITY_LAYERS = ("comp", "rgba", "shadow", "added", "delta", "albedo", "normal", "position", "depth")
LEAST_DIFFERENCE = 0.03  # a smaller change of a median is no news on a machine that does other things too
ERRORS_APART = 3.0  # standard errors by which two medians have to differ
MEDIAN_ERROR = 1.2533  # standard error of the median of normal values, over that of their mean: sqrt(pi / 2)


@dataclass(frozen=True)
class Backend:
    """Where kernels run; ``threads`` is 1 on CUDA."""

    device: str
    threads: int = 1

    def __str__(self) -> str:
        return f"{self.device} x{self.threads}" if self.device == "cpu" else self.device


@dataclass(frozen=True)
class BackendOptions:
    """What is measured; the fields are the command's flags."""

    method: str = "delta-cones"
    quality: str = "balanced"
    settings: dict[str, str] = field(default_factory=dict)
    width: int = 640
    runs: int = 5
    warm_up: int = 1


def find_backends(devices: Sequence[str], threads: Sequence[int]) -> list[Backend]:
    """The backends to measure: cpu with each number of threads (1, 2, 4, … all by default), then CUDA devices (all that
    are present by default).

    Raises:
        OptionError: A number of threads below 1. DeviceError: A device that is not present.
    """
    import warp as wp

    from warp_dvct.launch import find_device

    cores = len(os.sched_getaffinity(0))
    counts = list(threads) or sorted({min(2**k, cores) for k in range(cores.bit_length() + 1)})
    if any(count < 1 for count in counts):
        raise OptionError(f"--threads is {min(counts)}; give a number of at least 1")
    names = list(devices) or ["cpu", *(d.alias for d in wp.get_cuda_devices())]
    for name in names:
        find_device(name)
    return [b for n in names for b in ([Backend(n, c) for c in counts] if n == "cpu" else [Backend(n)])]


def measure(
    stage: str,
    backends: Sequence[Backend],
    options: BackendOptions,
    report: Callable[[dict[str, Any]], None] = lambda row: None,
) -> list[dict[str, Any]]:
    """A row per backend: frames from scratch with a plate, after ``warm_up`` unmeasured ones.

    Args:
        stage: A bundled stage's name, or a USD file.
        report: Called with each row as it is done.
    Returns:
        Rows as ``docs/tradeoff.md`` lists them; ``parity`` is against the first backend's layers.
    Raises:
        OptionError: No backend, or ``runs`` below 2 (a spread needs two).
    """
    if options.runs < 2 or options.warm_up < 0:
        raise OptionError(f"--runs is {options.runs}; give at least 2, a spread needs two (and --warm-up of 0 or more)")
    if not backends:
        raise OptionError("there is no backend to measure; give --device cpu")
    scene = read(stage_file(stage))
    rows, base = [], None
    for backend in backends:
        row, layers = _measure_one(scene, backend, options)
        base = base or layers
        row = {"kind": KIND, "stage": Path(stage).stem, **row, "parity": parity(base, layers)}
        rows.append(row)
        report(row)
    return rows


def _measure_one(scene: Scene, backend: Backend, options: BackendOptions) -> tuple[dict[str, Any], Layers]:
    from warp_dvct.relighter import Relighter

    # One pass after the other, so that each has its own time.
    shared = {"method": options.method, "quality": options.quality, "settings": options.settings, "overlap": False}
    height = max(1, round(options.width / scene.camera.aspect))
    # A photograph stands in for the camera: grey, since its values decide neither light nor time.
    plate = np.full((height, options.width, 3), 0.5, np.float32)
    frames, compiled, layers = [], 0.0, None
    for run in range(-max(options.warm_up, 1), options.runs):
        relighter = Relighter(scene, width=options.width, device=backend.device, threads=backend.threads, **shared)
        layers = relighter.render(plate)
        compiled += relighter.stats["compile_seconds"]
        if run >= 0:
            frames.append(relighter.stats)
    assert layers is not None
    names = list(frames[0]["passes"])
    return {
        "method": options.method,
        "quality": options.quality,
        "settings": dict(options.settings),
        "width": layers.comp.shape[1],
        "height": layers.comp.shape[0],
        "backend": str(backend),
        "device": backend.device,
        "threads": backend.threads,
        "compile_seconds": compiled,
        "bytes": max(f["peak_bytes"] for f in frames),
        "seconds": [f["render_seconds"] for f in frames],
        "cpu_seconds": [f["cpu_seconds"] for f in frames],
        "passes": {n: [f["passes"].get(n, 0.0) for f in frames] for n in names},
        "cpu_passes": {n: [f["cpu_passes"].get(n, 0.0) for f in frames] for n in names},
    }, layers


def parity(base: Layers, other: Layers) -> dict[str, dict[str, float]]:
    """How far two backends' layers are apart.

    Returns:
        Per layer: ``largest`` and ``mean`` absolute difference over the picture, and, outside silhouettes, the
        ``largest_inside`` and the share of values ``beyond`` the tolerance: 1e-3 relative, or of the layer's mean.
    """
    smooth = ~silhouettes(base)
    return {name: _difference(getattr(base, name), getattr(other, name), smooth) for name in PARITY_LAYERS}


def _difference(a: np.ndarray, b: np.ndarray, smooth: np.ndarray) -> dict[str, float]:
    one, two = (np.asarray(v, np.float64).reshape(*smooth.shape, -1) for v in (a, b))
    one, two = (np.where(one == two, 0.0, v) for v in (one, two))  # infinite depth is equal to infinite depth
    apart = np.abs(one - two)
    finite = np.abs(a[np.isfinite(a)])
    level = float(finite.mean()) if finite.size else 0.0
    beyond = apart > TOLERANCE * np.maximum(np.maximum(np.abs(one), np.abs(two)), level)
    inside = apart[smooth]
    return {
        "largest": float(apart.max()),
        "mean": float(apart.mean()),
        "largest_inside": float(inside.max()) if inside.size else 0.0,
        "beyond": float(beyond[smooth].mean()) if inside.size else 0.0,
    }


def silhouettes(layers: Layers) -> np.ndarray:
    """Pixels where a ray that is off by a rounding error may meet another surface, bool ``[h, w]``: coverage, normal or
    depth change within the 3x3 pixels around."""
    depth = np.where(np.isfinite(layers.depth), layers.depth, 0.0)
    cover = _range(layers.mask_synthetic[..., None]) + _range(layers.mask_real[..., None])
    return (cover > 0) | (_range(layers.normal) > 0.1) | (_range(depth[..., None]) > 0.05 * np.maximum(depth, 1e-12))


def _range(values: np.ndarray) -> np.ndarray:
    padded = np.pad(values, ((1, 1), (1, 1), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), (0, 1))
    return (windows.max((-2, -1)) - windows.min((-2, -1))).max(-1)


def agree(row: dict[str, Any]) -> bool:
    """Whether a row's layers agree with the first backend's outside of silhouettes."""
    return all(layer["beyond"] == 0 for layer in row["parity"].values())


def compare(old: Sequence[dict[str, Any]], new: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Two runs' medians of processor time (of the clock on CUDA), pass by pass, where both have the same case.

    Returns:
        ``case``, ``pass``, ``old`` and ``new`` [s], ``ratio`` and ``verdict``: ``tie`` where the difference is inside
        the noise, else ``faster`` or ``slower``. The last of repeated cases counts.
    Raises:
        OptionError: No case is in both.
    """
    cases_old, cases_new = ({_case(row): row for row in rows if row["kind"] == KIND} for rows in (old, new))
    shared = [case for case in cases_new if case in cases_old]
    if not shared:
        raise OptionError("the two files have no case in common: stage, method, settings, size and backend must agree")
    verdicts = []
    for case in shared:
        a, b = cases_old[case], cases_new[case]
        prefix = "cpu_" if a["device"] == "cpu" else ""
        pairs = {"frame": (a[f"{prefix}seconds"], b[f"{prefix}seconds"])}
        both = [n for n in b[f"{prefix}passes"] if n in a[f"{prefix}passes"]]
        pairs |= {n: (a[f"{prefix}passes"][n], b[f"{prefix}passes"][n]) for n in both}
        label = " ".join(str(part) for part in case if part)
        verdicts += [{"case": label, "pass": name, **_verdict(*pair)} for name, pair in pairs.items()]
    return verdicts


def _case(row: dict[str, Any]) -> tuple[str, ...]:
    pairs = " ".join(f"{k}={v}" for k, v in sorted(row["settings"].items()))
    return row["stage"], row["method"], row["quality"], pairs, f"{row['width']}x{row['height']}", row["backend"]


def _verdict(old: Sequence[float], new: Sequence[float]) -> dict[str, Any]:
    a, b = median(old), median(new)
    noise = MEDIAN_ERROR * float(np.hypot(stdev(old) / len(old) ** 0.5, stdev(new) / len(new) ** 0.5))
    tie = abs(b - a) <= max(ERRORS_APART * noise, LEAST_DIFFERENCE * a)
    return {
        "old": a,
        "new": b,
        "ratio": b / a if a > 0 else 1.0,
        "verdict": "tie" if tie else ("faster" if b < a else "slower"),
    }


def format_rows(rows: Sequence[dict[str, Any]]) -> str:
    """A block per backend: seconds of each pass (median, least, spread), of the clock and of all threads; parity."""
    first, lines = rows[0], []
    pairs = "".join(f" {k}={v}" for k, v in first["settings"].items())
    lines.append(
        f"{first['stage']} {first['width']}x{first['height']}, {first['method']} {first['quality']}{pairs},"
        f" {len(first['seconds'])} frames from scratch with a plate; spread is the standard deviation"
    )
    if "machine" in first:
        lines.append(machine_line(first["machine"]) + f"; commit {first['commit']}")
    for row in rows:
        speed = median(first["seconds"]) / median(row["seconds"])
        lines.append(
            f"\n{row['backend']}: compile {row['compile_seconds']:.1f} s apart, peak {row['bytes'] / 2**20:.0f} MiB,"
            f" {speed:.2f} times as fast as {first['backend']}"
        )
        lines.append(f"{'ms':16}{'median':>10}{'least':>10}{'spread':>10}{'processor':>12}{'spread':>10}")
        for name, wall, cpu in [
            *((n, row["passes"][n], row["cpu_passes"][n]) for n in row["passes"]),
            ("frame", row["seconds"], row["cpu_seconds"]),
        ]:
            values = (median(wall), min(wall), stdev(wall), median(cpu), stdev(cpu))
            lines.append(
                f"{name:16}" + "".join(f"{1e3 * v:{w}.1f}" for v, w in zip(values, (10, 10, 10, 12, 10), strict=True))
            )
        lines.append(_parity_line(row, first))
    return "\n".join(lines)


def _parity_line(row: dict[str, Any], first: dict[str, Any]) -> str:
    if row is first:
        return "layers: the others are compared with these"
    if all(layer["largest"] == 0 for layer in row["parity"].values()):
        return f"layers: equal to those of {first['backend']} bit for bit"
    state = "agree" if agree(row) else "DIFFER"
    worst = "; ".join(
        f"{name} {v['largest']:.2g} ({v['mean']:.1g} in the mean, {100 * v['beyond']:.3f} % beyond)"
        for name, v in row["parity"].items()
        if v["largest"] > 0
    )
    return f"layers {state} to rtol {TOLERANCE:g} outside silhouettes; largest difference: {worst}"


def format_comparison(verdicts: Sequence[dict[str, Any]]) -> str:
    """A line per case and pass."""
    lines, case = [], None
    for v in verdicts:
        if v["case"] != case:
            case = v["case"]
            lines += [case, f"{'ms':16}{'old':>10}{'new':>10}{'ratio':>8}"]
        lines.append(f"{v['pass']:16}{1e3 * v['old']:10.1f}{1e3 * v['new']:10.1f}{v['ratio']:8.2f}  {v['verdict']}")
    return "\n".join(lines)

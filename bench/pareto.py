"""From points to statements: the front of what no other point beats, its picture, and what each knob buys in words."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from warp_dvct.errors import FileError, OptionError

SAME_TIME = 0.05  # of the time: repeated frames differ by as much
SAME_FLIP = 0.0004  # below it a difference is noise of the truth and of the gather
COLORS = {
    "delta-cones": "#1668b8",
    "instant-radiosity": "#2a8f4e",
    "path-trace": "#b8541a",
    "mitsuba": "#8a8a8a",
    "mitsuba-oidn": "#7b3fa0",
}
LABELS = {"mitsuba": "Mitsuba 3", "mitsuba-oidn": "Mitsuba 3, OIDN"}


def cost(row: Mapping[str, Any]) -> float:
    """A point's cost [s]: the least processor time of its frames on the CPU, of the clock on CUDA."""
    return min(row["cpu_seconds" if row["device"] == "cpu" else "seconds"])


def front(costs: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Indices of the points that no other beats in both, from cheap to dear; of equal points the first."""
    best: list[int] = []
    for i in sorted(range(len(costs)), key=lambda i: (costs[i], errors[i])):
        if not best or errors[i] < errors[best[-1]]:
            best.append(i)
    return best


def words(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A sentence per step of each knob, away from the preset's value: what it costs and what it saves.

    Args:
        rows: Of one stage and size, as ``bench tradeoff`` writes them.
    """
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["method"], row["group"]), []).append(row)
    sentences = []
    for (method, name), points in groups.items():
        if name in ("preset", "joint") or len(points) < 2:
            continue
        sentences += [f"{method}: {_step(name, a, b)}" for a, b in zip(points[1:], points[:-1], strict=True)]
    return sentences


def _step(name: str, dear: Mapping[str, Any], cheap: Mapping[str, Any]) -> str:
    """From the dearer value to the cheaper one."""
    old, new = dear["value"], cheap["value"]
    time = cost(cheap) / cost(dear) - 1.0
    a, b = dear["errors"]["FLIP"]["picture"], cheap["errors"]["FLIP"]["picture"]
    saved = (
        "changes the time by less than 5 %"
        if abs(time) < SAME_TIME
        else (f"saves {-100 * time:.0f} % of the time" if time < 0 else f"takes {100 * time:.0f} % more time")
    )
    if abs(b - a) < SAME_FLIP:
        paid = f"changes FLIP by less than {SAME_FLIP:g} ({a:.4f})"
    else:
        paid = f"{'costs' if b > a else 'gains'} {abs(b - a):.4f} FLIP ({a:.4f} to {b:.4f})"
    return f"{_verb(old, new)} {name} from {old} to {new} {paid}, {saved}"


def _verb(old: str, new: str) -> str:
    try:
        ratio = float(new) / float(old)
    except (ValueError, ZeroDivisionError):
        return "changing"
    return {0.5: "halving", 2.0: "doubling", 0.25: "quartering", 4.0: "quadrupling"}.get(ratio, "changing")


def _plain_ticks(axes: Any) -> None:
    """Label the logarithmic axes by 0.02, 0.05, 0.1 instead of by powers of ten."""
    ticker = importlib.import_module("matplotlib.ticker")
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        subs = (1, 2, 5) if high > 8 * low else (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8)
        axis.set_major_locator(ticker.LogLocator(subs=subs, numticks=20))
        axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(ticker.NullFormatter())


def draw(rows: Sequence[Mapping[str, Any]], file: Path) -> list[Path]:
    """Draw points and fronts of one stage into ``file`` with the endings ``.svg`` and ``.png``; returns both.

    Raises:
        OptionError: matplotlib is not installed. FileError: A file cannot be written.
    """
    try:
        matplotlib = importlib.import_module("matplotlib")
    except ImportError as error:
        raise OptionError("the fronts need matplotlib: pip install 'warp-dvct[bench]'") from error
    matplotlib.use("Agg")
    plt = importlib.import_module("matplotlib.pyplot")
    figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    for method in dict.fromkeys(r["method"] for r in rows):
        own = [r for r in rows if r["method"] == method]
        x, y = [cost(r) for r in own], [r["errors"]["FLIP"]["picture"] for r in own]
        color, label = COLORS.get(method, "#333333"), LABELS.get(method, method)
        best = front(x, y)
        axes.plot(x, y, ".", color=color, alpha=0.35, markersize=6)
        axes.plot([x[i] for i in best], [y[i] for i in best], "-o", color=color, markersize=4, label=label)
        for r in own:
            if r["group"] == "preset":
                place = (cost(r), r["errors"]["FLIP"]["picture"])
                axes.annotate(r["value"], place, xytext=(4, 4), textcoords="offset points", fontsize=8, color=color)
    noise = rows[0]["truth"]["noise"]
    axes.axhline(noise, color="#999999", linewidth=0.8, linestyle=":")
    where = axes.get_yaxis_transform()  # along x a share of the width
    axes.text(0.01, noise, "the truth's own noise", transform=where, fontsize=7, color="#777777", va="bottom")
    axes.set(xscale="log", yscale="log", xlabel="processor time of a frame [s]", ylabel="LDR-FLIP, mean of the picture")
    _plain_ticks(axes)
    axes.set_title(
        f"{rows[0]['stage']}, {rows[0]['width']} x {rows[0]['height']}, {rows[0]['truth']['bounces']} bounces"
    )
    axes.grid(True, which="both", linewidth=0.3)
    axes.legend(fontsize=8)
    written = [file.with_suffix(ending) for ending in (".svg", ".png")]
    try:
        for target in written:
            temporary = target.with_name(f".{target.stem}.tmp{target.suffix}")
            figure.savefig(temporary, dpi=110, metadata={"Date": None} if target.suffix == ".svg" else None)
            temporary.replace(target)
    except OSError as error:
        raise FileError(f"{file} cannot be written: {error.strerror or error}") from error
    finally:
        plt.close(figure)
    return written

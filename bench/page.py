"""The page of a sweep: fronts, passes, pictures and commands in one file that needs no network."""

from __future__ import annotations

import base64
import importlib
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.bench.pareto import COLORS, LABELS, cost, front, words
from warp_dvct.bench.pictures import FOLDER
from warp_dvct.bench.rows import machine_line, plain
from warp_dvct.errors import FileError, OptionError
from warp_dvct.image import write_text

TEMPLATE = Path(__file__).with_name("page.html")
JPEG_QUALITY = 88


def write_page(
    folder: Path, out: Path, stages: Mapping[str, Sequence[Mapping[str, Any]]], commands: Sequence[str]
) -> Path:
    """Write ``folder/index.html``.

    Args:
        out: Folder of the sweep, in which the pictures lie.
        stages: Rows of ``bench tradeoff`` by stage.
        commands: That repeat the measurement.
    Raises:
        OptionError: There is no row to show, or Pillow is missing. FileError: The page cannot be written.
    """
    shown = {name: rows for name, rows in stages.items() if rows}
    if not shown:
        raise OptionError(f"there is nothing to show in {out}; measure something with bench tradeoff first")
    rows = [row for stage in shown.values() for row in stage]
    content = {
        "cost": "processor time" if rows[0]["device"] == "cpu" else "time",
        "stages": [_stage(name, own, out) for name, own in shown.items()],
        "machine": _machine(rows),
        "commands": list(commands),
    }
    # Inside of a script element only "</" could end it.
    text = json.dumps(plain(content), allow_nan=False).replace("</", "<\\/")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        page = TEMPLATE.read_text(encoding="utf-8").replace("/*DATA*/", text)
    except OSError as error:
        raise FileError(f"the page cannot be made in {folder}: {error.strerror or error}") from error
    write_text(folder / "index.html", page)
    return folder / "index.html"


def _stage(name: str, rows: Sequence[Mapping[str, Any]], out: Path) -> dict[str, Any]:
    every = rows
    rows = list({row["key"]: row for row in reversed(rows)}.values())[
        ::-1
    ]  # a picture may be a point of several sweeps
    first, methods = rows[0], list(dict.fromkeys(r["method"] for r in rows))
    on_front: set[str] = set()
    for method in methods:
        own = [r for r in rows if r["method"] == method]
        on_front |= {
            own[i]["key"] for i in front([cost(r) for r in own], [r["errors"]["FLIP"]["picture"] for r in own])
        }
    pictures: dict[str, str] = {}
    options = [("truth", "truth"), ("before", "before (the plate)")]
    for key in ("truth", "before"):
        pictures[key] = _embed(out / FOLDER / f"{name}_{key}.png")
    points = []
    for row in sorted(rows, key=cost):
        point = {k: row[k] for k in ("name", "method", "group", "value", "quality", "settings", "errors", "flicker")}
        point |= {"bytes": row["bytes"], "passes": row["cpu_passes"] or row["passes"], "cost": cost(row)}
        point |= {"flip": row["errors"]["FLIP"]["picture"], "front": row["key"] in on_front}
        point["color"] = COLORS.get(row["method"], "#333333")
        # Pictures of what nobody would choose would only make the page heavy.
        if (point["front"] or row["group"] == "preset") and (out / FOLDER / f"{row['key']}.png").is_file():
            point |= {"picture": row["key"], "map": f"{row['key']}_flip"}
            for key in (point["picture"], point["map"]):
                pictures[key] = _embed(out / FOLDER / f"{key}.png")
            options.append((row["key"], row["name"]))
        points.append(point)
    truth = first["truth"]
    return {
        "name": name,
        "title": f"{name}, {first['width']} x {first['height']} pixels; truth of {truth['samples']} samples a pixel and"
        f" {truth['bounces']} bounces, whose own noise is FLIP {truth['noise']:.4f}",
        "methods": [{"name": m, "label": LABELS.get(m, m), "color": COLORS.get(m, "#333333")} for m in methods],
        "points": points,
        "pictures": {key: value for key, value in pictures.items() if value},
        "shown": [option for option in options if pictures.get(option[0])],
        "words": words(every),
    }


def _machine(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = dict.fromkeys(machine_line(r["machine"]) for r in rows)
    versions = dict.fromkeys(", ".join(f"{k} {v}" for k, v in r["versions"].items()) for r in rows)
    commits = ", ".join(dict.fromkeys(str(r["commit"]) for r in rows))
    times = sorted(r["time"] for r in rows)
    return [*lines, *versions, f"commit {commits}; measured from {times[0]} to {times[-1]}"]


def _embed(file: Path) -> str:
    """A PNG as a data URI of a JPEG; empty where there is no such file.

    Raises:
        FileError: It cannot be read. OptionError: Pillow is not installed.
    """
    if not file.is_file():
        return ""
    try:
        image = importlib.import_module("PIL.Image")
    except ImportError as error:
        raise OptionError("the page needs Pillow: pip install 'warp-dvct[bench]'") from error
    try:
        pixels = np.asarray(image.open(file).convert("RGB"))
    except OSError as error:
        raise FileError(f"{file} cannot be read: {error}; remove it and measure again") from error
    target = io.BytesIO()
    image.fromarray(pixels).save(target, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(target.getvalue()).decode()

"""Figure 3 of Franke 2014 from our own renders: the delta formulation beside cone tracing with one volume for all.

Left the composite before + delta, then the same scene with its objects among the real ones (one volume, no delta), then
the difference E of eq. 9, squared and enhanced, as the paper draws it: where the delta takes away too much light red to
yellow, where it leaves too much blue to white. Everything is rendered by cones with the same boxes and maps.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.bench.delta_error import FORMS
from warp_dvct.bench.error import read, stage_file
from warp_dvct.device_scene import DeviceScene
from warp_dvct.errors import FileError, OptionError
from warp_dvct.launch import Launcher
from warp_dvct.methods.delta_cone_tracing import render
from warp_dvct.methods.light_field import light_volumes
from warp_dvct.metrics import to_display
from warp_dvct.passes.composite import composite
from warp_dvct.plan import Plan, make_plan
from warp_dvct.scene import Role, Scene
from warp_dvct.settings import make_settings

STAGES = {"diffuse": "room_area", "glossy": "room_glossy"}
SHOWN = ("split", "dual")
ENHANCED = 256.0  # the paper has 16; ours would hardly show
# Without edge points: their shadow samples are other ones in the two pictures, which would be most of E.
EXACT = {"bounces": 1, "antialias": 0}
CONES = {"gather": "cones", "gather.stride": 1, "gather.object_stride": 1, "glossy": "cones", **EXACT}


@dataclass(frozen=True)
class Panel:
    """One surface kind and one form: the composite, one volume for all, and eq. 9's figures.

    Attributes:
        rms, worst: Of E over the mean of the picture with one volume.
    """

    kind: str
    form: str
    delta: np.ndarray
    whole: np.ndarray
    rms: float
    worst: float

    @property
    def error(self) -> np.ndarray:
        """E = Cρ - (Cµ + C∆) of eq. 9, as radiance."""
        return self.whole - self.delta


def panels(launcher: Launcher, *, width: int, quality: str = "balanced") -> list[Panel]:
    """Both surface kinds by both forms of the delta.

    Raises:
        OptionError: ``width`` below 16.
    """
    if width < 16:
        raise OptionError(f"--width is {width}; give at least 16")
    made = []
    for kind, stage in STAGES.items():
        scene = read(stage_file(stage))
        together = replace(scene, meshes=tuple(replace(m, role=Role.REAL) for m in scene.meshes))
        for form in SHOWN:
            settings = make_settings(quality, {**CONES, **FORMS[form]})
            plan = make_plan(scene, settings, "delta-cones", width, max(1, round(width / scene.camera.aspect)))
            delta = _picture(launcher, scene, plan).comp
            whole = _picture(launcher, together, plan).plate
            error, level = whole.astype(np.float64) - delta, float(whole.mean())
            rms = float(np.sqrt((error**2).mean())) / level
            made.append(Panel(kind, form, delta, whole, rms, float(np.abs(error).max()) / level))
    return made


def _picture(launcher: Launcher, scene: Scene, plan: Plan) -> Any:
    device_scene = DeviceScene.upload(launcher, scene, np.asarray(plan.origin), plan.scale)
    lit = light_volumes(launcher, scene, device_scene, plan)
    return composite(launcher, render(launcher, scene, device_scene, lambda: lit, plan, with_before=True), None)


def signed_colors(error: np.ndarray) -> np.ndarray:
    """E², enhanced, of the channels' mean, ``[h, w, 3]``: red to yellow where the delta takes too much, that is where E
    is positive, blue to white where it leaves too much."""
    mean = error.mean(-1)
    size = np.clip(ENHANCED * mean**2, 0.0, 1.0)[..., None]
    root = np.sqrt(size)
    # Dark to bright: red to yellow, and blue to white.
    hot = np.concatenate([root, size, np.zeros_like(root)], -1)
    cold = np.concatenate([size, size, root], -1)
    return np.where(mean[..., None] > 0, hot, cold)


def draw(made: list[Panel], file: Path) -> None:
    """The figure: a row per surface kind; composite, one volume, and the error of each form.

    Raises:
        OptionError: matplotlib is not installed. FileError: The file cannot be written.
    """
    try:
        importlib.import_module("matplotlib").use("Agg")
    except ImportError as error:
        raise OptionError("the figure needs matplotlib: pip install 'warp-dvct[bench]'") from error
    plt = importlib.import_module("matplotlib.pyplot")
    kinds = list(dict.fromkeys(p.kind for p in made))
    figure, axes = plt.subplots(len(kinds), 4, figsize=(13, 2.1 * len(kinds)), layout="constrained", squeeze=False)
    for row, kind in zip(axes, kinds, strict=True):
        split, dual = (next(p for p in made if p.kind == kind and p.form == form) for form in SHOWN)
        pictures = [
            (f"{kind}: before + delta (split)", to_display(split.delta)),
            ("one volume for the whole scene", to_display(split.whole)),
            (f"E² · {ENHANCED:g}, split: rms E {split.rms:.2%}", signed_colors(split.error)),
            (f"E² · {ENHANCED:g}, dual: rms E {dual.rms:.2%}", signed_colors(dual.error)),
        ]
        for axis, (title, picture) in zip(row, pictures, strict=True):
            axis.imshow(np.clip(picture, 0.0, 1.0))
            axis.set_title(title, fontsize=9)
            axis.set_axis_off()
    temporary = file.with_name(f".{file.stem}.tmp{file.suffix}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(temporary, dpi=110)
        temporary.replace(file)
    except OSError as error:
        raise FileError(f"{file} cannot be written: {error.strerror or error}") from error
    finally:
        plt.close(figure)


def format_panels(made: list[Panel]) -> str:
    """A line per surface kind and form."""
    lines = [f"{'surfaces':10}{'form':8}{'rms E':>10}{'max |E|':>10}   over the mean picture; E = Cρ - (Cµ + C∆)"]
    lines += [f"{p.kind:10}{p.form:8}{p.rms:10.2e}{p.worst:10.2e}" for p in made]
    return "\n".join(lines)

"""What a trade-off sweep tries: for every method the knobs that matter, one at a time around the balanced preset."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from warp_dvct.bench.sweep import CURVE
from warp_dvct.errors import OptionError
from warp_dvct.settings import NAMES, PRESETS, QUALITIES, make_settings

CONES = {"gather": "cones"}


@dataclass(frozen=True)
class Knob:
    """One knob of one method, turned alone.

    Attributes:
        name: As it is called in tables; the first of ``keys``.
        values: From cheap to dear. Each sets all of ``keys``, or, as ``a/b``, one after the other.
        keys: The settings that it moves together. given: Settings without which it does nothing.
        only_glossy: Whether it does something only where the scene has glossy surfaces.
    """

    method: str
    name: str
    values: tuple[str, ...]
    keys: tuple[str, ...] = ()
    given: Mapping[str, str] = field(default_factory=dict)
    only_glossy: bool = False

    def settings(self, value: str) -> dict[str, str]:
        """What a value sets, with what is given."""
        keys = self.keys or (self.name,)
        parts = value.split("/")
        if len(parts) not in (1, len(keys)):
            raise OptionError(f"{self.name}={value}: {len(keys)} values are expected, or one for all")
        return {**self.given, **dict(zip(keys, parts * (len(keys) // len(parts)), strict=True))}


KNOBS = (
    Knob("delta-cones", "volume.resolution", ("32", "64", "128", "256", "512")),
    Knob("delta-cones", "volume.coarse", ("32", "64", "128", "256")),
    Knob("delta-cones", "rsm.texels", ("128", "256", "512", "1024")),
    Knob("delta-cones", "rsm.density", ("0.5", "1", "2", "3")),
    Knob("delta-cones", "gather.rays", ("16", "32", "64", "128", "256"), ("gather.rays", "gather.object_rays")),
    Knob(
        "delta-cones",
        "gather.stride",
        ("12/6", "8/4", "6/3", "4/2", "2/1", "1/1"),
        ("gather.stride", "gather.object_stride"),
    ),
    Knob("delta-cones", "shadows.samples", ("1", "4", "8", "16", "64"), ("shadows.samples", "shadows.probes")),
    Knob("delta-cones", "shadows", ("cone", "ray")),
    Knob("delta-cones", "gather", ("cones", "rays")),
    Knob("delta-cones", "cones.count", ("4", "6", "9", "16", "36"), given=CONES),
    Knob("delta-cones", "cones.aperture", ("90", "60", "40", "20"), given=CONES),
    Knob("delta-cones", "cones.step", ("2", "1", "0.5", "0.25"), given=CONES),
    Knob("delta-cones", "glossy.rays", ("1", "2", "8", "32"), only_glossy=True),
    Knob("delta-cones", "glossy", ("cones", "rays"), only_glossy=True),
    Knob("delta-cones", "bounces", ("0", "1", "2", "4", "6", "12")),
    Knob("delta-cones", "patches.count", ("1024", "8192", "32768")),
    Knob("delta-cones", "antialias", ("0", "4", "16")),
    Knob("instant-radiosity", "vpls.count", ("64", "128", "256", "512", "1024"), ("vpls.count", "vpls.sky")),
    Knob("instant-radiosity", "vpls.further", ("32", "64", "128", "256")),
    Knob("instant-radiosity", "vpls.tiles", ("8", "4", "2", "1")),
    Knob("instant-radiosity", "ism.size", ("32", "64", "128", "256")),
    Knob("instant-radiosity", "ism.points", ("256", "512", "1024", "4096")),
    Knob("instant-radiosity", "visibility", ("ism", "ray")),
    Knob("instant-radiosity", "bounces", ("0", "1", "2", "4", "6")),
    Knob("path-trace", "samples", ("1", "2", "4", "8", "16", "32", "64"), given={"seed": "77"}),
)
METHODS = tuple(dict.fromkeys(knob.method for knob in KNOBS))


@dataclass(frozen=True)
class Trial:
    """One point of a sweep.

    Attributes:
        group: ``preset``, ``joint`` (every knob turned up together), or a knob's name. value: Its value, as text.
        settings: Over the quality's preset.
    """

    method: str
    group: str
    value: str
    quality: str = "balanced"
    settings: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """For tables and pages."""
        return f"{self.method} {self.value}" if self.group == "preset" else f"{self.method} {self.group}={self.value}"


def choose_trials(
    methods: Sequence[str], chosen: Sequence[str], bounces: int, glossy: bool
) -> tuple[list[Trial], list[str]]:
    """The points to measure on a stage.

    Args:
        methods: Of ``METHODS``; empty for all.
        chosen: Knobs by name, ``preset`` or ``joint``, or ``name=a,b,c`` with values of one's own; empty for all.
        bounces: Of every point but presets, and but those whose knob it is.
        glossy: Whether the stage has glossy surfaces.
    Returns:
        The points, each once in its group, and what was left out and why.
    Raises:
        OptionError: An unknown method or knob, a value outside its range, or nothing left to measure.
    """
    for method in methods:
        if method not in METHODS:
            raise OptionError(f"method is '{method}'; choose from {', '.join(METHODS)}")
    wanted = _parse(chosen)
    trials: dict[tuple, Trial] = {}
    left_out = []
    for method in methods or METHODS:
        known = len(trials) + len(left_out)
        for trial in _of_method(method, wanted, bounces):
            trials.setdefault(_identity(trial), trial)
        for knob in (k for k in KNOBS if k.method == method and (not wanted or k.name in wanted)):
            if knob.only_glossy and not glossy:
                left_out.append(f"{knob.name}: no surface of the stage is glossy")
                continue
            for value in wanted.get(knob.name) or knob.values:
                trial = Trial(method, knob.name, value, "balanced", {"bounces": str(bounces), **knob.settings(value)})
                make_settings(trial.quality, trial.settings, trial.method)  # a bad value is found before the work
                trials.setdefault(_identity(trial), trial)
        if methods and len(trials) + len(left_out) == known:
            left_out.append(f"{method}: it has none of {', '.join(wanted)}")
    if not trials:
        raise OptionError(f"the sweep is empty ({'; '.join(left_out)})")
    return list(trials.values()), left_out


def _of_method(method: str, wanted: Mapping[str, tuple[str, ...]], bounces: int) -> list[Trial]:
    """Presets and joint settings, and knobs of the user's own."""
    found = []
    if method != "path-trace" and (not wanted or "preset" in wanted):
        found += [Trial(method, "preset", q, q) for q in wanted.get("preset") or QUALITIES]
    if method == "delta-cones" and (not wanted or "joint" in wanted):
        steps = wanted.get("joint") or tuple(CURVE)
        for step in steps:
            if step not in CURVE:
                raise OptionError(f"joint={step}; choose from {', '.join(CURVE)}")
        found += [Trial(method, "joint", s, "balanced", {**CURVE[s], "bounces": str(bounces)}) for s in steps]
    known = {k.name for k in KNOBS if k.method == method} | {"preset", "joint"}
    elsewhere = {k.name for k in KNOBS}
    for name, values in wanted.items():
        if name in known or name in elsewhere or not values:
            continue
        for value in values:
            trial = Trial(method, name, value, "balanced", {"bounces": str(bounces), name: value})
            make_settings(trial.quality, trial.settings, trial.method)
            found.append(trial)
    return found


def _parse(chosen: Sequence[str]) -> dict[str, tuple[str, ...]]:
    known = dict.fromkeys(["preset", "joint", *(k.name for k in KNOBS)])
    wanted: dict[str, tuple[str, ...]] = {}
    for text in chosen:
        name, equals, values = (part.strip() for part in text.partition("="))
        listed = tuple(v.strip() for v in values.split(",") if v.strip())
        if name not in known and not (name in NAMES and equals):
            near = difflib.get_close_matches(name, [*known, *NAMES], 1, 0.4)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            own = " (a setting without a sweep of its own needs values, as NAME=A,B)" if name in NAMES else ""
            raise OptionError(f"there is no knob '{name}' to sweep{own}{hint}; sweeps: {', '.join(known)}")
        if equals and not listed:
            raise OptionError(f"--knob {text!r} names no value; the sweep is empty")
        if name == "preset" and not set(listed) <= set(PRESETS):
            raise OptionError(f"--knob {text!r}: presets are {', '.join(PRESETS)}")
        wanted[name] = listed
    return wanted


def _identity(trial: Trial) -> tuple:
    """Points of a group that would render the same picture for the same cost are one."""
    return trial.method, trial.group, make_settings(trial.quality, trial.settings, trial.method)

"""Every knob of every method: its name, default, range and presets.

Names are dotted (``volume.resolution``); as attributes of :class:`Settings` the dot is an underscore.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from warp_dvct.errors import OptionError

QUALITIES = ("draft", "balanced", "high")


def _knob(
    default: Any, help: str, *, low: float = -math.inf, high: float = math.inf, choices: tuple[str, ...] = ()
) -> Any:
    return field(default=default, metadata={"help": help, "low": low, "high": high, "choices": choices})


@dataclass(frozen=True)
class Settings:
    """All knobs, at their ``balanced`` values unless said otherwise; :func:`make_settings` applies presets."""

    seed: int = _knob(0, "seed of every random number", low=0, high=2**31 - 1)
    bounces: int = _knob(
        12,
        "indirect bounces: 0 direct light only, 1 the paper's single bounce (instant-radiosity: 4 draft, 6 balanced)",
        low=0,
        high=64,
    )
    antialias: int = _knob(8, "shading points per edge pixel; 0 for none", low=0, high=64)

    # Rays see no difference between these and the paper's 256: what shows is how many texels light a voxel.
    volume_resolution: int = _knob(64, "voxels an edge of the fine volume", low=1, high=1024)
    volume_scale: float = _knob(
        2.0, "edge of the fine volume over the synthetic bounding box's largest", low=1.0, high=1e3
    )
    volume_coarse: int = _knob(64, "voxels an edge of the volume around the fine one; 0 for none", low=0, high=1024)
    volume_reach: float = _knob(
        16.0,
        "largest edge of the coarse volume, in edges of the fine one; doubled where walls would be left out",
        low=1.0,
        high=1e4,
    )

    rsm_texels: int = _knob(1024, "most texels an edge of a reflective shadow map", low=1, high=8192)
    rsm_density: float = _knob(2.0, "texels per voxel edge at the volume's far side", low=0.01, high=16.0)

    shadows: str = _knob("ray", "how direct shadows are found", choices=("ray", "cone"))
    shadows_samples: int = _knob(8, "samples per light and shading point", low=1, high=4096)

    shadows_probes: int = _knob(
        8, "samples traced first; the others are traced only where these disagree", low=1, high=4096
    )

    gather: str = _knob("rays", "how diffuse indirect light is gathered", choices=("rays", "cones"))
    gather_rays: int = _knob(64, "rays per gather point on real surfaces", low=1, high=65536)
    gather_aimed: float = _knob(
        0.25,
        "on a plate: share of a real gather point's rays that are spread evenly where the objects take up little of its"
        " view; to these come up to three times as many towards the objects, by how much of it they take up; 0 for"
        " never",
        low=0.0,
        high=1.0,
    )
    gather_stride: int = _knob(8, "pixels between gather points on real surfaces; 1 for every pixel", low=1, high=64)
    gather_object_rays: int = _knob(64, "rays per gather point on synthetic surfaces", low=1, high=65536)
    gather_object_stride: int = _knob(4, "pixels between gather points on synthetic surfaces", low=1, high=64)
    gather_detail: float = _knob(
        0.15, "bound on the change within a stride beyond which it is halved; 0 for never", low=0.0, high=100.0
    )
    gather_change: float = _knob(
        0.02,
        "on a plate: least change of irradiance, as a share of it, for halving the stride; 0 for any",
        low=0.0,
        high=1.0,
    )
    gather_smoothing: int = _knob(1, "a-trous steps that smooth what rays gathered; 0 for none", low=0, high=6)
    gather_radius: int = _knob(1, "gather points to each side that reconstruction looks at", low=0, high=16)

    cones_count: int = _knob(9, "diffuse cones", low=4, high=36)
    cones_aperture: float = _knob(
        0.0, "full opening angle of a diffuse cone [degrees]; 0 by count", low=0.0, high=179.0
    )
    cones_step: float = _knob(1.0, "march step in voxels of the current level", low=0.05, high=8.0)
    cones_detail: float = _knob(0.5, "voxel edge over the cone's diameter", low=0.02, high=4.0)
    cones_start: float = _knob(1.5, "height above the surface at which a march starts [voxels]", low=0.0, high=64.0)
    cones_escape: str = _knob("ray", "what decides that a cone's rest is open", choices=("ray", "volume"))
    cones_filter: str = _knob("directional", "how the pyramid is filtered", choices=("directional", "isotropic"))
    cones_delta: str = _knob("dual", "both occupancies in one march, or the paper's V-delta", choices=("dual", "split"))
    cones_coverage: str = _knob("additive", "how coverage adds up along a cone", choices=("additive", "product"))

    glossy: str = _knob("rays", "how specular reflections are found", choices=("rays", "cones"))
    glossy_rays: int = _knob(8, "rays per shading point with a specular lobe", low=1, high=65536)
    glossy_smoothing: float = _knob(
        0.3, "width over which neighbours' rays are averaged, over that of the lobe's blur", low=0.0, high=4.0
    )
    glossy_roughness: float = _knob(0.7, "rougher lobes are folded into the diffuse gather", low=0.0, high=1.0)

    patches_count: int = _knob(8192, "about how many patches carry the second and further bounces", low=8, high=2**22)
    patches_rays: int = _knob(64, "rays per patch", low=1, high=65536)

    visibility: str = _knob(
        "ism", "how VPLs on surfaces see: imperfect shadow maps or exact rays", choices=("ism", "ray")
    )
    shadow_maps: str = _knob(
        "double", "maps of real and synthetic surfaces apart, or the single one of 2010", choices=("double", "single")
    )
    difference: str = _knob(
        "auto",
        "instant-radiosity: linear, or of the two tone-mapped solutions; auto: that where the plate's file is LDR",
        choices=("auto", "plain", "tonemapped"),
    )
    vpls_count: int = _knob(256, "virtual point lights of the first bounce", low=1, high=2**17)
    vpls_further: int = _knob(256, "virtual point lights of each further bounce", low=1, high=2**17)
    vpls_sky: int = _knob(256, "virtual point lights on the sky, where there is a dome", low=1, high=2**17)
    vpls_map: int = _knob(256, "texels an edge of the maps that VPLs are drawn from", low=1, high=4096)
    vpls_focus: float = _knob(0.7, "share of VPLs that go by nearness to synthetic objects", low=0.0, high=1.0)
    vpls_least: float = _knob(
        0.15, "least share of VPLs on synthetic surfaces and on real ones behind; 0 by area", low=0.0, high=0.4
    )
    vpls_clamp: float = _knob(
        0.5, "radius of a VPL's disc, over that of its share of surface; 0 for points", low=0.0, high=16.0
    )
    vpls_tiles: int = _knob(
        4, "edge of the tiles whose pixels share the VPLs out; 1 for all at every pixel", low=1, high=16
    )
    vpls_frames: int = _knob(
        1, "most frames that are averaged, each with its own VPLs, while only the camera moves", low=1, high=2**16
    )
    vpls_sources: int = _knob(8, "VPLs that a candidate for a further bounce tries", low=1, high=1024)
    vpls_slots: str = _knob("drawn", "which candidate gets a slot of a further bounce", choices=("drawn", "strongest"))
    ism_size: int = _knob(128, "texels an edge of an imperfect shadow map", low=8, high=2048)
    ism_points: int = _knob(1024, "points per map", low=1, high=2**20)
    ism_blocks: int = _knob(16, "different sets of points that the maps share", low=1, high=4096)
    ism_grow: float = _knob(1.3, "radius of a splat, over that of the surface its point stands for", low=0.1, high=8.0)
    ism_bias: float = _knob(0.08, "relative depth by which a blocker has to be nearer", low=0.0, high=1.0)

    samples: int = _knob(64, "path-trace: samples per pixel", low=1, high=2**20)


PRESETS: dict[str, dict[str, Any]] = {
    "draft": {
        "volume.resolution": 32,
        "volume.coarse": 32,
        "rsm.texels": 240,
        "antialias": 2,
        "shadows.samples": 4,
        "shadows.probes": 4,
        "gather.rays": 16,
        "gather.detail": 0.0,
        "gather.aimed": 0.375,
        "gather.object_rays": 16,
        "glossy.rays": 2,
        "glossy.smoothing": 0.5,
        "patches.count": 2048,
        "patches.rays": 32,
        "samples": 16,
    },
    "balanced": {},
    "high": {
        "rsm.density": 3,
        "shadows.samples": 32,
        "shadows.probes": 16,
        "rsm.texels": 1024,
        "gather.rays": 128,
        "gather.stride": 4,
        "gather.object_rays": 192,
        "gather.object_stride": 2,
        "glossy.rays": 32,
        "glossy.smoothing": 0.2,
        "patches.count": 16384,
        "patches.rays": 128,
        "samples": 512,
    },
}

# Over the presets: there each bounce takes shadow maps of its own, where links between patches cost nothing.
PRESETS_OF: dict[str, dict[str, dict[str, Any]]] = {
    "instant-radiosity": {"draft": {"bounces": 4}, "balanced": {"bounces": 6}},
}

_FIELDS = {f.name: f for f in fields(Settings)}
# A dot stands only where the first word names a group, so that ``gather_object_rays`` is ``gather.object_rays``.
UNGROUPED = {"shadow_maps"}
NAMES = {f if f in UNGROUPED else f.replace("_", ".", 1): f for f in _FIELDS}


def make_settings(
    quality: str = "balanced", overrides: Mapping[str, Any] | None = None, method: str = "delta-cones"
) -> Settings:
    """Settings of a method's preset with single knobs changed.

    Args:
        quality: ``draft``, ``balanced`` or ``high``.
        overrides: Dotted names to values; strings are converted.
    Raises:
        OptionError: An unknown quality or knob (the nearest is suggested), or a value outside its range.
    """
    if quality not in QUALITIES:
        raise OptionError(f"quality is '{quality}'; choose one of {', '.join(QUALITIES)}")
    values: dict[str, Any] = {}
    of_method = PRESETS_OF.get(method, {}).get(quality, {})
    for name, value in {**PRESETS[quality], **of_method, **dict(overrides or {})}.items():
        if name not in NAMES:
            near = difflib.get_close_matches(name, NAMES, 1, 0.4)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise OptionError(f"there is no setting '{name}'{hint} (all: {', '.join(NAMES)})")
        values[NAMES[name]] = _convert(name, value)
    return replace(Settings(), **values)


def _convert(name: str, value: Any) -> Any:
    knob = _FIELDS[NAMES[name]]
    kind = type(knob.default)
    try:
        converted = kind(value) if not (kind is int and isinstance(value, float) and value != int(value)) else None
    except (TypeError, ValueError, OverflowError):
        converted = None
    if converted is None:
        raise OptionError(f"{name}={value!r} is not {'a whole number' if kind is int else 'a number'}")
    if knob.metadata["choices"]:
        if converted not in knob.metadata["choices"]:
            raise OptionError(f"{name}={value!r}; choose one of {', '.join(knob.metadata['choices'])}")
    elif not knob.metadata["low"] <= converted <= knob.metadata["high"]:
        raise OptionError(f"{name}={value} is outside {knob.metadata['low']:g} … {knob.metadata['high']:g}")
    return converted


def describe_settings() -> str:
    """One line per knob: name, default, range or choices, meaning."""
    lines = []
    for name, attribute in NAMES.items():
        knob = _FIELDS[attribute]
        meta = knob.metadata
        span = "|".join(meta["choices"]) if meta["choices"] else f"{meta['low']:g}…{meta['high']:g}"
        lines.append(f"{name}={knob.default} ({span}): {meta['help']}")
    return "\n".join(lines)

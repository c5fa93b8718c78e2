"""From a capture to a stage that relights: surface, light, albedo."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.capture.enclosure import Enclosure, find_enclosure
from warp_dvct.capture.frames import FrameSource, Skipped
from warp_dvct.capture.fusion import FusedMesh, FusionOptions, fuse
from warp_dvct.capture.scene_stage import SceneLights, refuse_overwriting, write_scene
from warp_dvct.capture.stage import Capture
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.scene import Camera, Light, LightKind, LightRole

ALBEDOS = ("irradiance", "color")
UNSEEN = ("auto", "room", "dome", "none")
TOO_BRIGHT = 0.1  # share of vertices that would reflect more than they receive, from which it is said
FUSION_SHARE = 0.6  # of the progress bar


@dataclass(frozen=True)
class ReconstructOptions:
    """What to make of a capture.

    Attributes:
        fusion: How frames become a surface.
        albedo: ``irradiance`` divides the photographs by the light that fell on the surface; ``color`` takes the
            camera's colour, as Knecht 2012 does.
        probe: USD file with the real scene's lights.
        estimate_light: Fit the light to the shading, whatever lights the capture has.
        light: False to leave the light alone; albedo then is ``color``.
        unseen: What stands for the parts that no frame has seen, where lamps are known and no dome is: ``room`` for a
            box around the scan, ``dome`` for even light, ``none`` for darkness; ``auto`` for a room where the scan
            looks like that of one, else a dome.
        seed: Of every random choice.
    """

    fusion: FusionOptions = field(default_factory=FusionOptions)
    albedo: str = "irradiance"
    probe: str | None = None
    estimate_light: bool = False
    light: bool = True
    unseen: str = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value, choices in (("albedo", self.albedo, ALBEDOS), ("unseen", self.unseen, UNSEEN)):
            if value not in choices:
                raise OptionError(f"{name} is '{value}'; choose one of {', '.join(choices)}")


@dataclass(frozen=True)
class Reconstruction:
    """What was made: the surface, and lines for the user about light and albedo."""

    mesh: FusedMesh
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Lit:
    lights: tuple[Light, ...]
    authored: SceneLights
    notes: tuple[str, ...]
    enclosure: Enclosure | None = None


def reconstruct(
    capture: Capture,
    source: FrameSource,
    output: str | Path,
    options: ReconstructOptions,
    *,
    poses: Sequence[np.ndarray | None] | None = None,
    skipped: Skipped | None = None,
    device: str = "cpu",
    threads: int | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Reconstruction:
    """Fuse a capture, find its light and albedo, and write the scene.

    Args:
        capture: The opened stage. source: Its frames.
        output: USD file; what is there is replaced at the very end.
        poses: Where they are not the capture's own; written into the scene.
        skipped: Frames that are left out already.
    Raises:
        FileError, OptionError, StageError, DeviceError: As the steps say.
    """
    report = progress or (lambda name, share: None)
    _check_files(capture, output, options)
    mesh = fuse(
        source,
        options.fusion,
        threads=threads,
        progress=lambda name, share: report(name, FUSION_SHARE * share),
        skipped=skipped,
    )
    notes: tuple[str, ...] = ()
    authored, enclosure = None, None
    if options.light and mesh.colors is None and options.probe is not None:
        authored, notes = SceneLights(file=options.probe), ("no photographs: the surface is grey",)
    elif options.light and mesh.colors is None:
        notes = ("no photographs: the surface is grey and there is no light; give --probe LIGHTS.usda",)
    elif options.light:
        launcher = Launcher(device, threads)
        report("light", FUSION_SHARE)
        eyes = [pose[:3, 3] for pose in (poses or map(capture.pose, capture)) if pose is not None]
        lit = _find_light(launcher, capture, mesh, np.array(eyes), options)
        authored, notes, enclosure = lit.authored, lit.notes, lit.enclosure
        if options.albedo == "irradiance" and lit.lights:
            mesh, more = _with_albedo(launcher, mesh, lit, options, threads, report)
            notes = (*notes, *more)
    write_scene(
        output,
        capture,
        mesh,
        lights=authored,
        enclosure=enclosure,
        poses=poses,
        facts={"voxel": options.fusion.voxel, "albedo": options.albedo if authored else "color"},
    )
    return Reconstruction(mesh, notes)


def _check_files(capture: Capture, output: str | Path, options: ReconstructOptions) -> None:
    """Say at once what would fail after the work."""
    from warp_dvct.usd.stage import open_stage

    refuse_overwriting(capture, output)
    if options.probe is not None:
        open_stage(options.probe)


def _find_light(
    launcher: Launcher, capture: Capture, mesh: FusedMesh, eyes: np.ndarray, options: ReconstructOptions
) -> _Lit:
    """The probe's, else the capture's own, else an estimate; and, where no dome is known, what was not seen."""
    from warp_dvct.capture.light_fit import fit_light
    from warp_dvct.usd.read import read_stage

    voxel = options.fusion.voxel
    known: tuple[Light, ...] = ()
    if not options.estimate_light:
        eye = Camera(np.eye(4), -1.0, 1.0, -1.0, 1.0)
        file, time = (options.probe, None) if options.probe else (capture.path, capture.times[0])
        scene = read_stage(file, time=time, view=eye, allow_empty_roles=True, allow_no_light=True)
        known = tuple(light for light in scene.lights if light.role == LightRole.PLATE)
        if options.probe is not None and not known:
            raise OptionError(f"--probe '{options.probe}' has no light that lights the photographs")
    if not known:
        try:
            fit = fit_light(launcher, mesh, voxel=voxel, seed=options.seed)
        except OptionError as error:
            if options.estimate_light:
                raise
            return _Lit((), SceneLights(), (f"no light: {error}",))
        values = [float(v) for v in fit.singular_values]
        facts: dict[str, Any] = {
            "condition": fit.condition,
            "singularValues": values,
            "directionSpread": float(np.degrees(fit.spread)),
            "residual": fit.residual,
        }
        return _Lit(fit.lights(), SceneLights(estimated=fit.probe(), facts=facts), fit.describe())
    return _with_unseen(launcher, mesh, known, eyes, options)


def _with_unseen(
    launcher: Launcher, mesh: FusedMesh, known: tuple[Light, ...], eyes: np.ndarray, options: ReconstructOptions
) -> _Lit:
    """Known lights, and what stands for the parts that no frame has seen."""
    from warp_dvct.capture.light_fit import fit_fill

    voxel, file = options.fusion.voxel, options.probe
    if options.unseen == "none" or any(light.kind == LightKind.DOME for light in known):
        return _Lit(known, SceneLights(file=file), ())
    if options.unseen != "dome":
        enclosure = find_enclosure(mesh, eyes, known, voxel=voxel, asked=options.unseen == "room")
        if enclosure is not None:
            return _Lit(known, SceneLights(file=file), (enclosure.describe(),), enclosure)
    fill = fit_fill(launcher, mesh, known, voxel=voxel, seed=options.seed)
    level = " ".join(f"{c:.3g}" for c in fill)
    dome = Light(LightKind.DOME, (float(fill[0]), float(fill[1]), float(fill[2])), path="/Lights/Unseen")
    note = f"what no frame has seen is taken to have the radiance {level} (Lights/Unseen)"
    return _Lit((*known, dome), SceneLights(file=file, fill=fill), (note,))


def _with_albedo(
    launcher: Launcher,
    mesh: FusedMesh,
    lit: _Lit,
    options: ReconstructOptions,
    threads: int | None,
    report: Callable[[str, float], None],
) -> tuple[FusedMesh, tuple[str, ...]]:
    from warp_dvct.capture.albedo import estimate_albedo

    albedo = estimate_albedo(
        launcher,
        mesh,
        lit.lights,
        voxel=options.fusion.voxel,
        enclosure=lit.enclosure,
        threads=threads,
        progress=lambda name, share: report(name, FUSION_SHARE + (1.0 - FUSION_SHARE) * (0.3 + 0.7 * share)),
    )
    notes: tuple[str, ...] = ()
    if albedo.bright > TOO_BRIGHT:
        notes = (
            f"{albedo.bright:.0%} of the surface would reflect more light than falls on it: the lights are too dim for"
            " the photographs, or too few; raise the probe's --exposure",
        )
    return replace(mesh, colors=albedo.values), notes

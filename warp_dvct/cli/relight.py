"""``warp-dvct relight``: the main job, from stage to layered EXR and preview."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from warp_dvct.cli.frames import frame_path, has_placeholder, lost_frame
from warp_dvct.cli.options import keep_budget, stage_options
from warp_dvct.cli.progress import Progress
from warp_dvct.cli.quiet import start_warp
from warp_dvct.errors import FileError
from warp_dvct.image import check_writable, is_display_referred, read_plate, write_exr, write_png, write_text

if TYPE_CHECKING:
    from warp_dvct.budget import Choice
    from warp_dvct.capture.live import LiveSource
    from warp_dvct.launch import Launcher
    from warp_dvct.layers import Layers
    from warp_dvct.relighter import Relighter

NOTICES_SHOWN = 20


class Stops(click.ParamType):
    """An exposure in stops; finite, and small enough that its power of two is."""

    name = "stops"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Refuse what is no number in [-64, 64]."""
        try:
            stops = float(value)
        except ValueError:
            stops = float("nan")
        if not abs(stops) <= 64.0:
            self.fail(f"'{value}' is not a number between -64 and 64", param, ctx)
        return stops


@click.command()
@click.argument("stage")
@click.argument("output")
@click.option(
    "--frames",
    "-f",
    metavar="SPEC",
    help="Time codes to render, as 101:110, 101:110x2 or 1,5,9; OUTPUT then needs #### where the number goes.",
)
@click.option("--plate", metavar="FILE", help="Photograph to composite on; #### takes the frame number.")
@click.option("--skip-existing", is_flag=True, help="Leave out frames whose EXR is there: go on with a broken-off run.")
@click.option("--stats", metavar="FILE", help="Write seconds, memory, plan and notices as JSON.")
@click.option(
    "--check",
    is_flag=True,
    help="Stop at the first NaN, infinity or value out of its range that a pass writes, and say where. Slower.",
)
@click.option(
    "--exposure",
    type=Stops(),
    default=0.0,
    show_default=True,
    metavar="STOPS",
    help="Of the preview; +1 is twice as bright.",
)
@click.option(
    "--tonemap",
    "curve",
    type=click.Choice(["srgb", "filmic"]),
    default="srgb",
    show_default=True,
    help="Curve of the preview. srgb shows a photograph unchanged.",
)
@click.option(
    "--real-from",
    metavar="CAPTURE",
    help="Take the real scene, camera and plates from a capture's depth images, frame by frame; --frames are its.",
)
@stage_options
def relight(
    stage: str,
    output: str,
    frames: str | None,
    plate: str | None,
    skip_existing: bool,
    stats: str | None,
    exposure: float,
    curve: str,
    width: int | None,
    real_from: str | None,
    budget: float | None,
    max_error: float | None,
    **options: Any,
) -> None:
    """Insert the synthetic objects of STAGE into its real scene; write OUTPUT.exr and a PNG preview beside it."""
    if real_from and options["camera"]:
        raise click.UsageError("--camera does not go with --real-from: the capture's camera is taken")
    codes = _time_codes(output, frames)
    jobs = [_Job(code, *_paths(output, plate, code)) for code in codes]
    for target in {Path(job.exr).parent: job.exr for job in jobs}.values():
        check_writable(target)
    if stats:
        check_writable(stats)
    waiting = [job for job in jobs if not (skip_existing and os.path.exists(job.exr))]
    if len(waiting) < len(jobs):
        click.echo(f"{len(jobs) - len(waiting)} of {len(jobs)} frames are there and are left out", err=True)
    if waiting:
        Run(stage, width, options, exposure, curve, real_from, budget, max_error).render(waiting, stats)


@dataclass(frozen=True)
class _Job:
    """One frame: its time code (None for the stage's own default) and files."""

    time: float | None
    exr: str
    png: str
    plate: str | None


def _time_codes(output: str, spec: str | None) -> Sequence[float | None]:
    if not output.lower().endswith(".exr"):
        raise click.UsageError(f"OUTPUT is '{output}'; its name must end in .exr (a PNG preview is written beside it)")
    if spec is None:
        if has_placeholder(output):
            raise click.UsageError(f"OUTPUT '{output}' has a place for a frame number; say which with --frames")
        return [None]
    if not has_placeholder(output):
        stem = str(Path(output).with_suffix(""))
        raise click.UsageError(f"with --frames OUTPUT needs a place for the frame number, as '{stem}.####.exr'")
    from warp_dvct.usd.stage import stage_frames

    codes = stage_frames(spec)
    lost = lost_frame(output, codes)
    if lost is not None:
        stem = str(Path(output).with_suffix("")).rstrip("#.")
        raise click.UsageError(
            f"frame {lost:g} has decimals and '{output}' no place for them; write '{stem}.####.##.exr'"
        )
    return codes


def _paths(output: str, plate: str | None, code: float | None) -> tuple[str, str, str | None]:
    if code is None:
        return output, str(Path(output).with_suffix(".png")), plate
    exr = frame_path(output, code)
    return exr, str(Path(exr).with_suffix(".png")), plate and frame_path(plate, code)


@dataclass
class Run:
    """Renders frames one after the other with one Relighter, which keeps what does not change between them.

    Args:
        stage: File.
        width: In pixels, or None for the plate's or the stage's.
        options: Further keywords of ``Relighter``.
        exposure, curve: Of the preview.
        real_from: Capture whose depth is the real scene, or None.
        budget, max_error: Seconds of a frame, or FLIP, for which the settings are chosen at the first frame; or None.
    """

    stage: str
    width: int | None
    options: dict[str, Any]
    exposure: float
    curve: str
    real_from: str | None = None
    budget: float | None = None
    max_error: float | None = None
    choice: Choice | None = None
    height: int | None = None
    records: list[dict[str, Any]] = field(default_factory=list)
    noted: set[str] = field(default_factory=set)

    def render(self, jobs: Sequence[_Job], stats: str | None) -> None:
        """Render and write the frames, then the statistics."""
        start_warp(self.options["device"])
        from warp_dvct.launch import Launcher
        from warp_dvct.relighter import Relighter

        live = self._live()
        relighter = self._open(Relighter, jobs[0], live)
        has_plate = jobs[0].plate is not None or relighter.scene.plate is not None
        self.choice = keep_budget(relighter, self.budget, self.max_error, has_plate=has_plate)
        if self.choice is not None:
            click.echo(self.choice.describe(), err=True)
        preview = Launcher("cpu", self.options["threads"])
        for job in jobs:
            if job is not jobs[0]:
                if live is None:
                    relighter.set_time(job.time)
                else:
                    relighter.set_scene(live.scene(job.time))
            self._note(relighter.scene.notices)
            self._frame(relighter, preview, job)
        if stats:
            write_text(stats, json.dumps(self._statistics(relighter), indent=2) + "\n")

    def _live(self) -> LiveSource | None:
        """The source of real scenes where they come from a capture."""
        if self.real_from is None:
            return None
        from warp_dvct.capture.live import LiveSource
        from warp_dvct.launch import Launcher

        reading = {key: self.options[key] for key in ("real", "synthetic", "strict", "purposes", "complexity")}
        launcher = Launcher(self.options["device"], self.options["threads"])
        source = LiveSource(self.stage, self.real_from, launcher=launcher, **reading)
        if self.width is None:
            self.width, self.height = source.size
        return source

    def _open(self, make: type[Relighter], job: _Job, live: LiveSource | None) -> Relighter:
        """The plate decides the size: one that is named is read before the stage, so a wrong file is found at once."""
        if job.plate:
            self.height, self.width, _ = read_plate(job.plate, self.width).shape
        stage = self.stage if live is None else live.scene(job.time)
        relighter = make(stage, width=self.width, height=self.height, time=job.time, **self.options)
        if relighter.scene.plate and not job.plate:
            height, width, _ = read_plate(relighter.scene.plate, self.width).shape
            if (width, height) != (relighter.width, relighter.height):
                relighter = make(stage, width=width, height=height, time=job.time, **self.options)
        return relighter

    def _frame(self, relighter: Relighter, preview: Launcher, job: _Job) -> None:
        from warp_dvct.passes.tonemap import tonemap

        start = time.perf_counter()
        plate, ldr = _plate(relighter, job)
        with Progress(os.path.basename(job.exr)) as progress:
            layers = relighter.render(plate, ldr=ldr, progress=progress.update)
        self._warn(layers, job)
        frame = {} if job.time is None else {"frame": f"{job.time:g}"}
        write_png(job.png, tonemap(preview, layers.comp, exposure=self.exposure, curve=self.curve))
        # The EXR comes last: --skip-existing takes it for the sign that a frame is complete.
        write_exr(job.exr, layers, camera=relighter.scene.camera, metadata=frame)
        self.records.append({**frame, "file": job.exr, **relighter.stats})
        click.echo(f"{job.exr} ({time.perf_counter() - start:.1f} s)")

    def _note(self, notices: Sequence[Any]) -> None:
        """List what is not modelled, each prim and message once for all frames."""
        new = [str(notice) for notice in notices if str(notice) not in self.noted]
        for line in new[:NOTICES_SHOWN]:
            click.echo(f"warp-dvct: not modelled: {line}", err=True)
        if len(new) > NOTICES_SHOWN:
            more = len(new) - NOTICES_SHOWN
            click.echo(f"warp-dvct: and {more} more; --stats or `warp-dvct plan` lists them all", err=True)
        self.noted.update(new)

    @staticmethod
    def _warn(layers: Layers, job: _Job) -> None:
        for count, what in (
            (layers.clamped, "beyond half precision were clamped"),
            (layers.invalid, "were NaN, now 0"),
        ):
            if count:
                click.echo(f"warp-dvct: warning: {job.exr}: {count} values {what}", err=True)

    def _statistics(self, relighter: Relighter) -> dict[str, Any]:
        """Of one frame, or the mean of several, which then are listed too."""
        last = self.records[-1]
        names = list(dict.fromkeys(name for record in self.records for name in record["passes"]))
        result = {
            "load_seconds": last["load_seconds"],
            "compile_seconds": last["compile_seconds"],
            "render_seconds": float(np.mean([record["render_seconds"] for record in self.records])),
            "cpu_seconds": float(np.mean([record["cpu_seconds"] for record in self.records])),
            "passes": {n: float(np.mean([record["passes"].get(n, 0.0) for record in self.records])) for n in names},
            "peak_bytes": max(record["peak_bytes"] for record in self.records),
            "plan": relighter.plan.to_dict(),
            "notices": sorted(self.noted),
        }
        if self.choice is not None:
            result["budget"] = self.choice.to_dict()
        if len(self.records) > 1:
            result["frames"] = [{k: r[k] for k in ("frame", "file", "render_seconds", "passes")} for r in self.records]
        return result


def _plate(relighter: Relighter, job: _Job) -> tuple[np.ndarray | None, bool]:
    """The frame's photograph, the one that was named or the stage's own, and whether it holds codes of a display.

    Raises:
        FileError: It is not of the picture's size, or the camera has another aspect.
    """
    name = job.plate or relighter.scene.plate
    if name is None:
        return None, False
    plate = read_plate(name, relighter.width, relighter.height)
    rows = relighter.width / relighter.scene.camera.aspect
    if abs(rows - relighter.height) > 1.0:
        raise FileError(
            f"plate '{name}' is {relighter.width} x {relighter.height} pixels but camera"
            f" {relighter.scene.camera.path} sees {relighter.width} x {rows:.0f}; a plate is not resampled: give the"
            " camera the photograph's apertures"
        )
    return plate, is_display_referred(name)

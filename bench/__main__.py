"""``warp-dvct bench …``, also ``python -m warp_dvct.bench …``: see ``docs/benchmarks.md`` and ``docs/tradeoff.md``."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from warp_dvct.bench.check_commands import CHECK_COMMANDS
from warp_dvct.bench.options import Target, settings_of, shared, write_json
from warp_dvct.bench.trade_commands import TRADE_COMMANDS
from warp_dvct.cli.quiet import start_warp
from warp_dvct.errors import DvctError
from warp_dvct.usd_scenes import cache_folder


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def bench() -> None:
    """Measure errors against the path-traced truth, and times beside the paper's."""


@bench.command()
@click.option(
    "--stage", "stages", multiple=True, help="A bundled stage or a USD file; repeatable. Default: all lit ones."
)
@click.option("--method", default="delta-cones", show_default=True)
@click.option("--quality", default="balanced", show_default=True)
@click.option("--width", type=int, default=640, show_default=True, help="Pixels; the height follows the camera.")
@click.option("--spp", type=int, default=128, show_default=True, help="Samples per pixel of the truth.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of the truth's random numbers.")
@click.option("--bounces", type=int, default=8, show_default=True, help="Of the many-bounce truth.")
@click.option("--exposure", type=float, default=0.0, show_default=True, help="Stops, before FLIP and PNG.")
@click.option("--cache", type=click.Path(path_type=Path), help="References; default: warp_dvct in the user's cache.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder for PNGs: composite, truth, error map.")
@shared
def error(
    stages: tuple[str, ...], pairs: tuple[str, ...], json_file: Path | None, spp: int, cache: Path | None, **rest
):
    """Compare a method with the path-traced truth (kept in a cache) and with two baselines."""
    start_warp(rest["device"])
    from warp_dvct.bench import error as module

    cache = cache or cache_folder() / "references"
    options = module.ErrorOptions(settings=settings_of(pairs), samples=spp, cache=cache, **rest)
    reports = []
    for stage in stages or module.LIT_STAGES:
        reports.append(module.measure(stage, options))
        click.echo(module.format_report(reports[-1]))
    if json_file is not None:
        write_json(json_file, {"options": asdict(options), "stages": [asdict(report) for report in reports]})


@bench.command()
@click.option("--stage", "stages", multiple=True, help="A bundled stage or a USD file; repeatable. Default: room_area.")
@click.option("--quality", default="balanced", show_default=True)
@click.option(
    "--width", type=click.IntRange(min=1), default=96, show_default=True, help="Pixels across; one point per pixel."
)
@shared
def eq9(stages: tuple[str, ...], pairs: tuple[str, ...], json_file: Path | None, **rest: Any) -> None:
    """The paper's eq. 9: error of the delta formulation, for our cones and for the paper's."""
    start_warp(rest["device"])
    from warp_dvct.bench import delta_error as module
    from warp_dvct.bench.error import read, stage_file
    from warp_dvct.launch import Launcher

    launcher = Launcher(rest["device"], rest["threads"])
    measured = {}
    for stage in stages or ("room_area",):
        scene = read(stage_file(stage))
        rows = module.delta_error(
            launcher, scene, width=rest["width"], quality=rest["quality"], settings=settings_of(pairs)
        )
        measured[stage] = [asdict(row) for row in rows]
        click.echo(module.format_rows(Path(stage).stem, rows))
    if json_file is not None:
        write_json(json_file, {"stages": measured})


@bench.command()
@click.option("--quality", default="balanced", show_default=True)
@click.option("--runs", type=int, default=3, show_default=True, help="Warm runs per row; the median is printed.")
@click.option("--width", type=int, default=1280, show_default=True)
@click.option("--height", type=int, default=720, show_default=True)
@click.option("--preset", is_flag=True, help="Our own preset's passes instead of the paper's cones and single bounce.")
@shared
def table1(quality: str, preset: bool, pairs: tuple[str, ...], json_file: Path | None, **rest: Any) -> None:
    """The paper's Table 1 (256^3 voxels, 720p, RSM of 1024^2) with this machine's times beside."""
    start_warp(rest["device"])
    from warp_dvct.bench import table1 as module

    settings = {**module.SIZE_SETTINGS, **({} if preset else module.PAPER_SETTINGS), **settings_of(pairs)}
    times = [module.measure(v, quality=quality, settings=settings, **rest) for v in module.VARIANTS]
    shown = " ".join(f"{k}={v}" for k, v in settings.items())
    title = f"Table 1, {rest['width']}x{rest['height']}, {quality}, {shown}, median of {rest['runs']}, {rest['device']}"
    click.echo(module.format_table(times, title))
    if json_file is not None:
        write_json(json_file, {"title": title, "machine": module.machine(), "times": [asdict(t) for t in times]})


@bench.command("instant-radiosity")
@click.option("--stage", default="room_spot", show_default=True, help="A bundled stage or a USD file.")
@click.option("--runs", type=int, default=3, show_default=True, help="Warm runs; the median is printed.")
@click.option("--bounces", type=int, multiple=True, default=(1, 3), show_default=True, help="Repeatable.")
@click.option("--sight/--no-sight", default=True, show_default=True, help="Also compare shadow maps with rays.")
@click.option(
    "--still", "frames", type=int, multiple=True, help="Error after so many frames of a still shot; repeatable."
)
@click.option("--spp", type=int, default=128, show_default=True, help="Samples per pixel of the truth for --still.")
@click.option("--cache", type=click.Path(path_type=Path), help="References; default: warp_dvct in the user's cache.")
@shared
def instant_radiosity(
    stage: str,
    pairs: tuple[str, ...],
    json_file: Path | None,
    sight: bool,
    frames: tuple[int, ...],
    spp: int,
    cache: Path | None,
    **rest: Any,
) -> None:
    """Times of instant radiosity at the paper's size and settings, how well its shadow maps see, what frames add."""
    start_warp(rest["device"])
    from warp_dvct.bench import instant_radiosity as module
    from warp_dvct.bench.error import read, stage_file
    from warp_dvct.launch import Launcher

    settings = settings_of(pairs)
    times = module.measure(stage, settings=settings, **rest)
    width, height = module.PAPER_SIZE
    shown = " ".join(f"{k}={v}" for k, v in {**module.PAPER_SETTINGS, **settings}.items())
    click.echo(module.format_times(times, f"{stage}, {width}x{height}, {shown}, median of {rest['runs']}"))
    rows, stills = [], []
    launcher = Launcher(rest["device"], rest["threads"])
    if frames:
        cache = cache or cache_folder() / "references"
        stills = module.still(stage, frames, settings=settings, launcher=launcher, samples=spp, cache=cache)
        click.echo("\n" + module.format_still(stills, f"{stage}: a still shot against the path tracer, one bounce"))
    if sight:
        rows = module.agreement(read(stage_file(stage)), module.POINTS, settings=settings, launcher=launcher)
        click.echo("\n" + module.format_agreement(rows, f"{stage}: imperfect shadow maps against exact rays"))
    if json_file is not None:
        measured = {"times": times, "still": stills, "sight": rows}
        content = {"machine": module.machine(), **{k: [asdict(r) for r in v] for k, v in measured.items()}}
        write_json(json_file, content)


@bench.command()
@click.option("--stage", default="room_area", show_default=True, help="A bundled stage or a USD file.")
@click.option("--width", type=int, default=320, show_default=True, help="Pixels; the height follows the camera.")
@click.option("--spp", type=int, default=64, show_default=True, help="Samples per pixel of the truth.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of the truth's random numbers.")
@click.option("--cache", type=click.Path(path_type=Path), help="References; default: warp_dvct in the user's cache.")
@shared
def curve(stage: str, spp: int, pairs: tuple[str, ...], json_file: Path | None, cache: Path | None, **rest: Any):
    """Turn every knob up together: seconds, FLIP, error of the indirect delta, indirect energy."""
    from warp_dvct.bench import sweep as module

    _sweep(stage, module.CURVE, spp, pairs, json_file, cache, rest)


@bench.command()
@click.option("--stage", default="room_area", show_default=True, help="A bundled stage or a USD file.")
@click.option(
    "--try", "texts", multiple=True, required=True, metavar='"[LABEL:] KEY=VALUE ..."', help="Settings; repeatable."
)
@click.option("--method", default="delta-cones", show_default=True)
@click.option("--quality", default="balanced", show_default=True)
@click.option("--width", type=int, default=320, show_default=True, help="Pixels; the height follows the camera.")
@click.option("--spp", type=int, default=64, show_default=True, help="Samples per pixel of the truth.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of the truth's random numbers.")
@click.option("--cache", type=click.Path(path_type=Path), help="References; default: warp_dvct in the user's cache.")
@shared
def compare(stage: str, texts: tuple[str, ...], spp: int, pairs: tuple[str, ...], json_file, cache, **rest: Any):
    """One stage under several settings, one line each: what a knob buys and what it costs."""
    from warp_dvct.bench import sweep as module

    _sweep(stage, module.parse_trials(texts), spp, pairs, json_file, cache, rest)


@bench.command()
@click.option("--stage", "stages", multiple=True, help="A bundled stage or a USD file; repeatable. Default: room_area.")
@click.option(
    "--samples", "peer_samples", type=int, multiple=True, default=(4, 16, 64), show_default=True, help="Of the peers."
)
@click.option("--width", type=int, default=320, show_default=True, help="Pixels; the height follows the camera.")
@click.option("--spp", type=int, default=128, show_default=True, help="Samples per pixel of the truth.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of the truth's random numbers.")
@click.option("--bounces", type=int, default=1, show_default=True, help="Of the truth and of the path tracers.")
@click.option("--cache", type=click.Path(path_type=Path), help="References; default: warp_dvct in the user's cache.")
@click.option("--device", default="cpu", show_default=True, help="Of our methods: cpu or cuda:N.")
@click.option("--threads", type=int, help="CPU threads; all cores by default. The denoiser takes all.")
@click.option("--json", "json_file", type=Target(), help="Write the figures to this file too.")
def peers(stages: tuple[str, ...], spp: int, cache: Path | None, json_file: Path | None, **rest: Any) -> None:
    """Beside Mitsuba 3 with and without Intel's denoiser: error against our truth, seconds in the same run."""
    start_warp(rest["device"])
    from warp_dvct.bench import peers as module

    options = module.PeerOptions(samples=spp, cache=cache or cache_folder() / "references", **rest)
    reports = []
    for stage in stages or ("room_area",):
        reports.append(module.measure(stage, options))
        click.echo(module.format_report(reports[-1]))
    if json_file is not None:
        write_json(json_file, {"options": asdict(options), "stages": [asdict(report) for report in reports]})


def _sweep(stage: str, trials: Any, spp: int, pairs: tuple[str, ...], json_file: Path | None, cache, rest: Any) -> None:
    start_warp(rest["device"])
    from warp_dvct.bench import sweep as module

    cache = cache or cache_folder() / "references"
    options = module.SweepOptions(settings=settings_of(pairs), samples=spp, cache=cache, **rest)
    click.echo(module.format_head(stage, options, list(trials)))
    truth, done = module.measure(stage, trials, options, lambda t: click.echo(module.format_trial(t, list(trials))))
    click.echo(f"the truth's own noise is FLIP {truth.noise:.4f}\n")
    if json_file is not None:
        content = {"options": asdict(options), "noise": truth.noise, "trials": [asdict(t) for t in done]}
        write_json(json_file, content)


@bench.command()
@click.option("--stage", default="room_area", show_default=True, help="A bundled stage or a USD file.")
@click.option("--frames", type=int, default=60, show_default=True, help="Of the shot.")
@click.option("--light", is_flag=True, help="Move a light instead of the synthetic objects.")
@click.option("--plate/--no-plate", default=True, help="Composite on plates, or render the light before as well.")
@click.option("--quality", default="balanced", show_default=True)
@click.option("--width", type=int, default=640, show_default=True, help="Pixels; the height follows the camera.")
@click.option("--checks", type=int, default=3, show_default=True, help="Frames compared with frames from scratch.")
@click.option("--flicker", type=int, default=5, show_default=True, help="Frames to measure flicker on; 0 for none.")
@click.option("--flicker-width", type=int, default=320, show_default=True, help="Pixels, where flicker is measured.")
@click.option("--spp", type=int, default=64, show_default=True, help="Samples per pixel of the flicker's truth.")
@click.option("--cache", type=click.Path(path_type=Path), help="References; default: warp_dvct in the user's cache.")
@shared
def motion(stage: str, pairs: tuple[str, ...], json_file: Path | None, spp: int, cache: Path | None, **rest: Any):
    """A moving shot: frames a second, what is kept between frames, equality with frames from scratch, flicker."""
    start_warp(rest["device"])
    from warp_dvct.bench import motion as module

    cache = cache or cache_folder() / "references"
    options = module.MotionOptions(settings=settings_of(pairs), samples=spp, cache=cache, **rest)
    report = module.measure(stage, options)
    click.echo(module.format_report(report))
    if json_file is not None:
        write_json(json_file, {"options": asdict(options), "report": asdict(report)})


@bench.command()
@click.option("--stage", default="room_area", show_default=True, help="A bundled stage or a USD file.")
@click.option("--frames", type=int, default=60, show_default=True, help="Of the simulated capture.")
@click.option("--width", type=int, default=640, show_default=True, help="Pixels of depth images and photographs.")
@click.option("--voxel", type=float, default=0.01, show_default=True, help="Metres.")
@click.option("--tracked", type=int, default=20, show_default=True, help="Frames that are tracked; 0 for none.")
@click.option("--quality", default="balanced", show_default=True, help="Of the relit pictures.")
@click.option("--pictures", type=int, default=2, show_default=True, help="How many are compared with the truth's.")
@click.option("--live", type=click.Path(path_type=Path), help="A dataset's folder: relit from live depth as well.")
@click.option("--device", default="cpu", show_default=True, help="cpu or cuda:N.")
@click.option("--threads", type=int, help="CPU threads; all cores by default.")
@click.option("--json", "json_file", type=Target(), help="Write the figures to this file too.")
def reconstruct(stage: str, json_file: Path | None, **rest: Any) -> None:
    """A simulated capture: time a frame of filter, fusion and tracking, and how near the reconstruction comes."""
    start_warp(rest["device"])
    from warp_dvct.bench import reconstruct as module

    options = module.CaptureOptions(**rest)
    report = module.measure(stage, options)
    click.echo(module.format_report(report, options))
    if json_file is not None:
        write_json(json_file, {"options": asdict(options), "report": asdict(report)})


for _command in (*TRADE_COMMANDS, *CHECK_COMMANDS):
    bench.add_command(_command)


def main() -> None:
    """Run a command; errors that a user can mend go to stderr with exit status 1."""
    try:
        bench(prog_name="python -m warp_dvct.bench")
    except DvctError as problem:
        click.echo(f"bench: error: {problem}", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()

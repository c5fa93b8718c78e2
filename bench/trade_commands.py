"""The commands that measure the trade of speed for accuracy; see ``docs/tradeoff.md``."""

from __future__ import annotations

import shlex
from itertools import product
from pathlib import Path
from typing import Any

import click

from warp_dvct.bench.options import Target, settings_of
from warp_dvct.cli.options import METHODS, QUALITIES
from warp_dvct.cli.quiet import start_warp
from warp_dvct.usd_scenes import cache_folder

FILE = click.Path(path_type=Path)


@click.command()
@click.option("--stage", "stages", multiple=True, help="A bundled stage or a USD file; repeatable. Default: room_area.")
@click.option(
    "--method",
    "methods",
    type=click.Choice(METHODS),
    multiple=True,
    default=("delta-cones",),
    show_default=True,
    help="Repeatable.",
)
@click.option("--quality", type=click.Choice(QUALITIES), default="balanced", show_default=True)
@click.option("--set", "pairs", multiple=True, metavar="KEY=VALUE", help="A setting, as in warp-dvct relight.")
@click.option("--width", type=click.IntRange(min=1), default=640, show_default=True, help="Pixels across.")
@click.option("--runs", type=int, default=5, show_default=True, help="Measured frames a backend.")
@click.option("--warm-up", type=int, default=1, show_default=True, help="Frames before them that do not count.")
@click.option("--device", "devices", multiple=True, help="cpu or cuda:N; repeatable. Default: all that are present.")
@click.option("--threads", type=int, multiple=True, help="Of the CPU; repeatable. Default: 1, 2, 4, … all.")
@click.option("--out", "out", type=FILE, metavar="FILE", help="Add the rows to this file of JSON lines.")
@click.option("--compare", "files", type=FILE, nargs=2, metavar="OLD NEW", help="Compare two such files, and stop.")
def backends(stages: tuple[str, ...], methods, pairs: tuple[str, ...], devices, threads, out, files, **rest: Any):
    """The same picture on the CPU with 1, 2, … threads and on each GPU: seconds, bytes, and whether they agree."""
    from warp_dvct.bench import backends as module
    from warp_dvct.bench.rows import append_row, provenance, read_rows

    if files:
        old, new = (_some_rows(file, module.KIND) for file in files)
        click.echo(module.format_comparison(module.compare(old, new)))
        return
    start_warp("cpu")
    if out is not None:
        read_rows(out)  # a broken file is found before the work
    settings = settings_of(pairs)
    found, taken = module.find_backends(devices, threads), provenance()
    for stage, method in product(stages or ("room_area",), dict.fromkeys(methods)):
        options = module.BackendOptions(method=method, settings=settings, **rest)
        rows = [{**row, **taken} for row in module.measure(stage, found, options)]
        click.echo(module.format_rows(rows) + "\n")
        if out is not None:
            for row in rows:
                append_row(out, row)
    if not any(b.device.startswith("cuda") for b in found):
        click.echo("no CUDA device was measured: none is present" if not devices else "no CUDA device was asked for")


@click.command()
@click.option("--stage", "stages", multiple=True, help="A bundled stage or a USD file; repeatable. Default: room_area.")
@click.option("--method", "methods", multiple=True, help="Repeatable. Default: all three.")
@click.option(
    "--knob",
    "knobs",
    multiple=True,
    metavar="NAME[=A,B]",
    help="A sweep, with values of your own, 'preset' or 'joint'; repeatable. Default: all, and Mitsuba 3.",
)
@click.option("--set", "pairs", multiple=True, metavar="KEY=VALUE", help="A setting of every point, under its own.")
@click.option("--width", type=int, default=320, show_default=True, help="Pixels across; the height follows the camera.")
@click.option("--spp", "samples", type=int, default=128, show_default=True, help="Samples per pixel of the truth.")
@click.option("--bounces", type=int, default=8, show_default=True, help="Of the truth and of all points but presets.")
@click.option("--flicker", type=int, default=3, show_default=True, help="Frames of a moving shot; 0 for none.")
@click.option("--repeats", type=int, default=2, show_default=True, help="Timed frames a point; the least counts.")
@click.option("--peers/--no-peers", default=True, show_default=True, help="Mitsuba 3, where it is installed.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of the truth's random numbers.")
@click.option("--cache", type=FILE, help="References; default: warp_dvct in the user's cache.")
@click.option("--out", type=FILE, default=Path("tradeoff"), show_default=True, help="Folder: rows, pictures, fronts.")
@click.option("--html", type=FILE, metavar="DIR", help="Also write one self-contained page there.")
@click.option("--device", default="cpu", show_default=True, help="cpu or cuda:N.")
@click.option("--threads", type=int, help="CPU threads; all cores by default.")
def tradeoff(stages: tuple[str, ...], pairs: tuple[str, ...], cache: Path | None, html: Path | None, **rest: Any):
    """Every knob of every method: time against error, fronts, and what each knob buys; resumes where it stopped."""
    start_warp(rest["device"])
    from warp_dvct.bench import pareto
    from warp_dvct.bench import tradeoff as module
    from warp_dvct.bench.page import write_page

    command = repeat_command()
    measured = {}
    shared = settings_of(pairs)
    options = module.TradeoffOptions(settings=shared, cache=cache or cache_folder() / "references", **rest)
    for stage in stages or ("room_area",):
        bench = module.Bench(stage, options, lambda row, known: click.echo(module.format_row(row) + " ·" * known))
        click.echo(f"{stage}, {options.width} x {bench.height}; points marked · were measured before\n{module.HEAD}")
        rows = bench.run()
        click.echo(module.summarise(rows))
        for reason in bench.left_out:
            click.echo(f"left out: {reason}")
        for file in pareto.draw(rows, options.out / f"front_{Path(stage).stem}"):
            click.echo(str(file))
        measured[Path(stage).stem] = rows
    if html is not None:
        click.echo(str(write_page(html, options.out, measured, [command])))


@click.command()
@click.option(
    "--stage", "stages", multiple=True, help="A bundled stage or a USD file; repeatable. Default: all lit ones."
)
@click.option(
    "--budget", "budgets", type=float, multiple=True, default=(0.5, 1, 2, 5, 10, 20), show_default=True, help="Seconds."
)
@click.option("--repeats", type=int, default=1, show_default=True, help="Of which the least times count.")
@click.option("--method", type=click.Choice(METHODS), default="delta-cones", show_default=True)
@click.option("--set", "pairs", multiple=True, metavar="KEY=VALUE", help="A setting that is not chosen.")
@click.option("--width", type=click.IntRange(min=16), default=320, show_default=True, help="Pixels across.")
@click.option("--spp", "samples", type=int, default=384, show_default=True, help="Of the truth; 0 measures no error.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of the truth's random numbers.")
@click.option("--cache", type=FILE, help="References; default: warp_dvct in the user's cache.")
@click.option("--out", type=FILE, metavar="FILE", help="Add each row to this file of JSON lines at once.")
@click.option("--device", default="cpu", show_default=True, help="cpu or cuda:N.")
@click.option("--threads", type=int, help="CPU threads; all cores by default.")
def budget(stages: tuple[str, ...], pairs: tuple[str, ...], cache: Path | None, out: Path | None, **rest: Any) -> None:
    """Budgets against actual times, and predicted against measured errors: whether relight --budget keeps its word.

    A run that was stopped goes on where --out ends: rows of the same commit and unit costs, marked ·, are kept.
    """
    start_warp(rest["device"])
    from warp_dvct.bench import budget as module
    from warp_dvct.bench.error import LIT_STAGES
    from warp_dvct.bench.rows import append_row, now, provenance, read_rows

    # A commit with a + does not say what was measured.
    written = read_rows(out, module.KIND) if out is not None else []
    known = {row["key"]: row for row in written if "key" in row and not str(row.get("commit")).endswith("+")}
    options = module.BudgetOptions(settings=settings_of(pairs), cache=cache or cache_folder() / "references", **rest)
    taken, rows = provenance(), []

    def add(row: dict[str, Any], known: bool) -> None:
        click.echo(module.format_row(row) + " ·" * known)
        if out is not None and not known:
            append_row(out, {**row, **taken, "time": now()})

    click.echo(module.HEAD)
    for stage in stages or LIT_STAGES:
        rows += module.measure(stage, options, add, known)
    click.echo(module.summarise(rows))


@click.command()
@click.option("--stage", default="room_area", show_default=True, help="A bundled stage or a USD file.")
@click.option(
    "--axis", "axes", multiple=True, help="triangles, resolution, pixels, lights, frames or threads; repeatable."
)
@click.option("--full", is_flag=True, help="Up to 10^7 triangles, 1024^3 voxels, 2560 pixels, 64 lights: minutes, GiB.")
@click.option("--width", type=click.IntRange(min=1), default=160, show_default=True, help="Pixels across.")
@click.option("--repeats", type=int, default=2, show_default=True, help="Of which the least counts.")
@click.option("--quality", type=click.Choice(QUALITIES), default="balanced", show_default=True)
@click.option("--set", "pairs", multiple=True, metavar="KEY=VALUE", help="A setting, as in warp-dvct relight.")
@click.option("--device", default="cpu", show_default=True, help="cpu or cuda:N.")
@click.option("--out", type=FILE, metavar="FILE", help="Add the rows to this file of JSON lines.")
def scaling(stage: str, pairs: tuple[str, ...], out: Path | None, **rest: Any) -> None:
    """How time and memory grow with triangles, voxels, pixels, lights, frames, threads; flags what grows too fast."""
    start_warp(rest["device"])
    from warp_dvct.bench import scaling as module
    from warp_dvct.bench.rows import append_row, provenance, read_rows

    if out is not None:
        read_rows(out)
    options = module.ScalingOptions(settings=settings_of(pairs), **rest)
    click.echo(module.HEAD)
    rows = module.measure(stage, options, lambda row: click.echo(module.format_row(row)))
    if out is not None:
        taken = provenance()
        for row in rows:
            append_row(out, {**row, **taken})
    click.echo("\n" + module.format_exponents(module.exponents(rows), rows))


@click.command("error-table")
@click.argument("files", type=FILE, nargs=-1, required=True)
@click.option("--out", type=FILE, metavar="FILE", help="Write the table there, as warp_dvct/accuracy.json.")
def error_table(files: tuple[Path, ...], out: Path | None) -> None:
    """Fit what relight --budget predicts errors from to the rows of bench tradeoff in FILES."""
    start_warp("cpu")
    from warp_dvct.bench import error_table as module

    fit = module.fit_table([row for file in files for row in _some_rows(file, "tradeoff")])
    ratios = [measured / max(predicted, 1e-9) for _, measured, predicted in fit.points]
    near = sum(1 / 1.5 <= ratio <= 1.5 for ratio in ratios)
    click.echo(f"{len(ratios)} points; predicted within a factor of 1.5: {near}; spread {fit.table.spread:.0%}")
    for (name, measured, predicted), ratio in zip(fit.points, ratios, strict=True):
        if not 1 / 1.5 <= ratio <= 1.5:
            click.echo(f"  {name}: measured {measured:.4f}, predicted {predicted:.4f}")
    if fit.unseen:
        click.echo("each stage by a fit to the others, measured over predicted at the reference:")
        click.echo("  " + ", ".join(f"{stage} {flip / expected:.2f}" for stage, (flip, expected) in fit.unseen.items()))
    if out is not None:
        module.write_table(fit.table, out)


@click.command()
@click.option("--effect", "effects", multiple=True, help="One of them; repeatable. Default: all.")
@click.option("--quality", type=click.Choice(QUALITIES), default="balanced", show_default=True)
@click.option("--width", type=int, default=320, show_default=True, help="Pixels across; the height follows the camera.")
@click.option("--spp", "samples", type=int, default=128, show_default=True, help="Samples per pixel of the truth.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of the truth's random numbers.")
@click.option("--cache", type=FILE, help="References; default: warp_dvct in the user's cache.")
@click.option("--images", type=FILE, metavar="DIR", help="Write pictures of the known failures there.")
@click.option("--device", default="cpu", show_default=True, help="cpu or cuda:N.")
@click.option("--threads", type=int, help="CPU threads; all cores by default.")
@click.option("--out", type=FILE, metavar="FILE", help="Add the rows to this file of JSON lines.")
def effects(cache: Path | None, out: Path | None, **rest: Any) -> None:
    """Shadows, bounces, reflections, skies, thin walls, small objects: each method's error and cost, as a table."""
    start_warp(rest["device"])
    from warp_dvct.bench import effects as module
    from warp_dvct.bench.rows import append_row, provenance, read_rows

    if out is not None:
        read_rows(out)
    options = module.EffectOptions(cache=cache or cache_folder() / "references", **rest)
    rows = module.measure(
        options, lambda r: click.echo(f"{r['effect']}, {r['method']}: {100 * r['error']:.3g} %", err=True)
    )
    click.echo(module.format_table(rows))
    if out is not None:
        taken = provenance()
        for row in rows:
            append_row(out, {**row, **taken})


@click.command()
@click.argument("file", type=Target(".png", ".jpg", ".jpeg", ".svg"))
@click.option(
    "--width", type=click.IntRange(min=1), default=240, show_default=True, help="Pixels across of each panel."
)
@click.option("--device", default="cpu", show_default=True, help="cpu or cuda:N.")
@click.option("--threads", type=int, help="CPU threads; all cores by default.")
def figure3(file: Path, width: int, device: str, threads: int | None) -> None:
    """The paper's figure 3 from our own renders, into FILE (.png, .jpg, .svg): where deltas are wrong."""
    start_warp(device)
    from warp_dvct.bench import figure3 as module
    from warp_dvct.launch import Launcher

    made = module.panels(Launcher(device, threads), width=width)
    module.draw(made, file)
    click.echo(module.format_panels(made))


def repeat_command() -> str:
    """The command line that is being run, with what differs from the defaults."""
    context = click.get_current_context()
    words = ["warp-dvct", "bench", str(context.info_name)]
    for parameter in context.command.params:
        value, flag = context.params.get(str(parameter.name)), parameter.opts[0]
        if value in (None, (), parameter.get_default(context)):
            continue
        if isinstance(value, bool):
            words.append(flag if value else parameter.secondary_opts[0])
            continue
        for item in value if isinstance(value, tuple) else (value,):
            words += [flag, str(item)]
    return shlex.join(words)


def _some_rows(file: Path, kind: str) -> list[dict[str, Any]]:
    from warp_dvct.bench.rows import read_rows
    from warp_dvct.errors import FileError

    if not file.is_file():
        raise FileError(f"{file} does not exist or is not a file; check the path")
    rows = read_rows(file, kind)
    if not rows:
        raise FileError(f"{file} has no rows of kind '{kind}'; write some with --out")
    return rows


TRADE_COMMANDS = (backends, tradeoff, scaling, budget, error_table, effects, figure3)

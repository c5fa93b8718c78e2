"""The commands that measure the trade of speed for accuracy; see ``docs/tradeoff.md``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from warp_dvct.bench.options import settings_of
from warp_dvct.cli.options import METHODS, QUALITIES
from warp_dvct.cli.quiet import start_warp

FILE = click.Path(path_type=Path)


@click.command()
@click.option("--stage", "stages", multiple=True, help="A bundled stage or a USD file; repeatable. Default: room_area.")
@click.option("--method", type=click.Choice(METHODS), default="delta-cones", show_default=True)
@click.option("--quality", type=click.Choice(QUALITIES), default="balanced", show_default=True)
@click.option("--set", "pairs", multiple=True, metavar="KEY=VALUE", help="A setting, as in warp-dvct relight.")
@click.option("--width", type=click.IntRange(min=1), default=640, show_default=True, help="Pixels across.")
@click.option("--runs", type=int, default=5, show_default=True, help="Measured frames a backend.")
@click.option("--warm-up", type=int, default=1, show_default=True, help="Frames before them that do not count.")
@click.option("--device", "devices", multiple=True, help="cpu or cuda:N; repeatable. Default: all that are present.")
@click.option("--threads", type=int, multiple=True, help="Of the CPU; repeatable. Default: 1, 2, 4, … all.")
@click.option("--out", "out", type=FILE, metavar="FILE", help="Add the rows to this file of JSON lines.")
@click.option("--compare", "files", type=FILE, nargs=2, metavar="OLD NEW", help="Compare two such files, and stop.")
def backends(stages: tuple[str, ...], pairs: tuple[str, ...], devices, threads, out: Path | None, files, **rest: Any):
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
    options = module.BackendOptions(settings=settings_of(pairs), **rest)
    found, taken = module.find_backends(devices, threads), provenance()
    for stage in stages or ("room_area",):
        rows = [{**row, **taken} for row in module.measure(stage, found, options)]
        click.echo(module.format_rows(rows) + "\n")
        for row in rows if out is not None else ():
            append_row(out, row)
    if not any(b.device.startswith("cuda") for b in found):
        click.echo("no CUDA device was measured: none is present" if not devices else "no CUDA device was asked for")


def _some_rows(file: Path, kind: str) -> list[dict[str, Any]]:
    from warp_dvct.bench.rows import read_rows
    from warp_dvct.errors import FileError

    rows = read_rows(file, kind)
    if not rows:
        raise FileError(f"{file} has no rows of kind '{kind}'; write some with --out")
    return rows


TRADE_COMMANDS = (backends,)

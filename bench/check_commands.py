"""The commands that check the kernels themselves: their numbers, and what they need of a GPU."""

from __future__ import annotations

from pathlib import Path

import click

from warp_dvct.bench.doc_tables import replace_table
from warp_dvct.cli.quiet import start_warp

FILE = click.Path(path_type=Path, dir_okay=False, exists=True)


@click.command()
@click.option("--device", default="cpu", show_default=True, help="cpu or cuda:N.")
@click.option("--write", "page", type=FILE, metavar="FILE", help="Replace the table in this page, docs/numerics.md.")
def numerics(device: str, page: Path | None) -> None:
    """Every kernel family against its float64 NumPy twin: the largest deviation of each output."""
    start_warp(device)
    from warp_dvct.bench.twins import format_deviations, measure_all
    from warp_dvct.launch import Launcher

    table = format_deviations(measure_all(Launcher(device)))
    click.echo(table)
    if page is not None:
        replace_table(page, "deviations", table)


CHECK_COMMANDS = (numerics,)

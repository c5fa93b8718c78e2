"""The commands that check the kernels themselves: their numbers, and what they need of a GPU."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import click

from warp_dvct.bench.doc_tables import replace_table
from warp_dvct.cli.quiet import start_warp
from warp_dvct.errors import DeviceError

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


@click.command()
@click.option("--page", type=FILE, metavar="FILE", help="Compare with the table in this page, docs/cuda.md.")
@click.option("--write", "target", type=FILE, metavar="FILE", help="Replace the table in this page, docs/cuda.md.")
def cuda(page: Path | None, target: Path | None) -> None:
    """Build every kernel for four GPU generations, without a GPU: registers, spills, stack and shared memory."""
    start_warp("cpu")
    from warp_dvct.bench import cuda_usage as module
    from warp_dvct.cli.warmup import kernel_modules

    ptxas = module.find_ptxas()
    if ptxas is None:
        raise DeviceError("ptxas is not there, which says what kernels need; pip install nvidia-cuda-nvcc")
    with TemporaryDirectory() as folder, module.building(kernel_modules(), Path(folder), ptxas) as builds:
        usage = {name: build.result() for name, build in builds.items()}
    table = module.format_usage(usage)
    click.echo(table)
    if target is not None:
        replace_table(target, "usage", f"ptxas {module.ptxas_version(ptxas)}\n\n{table}")
    elif page is not None:
        spills = module.new_spills(usage, module.usage_table(page))
        if spills:
            raise DeviceError("; ".join(spills) + "; use fewer live values, or write the new table with --write")


CHECK_COMMANDS = (numerics, cuda)

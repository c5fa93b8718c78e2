"""``warp-dvct calibrate``: measure what frames cost on this machine, for ``--budget``."""

from __future__ import annotations

from pathlib import Path

import click

from warp_dvct.cli.progress import Progress
from warp_dvct.cli.quiet import start_warp
from warp_dvct.image import check_writable


@click.command()
@click.option("--device", default="cpu", show_default=True, metavar="DEVICE", help="cpu, cuda or cuda:N.")
@click.option("--threads", type=click.IntRange(min=1), metavar="N", help="CPU threads. Default: all cores.")
@click.option("--frames", type=int, default=8, show_default=True, help="Of each of six scenes.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of the settings that are drawn.")
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE", help="Write the model there instead.")
def calibrate(device: str, threads: int | None, frames: int, seed: int, out: Path | None) -> None:
    """Measure what frames cost on this machine; `relight --budget` then keeps its word. Takes two to three minutes."""
    if out is not None:
        check_writable(out)
    start_warp(device)
    from warp_dvct.calibrate import calibrate as measure
    from warp_dvct.cost_model import model_file, save_model

    with Progress("calibrate") as progress:
        model, samples = measure(device, threads, frames=frames, seed=seed, report=progress.update)
    file = out or model_file(device)
    save_model(model, file)
    fitted = sum("survey" not in sample.work for sample in samples)
    click.echo(
        f"{file}: fitted to {fitted} frames on {model.threads} thread(s) of {model.machine};"
        f" measured over predicted processor time varies by {model.spread:.0%}"
    )
    if model.threads > 1 and max(model.speedup.values()) < 1.1:
        click.echo(f"{model.threads} threads were no faster than one: the machine was busy, calibrate again", err=True)
    if model.spread > 0.25:
        click.echo("the machine was busy with other things: calibrate again when it is idle", err=True)

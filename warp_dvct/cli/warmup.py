"""``warp-dvct warmup``: compile every kernel once, so that the first picture does not wait for it."""

from __future__ import annotations

import importlib
import pkgutil
import time

import click

from warp_dvct.cli.progress import Progress
from warp_dvct.cli.quiet import start_warp


def kernel_modules() -> list[str]:
    """Names of the package's modules that hold kernels of their own, sorted; imports them."""
    import warp as wp

    import warp_dvct.kernels as package

    found = [f"{package.__name__}.{info.name}" for info in pkgutil.iter_modules(package.__path__)]
    return sorted(name for name in found if importlib.import_module(name) and wp.get_module(name).kernels)


@click.command()
@click.option("--device", default="cpu", show_default=True, metavar="DEVICE", help="cpu, cuda or cuda:N.")
def warmup(device: str) -> None:
    """Compile the kernels for a device into Warp's cache."""
    start_warp(device)
    import warp as wp

    from warp_dvct.launch import Launcher

    launcher = Launcher(device)
    names = kernel_modules()
    start = time.perf_counter()
    with Progress("warmup") as progress:
        for i, name in enumerate(names):
            progress.update(name.rpartition(".")[2], i / len(names))
            launcher.load(wp.get_module(name))
    click.echo(
        f"{len(names)} kernel modules are ready on {launcher.device.alias} ({time.perf_counter() - start:.1f} s)"
    )

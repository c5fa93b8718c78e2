"""``warp-dvct scenes``: the bundled stages."""

from __future__ import annotations

import click

from warp_dvct import usd_scenes


@click.command()
@click.argument("name", required=False)
def scenes(name: str | None) -> None:
    """List the bundled stages, or print the file of the one called NAME."""
    if name is not None:
        click.echo(usd_scenes.path(name))
        return
    from pxr import Sdf

    for known in usd_scenes.names():
        layer = Sdf.Layer.FindOrOpen(str(usd_scenes.FOLDER / f"{known}.usda"))
        click.echo(f"{known:12} {layer.documentation}")

"""``warp-dvct settings``: what ``--set`` understands."""

from __future__ import annotations

import click


@click.command()
def settings() -> None:
    """List every KEY of --set with its default, range and meaning."""
    from warp_dvct.settings import describe_settings

    click.echo(describe_settings())

"""``warp-dvct bench``: the measurements, also ``python -m warp_dvct.bench``."""

from __future__ import annotations

import click


@click.command(
    add_help_option=False,
    context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False},
    short_help="Measure speed and accuracy: backends, trade-offs, scaling, budgets.",
)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def bench(arguments: tuple[str, ...]) -> None:
    """Measure speed and accuracy; ``warp-dvct bench --help`` lists what."""
    from warp_dvct.bench.__main__ import bench as group  # its modules draw on the command's own

    group.main(list(arguments), prog_name="warp-dvct bench", standalone_mode=False)

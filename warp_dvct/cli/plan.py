"""``warp-dvct plan``: what would be done for a stage, and why."""

from __future__ import annotations

import json
from typing import Any

import click

from warp_dvct.cli.options import keep_budget, stage_options
from warp_dvct.cli.quiet import start_warp


@click.command()
@click.argument("stage")
@stage_options
@click.option("--json", "as_json", is_flag=True, help="Print the plan as JSON.")
def plan(stage: str, as_json: bool, budget: float | None, max_error: float | None, **options: Any) -> None:
    """Print each pass that STAGE needs or does without, why, and its memory; render nothing."""
    start_warp(options["device"])
    from warp_dvct.relighter import Relighter

    relighter = Relighter(stage, **options)
    choice = keep_budget(relighter, budget, max_error, has_plate=relighter.scene.plate is not None)
    if as_json:
        chosen = {} if choice is None else {"budget": choice.to_dict()}
        click.echo(json.dumps({**relighter.plan.to_dict(), **chosen}, indent=2))
        return
    click.echo(relighter.plan.describe())
    if choice is not None:
        click.echo(choice.describe())
    for notice in relighter.scene.notices:
        click.echo(f"not modelled: {notice}")

"""Options and small helpers that the benches' commands share."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from warp_dvct.bench.rows import plain
from warp_dvct.errors import OptionError
from warp_dvct.image import write_text


def shared(command: Any) -> Any:
    """``--set``, ``--device``, ``--threads`` and ``--json``."""
    for option in (
        click.option("--set", "pairs", multiple=True, metavar="KEY=VALUE", help="A setting, as in warp-dvct relight."),
        click.option("--device", default="cpu", show_default=True, help="cpu or cuda:N."),
        click.option("--threads", type=int, help="CPU threads; all cores by default."),
        click.option(
            "--json", "json_file", type=click.Path(path_type=Path), help="Write the figures to this file too."
        ),
    ):
        command = option(command)
    return command


def settings_of(pairs: tuple[str, ...]) -> dict[str, str]:
    """``key=value`` strings as a dict.

    Raises:
        OptionError: One without ``=``.
    """
    settings = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or not key:
            raise OptionError(f"--set {pair!r} is not KEY=VALUE")
        settings[key.strip()] = value.strip()
    return settings


def write_json(file: Path, content: dict[str, Any]) -> None:
    """Write figures as JSON; NaN becomes null and a path its text.

    Raises:
        FileError: The file cannot be written.
    """
    write_text(file, json.dumps(plain(content), indent=1, allow_nan=False) + "\n")

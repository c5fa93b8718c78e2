"""Options and small helpers that the benches' commands share."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from warp_dvct.bench.rows import plain
from warp_dvct.errors import OptionError
from warp_dvct.image import check_writable, write_text


class Target(click.Path):
    """A file to be written; where that cannot be is found out before the minutes of work."""

    def __init__(self, *endings: str) -> None:
        super().__init__(path_type=Path)
        self._endings = endings

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Refuse an ending that is not among ``endings``.

        Raises:
            FileError: The file is a folder, or the one around it is missing or cannot be written.
        """
        file = Path(value)
        if self._endings and file.suffix.lower() not in self._endings:
            self.fail(f"'{file}' has to end in {' or '.join(self._endings)}", param, ctx)
        check_writable(file)
        return file


def shared(command: Any) -> Any:
    """``--set``, ``--device``, ``--threads`` and ``--json``."""
    for option in (
        click.option("--set", "pairs", multiple=True, metavar="KEY=VALUE", help="A setting, as in warp-dvct relight."),
        click.option("--device", default="cpu", show_default=True, help="cpu or cuda:N."),
        click.option("--threads", type=int, help="CPU threads; all cores by default."),
        click.option("--json", "json_file", type=Target(), help="Write the figures to this file too."),
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

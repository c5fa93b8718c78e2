"""A bar on a terminal, plain lines elsewhere; both on stderr, so that stdout holds results only."""

from __future__ import annotations

import sys
from types import TracebackType

import click
from tqdm import tqdm

LINE_STEP = 0.1  # share of a picture between two plain lines


class Progress:
    """Shows how far a picture is; :meth:`update` is the callback that ``Relighter.render`` takes.

    Args:
        label: What is being made, as a file name.
    """

    def __init__(self, label: str) -> None:
        self._label = label
        self._next_line = LINE_STEP
        self._bar = None
        if sys.stderr.isatty():
            self._bar = tqdm(
                total=1.0, desc=label, leave=False, bar_format="{desc} |{bar}| {percentage:.0f}% {elapsed}"
            )

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        if self._bar is not None:
            self._bar.close()

    def update(self, name: str, fraction: float) -> None:
        """The pass ``name`` has begun or goes on; ``fraction`` of the picture, in [0, 1], is done."""
        if self._bar is not None:
            self._bar.set_description_str(f"{self._label}: {name}", refresh=False)
            self._bar.update(max(min(fraction, 1.0) - self._bar.n, 0.0))
            self._bar.refresh()
        elif self._next_line <= fraction < 1.0:
            click.echo(f"{self._label}: {100 * fraction:.0f}% ({name})", err=True)
            self._next_line = fraction + LINE_STEP

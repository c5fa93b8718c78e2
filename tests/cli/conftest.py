"""What the tests of the command share."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest

from warp_dvct.cli import _run


@dataclasses.dataclass(frozen=True)
class Result:
    """Exit code and what was printed."""

    code: int
    out: str
    err: str


@pytest.fixture
def command(capfd) -> Callable[..., Result]:
    """Runs ``warp-dvct`` in this process, as its entry point does."""

    def run(*arguments: object) -> Result:
        code = _run([str(argument) for argument in arguments])
        captured = capfd.readouterr()
        return Result(code, captured.out, captured.err)

    return run

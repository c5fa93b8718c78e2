"""The command ``warp-dvct``.

Exit codes: 0 done, 1 an error that the message explains, 2 wrong usage, 130 interrupted, 143 terminated.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from types import FrameType

import click

from warp_dvct.cli.bench import bench
from warp_dvct.cli.calibrate import calibrate
from warp_dvct.cli.capture import capture
from warp_dvct.cli.place import place
from warp_dvct.cli.plan import plan
from warp_dvct.cli.probe import probe
from warp_dvct.cli.reconstruct import reconstruct
from warp_dvct.cli.relight import relight
from warp_dvct.cli.scenes import scenes
from warp_dvct.cli.settings import settings
from warp_dvct.cli.warmup import warmup
from warp_dvct.errors import DvctError

TERMINATED = 128 + signal.SIGTERM
INTERRUPTED = 128 + signal.SIGINT


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="warp-dvct", prog_name="warp-dvct")
def cli() -> None:
    """Insert synthetic objects into real scenes with physically convincing light."""


for command in (bench, calibrate, relight, plan, probe, reconstruct, settings, scenes, warmup, capture):
    cli.add_command(command)
capture.add_command(place)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command and exit; an error that a user can mend is one line on stderr."""
    signal.signal(signal.SIGTERM, _terminate)
    sys.exit(_run(arguments))


def _run(arguments: Sequence[str] | None) -> int:
    try:
        return cli.main(arguments, prog_name="warp-dvct", standalone_mode=False) or 0
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (KeyboardInterrupt, click.Abort):
        click.echo("warp-dvct: interrupted", err=True)
        return INTERRUPTED
    except DvctError as error:
        message = str(error)
    except MemoryError:
        message = "out of memory; lower --imageWidth or --set volume.resolution"
    click.echo(f"warp-dvct: error: {' '.join(message.split())}", err=True)
    return 1


def _terminate(_number: int, _frame: FrameType | None) -> None:
    """Leave by an exception, so that temporary files are removed."""
    raise SystemExit(TERMINATED)

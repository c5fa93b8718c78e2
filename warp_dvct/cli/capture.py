"""``warp-dvct capture``: captures from depth cameras."""

from __future__ import annotations

import sys
from typing import Any

import click
from tqdm import tqdm

SHOWN = 10  # frames that were left out, listed one by one


class Numbers(click.ParamType):
    """Numbers separated by commas."""

    name = "numbers"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """Refuse what is no list of finite numbers."""
        try:
            return tuple(float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"'{value}' is not a list of numbers as 0.1,-0.2,0,0", param, ctx)


class Bar:
    """A bar over counted steps on a terminal; nothing elsewhere. Called with steps done and in all."""

    def __init__(self, label: str) -> None:
        self._bar = tqdm(desc=label, leave=False, file=sys.stderr, disable=not sys.stderr.isatty())

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def __call__(self, done: int, total: int) -> None:
        self._bar.total = total
        self._bar.update(done - self._bar.n)


@click.group()
def capture() -> None:
    """Bring in captures from depth cameras, simulate them."""


@capture.command("import")
@click.argument("folder")
@click.option("-o", "--output", required=True, metavar="FILE", help="Stage to write, as capture.usda.")
@click.option(
    "--format",
    "format",
    type=click.Choice(["auto", "redwood", "tum", "7scenes", "scannet", "pair"]),
    default="auto",
    show_default=True,
    help="What FOLDER holds.",
)
@click.option("--intrinsics", metavar="FILE", help="Of the depth camera: a file with the matrix, or FX,FY,CX,CY.")
@click.option("--color-intrinsics", metavar="FILE", help="Of the colour camera; the same forms.")
@click.option("--distortion", type=Numbers(), metavar="K1,K2,P1,P2,…", help="OpenCV's coefficients of depth images.")
@click.option("--color-distortion", type=Numbers(), metavar="K1,K2,P1,P2,…", help="The same of photographs.")
@click.option("--depth-unit", type=float, metavar="METRES", help="Per step of the depth images, as 0.001.")
@click.option(
    "--color-extrinsic",
    metavar="FILE",
    help="4 x 4 from depth to colour camera; or kinect (25 mm), registered (same view), none (no colour).",
)
@click.option(
    "--up",
    type=click.Choice(["auto", "x", "-x", "y", "-y", "z", "-z"]),
    default="auto",
    show_default=True,
    help="World axis that points up; auto: where the cameras' tops point.",
)
@click.option("--fps", type=click.FloatRange(0.0, min_open=True), default=30.0, show_default=True)
def import_(folder: str, output: str, **options: Any) -> None:
    """Make a capture stage of FOLDER, a dataset with depth and colour images; they stay where they are."""
    from warp_dvct.capture.importers import ImportOptions, import_capture

    check_stage_name(output)
    with Bar("reading frames") as bar:
        done = import_capture(folder, output, ImportOptions(**options), bar)
    for line in done.notes:
        click.echo(f"warp-dvct: {line}", err=True)
    for line in done.skipped[:SHOWN]:
        click.echo(f"warp-dvct: left out: {line}", err=True)
    if len(done.skipped) > SHOWN:
        click.echo(f"warp-dvct: and {len(done.skipped) - SHOWN} more", err=True)
    click.echo(
        f"{output}: {done.frames} frames ({done.format}), {done.colored} with colour, {done.posed} with a pose,"
        f" {len(done.skipped)} left out; median depth {done.median_depth:.2f} m, {done.up} is up"
    )


def check_stage_name(output: str) -> None:
    """Refuse a name that USD would not know how to write.

    Raises:
        UsageError: It does not end in .usda, .usdc or .usd.
    """
    if not output.lower().endswith((".usda", ".usdc", ".usd")):
        raise click.UsageError(f"OUTPUT is '{output}'; its name must end in .usda, .usdc or .usd")

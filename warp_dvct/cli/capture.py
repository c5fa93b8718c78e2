"""``warp-dvct capture``: captures from depth cameras."""

from __future__ import annotations

import sys
from typing import Any

import click
from tqdm import tqdm

SHOWN = 10  # frames that were left out, listed one by one
CLIPPED = 0.01  # share of clipped pixels from which it is said


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
    """Import captures from depth cameras, simulate them."""


@capture.command("import")
@click.argument("folder")
@click.option("-o", "--output", required=True, metavar="FILE", help="Stage to write, as capture.usda.")
@click.option(
    "--format",
    "format",
    type=click.Choice(["auto", "redwood", "tum", "7scenes", "scannet", "pair", "points"]),
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
@click.option(
    "--size", type=click.IntRange(min=2), nargs=2, metavar="WIDTH HEIGHT", help="Of organised clouds in a USD stage."
)
@click.option("--fps", type=click.FloatRange(0.0, min_open=True), default=30.0, show_default=True)
def import_(folder: str, output: str, **options: Any) -> None:
    """Make a capture stage of FOLDER, a dataset with depth and colour images; they stay where they are.

    FOLDER may also be a USD stage with organised point clouds.
    """
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


@capture.command()
@click.argument("stage")
@click.option("-o", "--output", required=True, metavar="FOLDER", help="Folder for capture.usda, truth.usda and images.")
@click.option("--frames", type=click.IntRange(min=1), default=60, show_default=True, help="How many.")
@click.option(
    "--size", type=click.IntRange(min=8), nargs=2, default=(640, 480), show_default=True, metavar="WIDTH HEIGHT"
)
@click.option(
    "--path",
    type=click.Choice(["auto", "stage", "orbit", "handheld"]),
    default="auto",
    show_default=True,
    help="Of the camera: the stage's own where it is animated, an arc about what it looks at, or a hand's.",
)
@click.option("--arc", type=float, default=50.0, show_default=True, metavar="DEGREES", help="Of an orbit.")
@click.option("--camera", "-cam", metavar="PATH", help="Camera of the stage. Needed where there are several.")
@click.option("--unregistered", is_flag=True, help="Colour from a camera of its own, 25 mm to the right.")
@click.option("--no-noise", is_flag=True, help="Measure the true depth.")
@click.option(
    "--without",
    multiple=True,
    type=click.Choice(["disparity", "quantization", "lateral", "jumps", "incidence", "range"]),
    help="Leave out one effect of the sensor. May be repeated.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the noise and the hand.")
@click.option("--exposure", type=float, default=0.0, show_default=True, metavar="STOPS", help="Of the photographs.")
@click.option(
    "--quality", type=click.Choice(["draft", "balanced", "high"]), default="draft", show_default=True, help="Of light."
)
@click.option("--device", default="cpu", show_default=True, metavar="DEVICE", help="cpu, cuda or cuda:N.")
@click.option("--threads", type=click.IntRange(min=1), metavar="N", help="CPU threads. Default: all cores.")
def simulate(
    stage: str,
    output: str,
    size: tuple[int, int],
    no_noise: bool,
    without: tuple[str, ...],
    camera: str | None,
    device: str,
    threads: int | None,
    **options: Any,
) -> None:
    """Record the real part of STAGE with a simulated Kinect v1, and write the truth beside it."""
    from warp_dvct.capture.noise import EFFECTS, KinectNoise
    from warp_dvct.capture.simulate import Simulation
    from warp_dvct.capture.simulate import simulate as record
    from warp_dvct.cli.quiet import start_warp

    start_warp(device)
    noise = KinectNoise.only(*(e for e in EFFECTS if not no_noise and e not in without))
    asked = Simulation(width=size[0], height=size[1], noise=noise, **options)
    with Bar("simulating") as bar:
        done = record(stage, output, asked, camera=camera, device=device, threads=threads, progress=bar)
    if done.clipped > CLIPPED:
        click.echo(
            f"warp-dvct: warning: {done.clipped:.0%} of the photographs' pixels are clipped; lower --exposure", err=True
        )
    click.echo(f"{done.capture}: {asked.frames} frames, {done.valid:.0%} of the depth measured; truth in {done.truth}")

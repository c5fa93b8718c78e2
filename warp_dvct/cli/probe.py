"""``warp-dvct probe``: from an image of a place to its lights."""

from __future__ import annotations

import os
from pathlib import Path

import click
import numpy as np

from warp_dvct.errors import FileError
from warp_dvct.image import check_writable, read_plate, write_radiance, write_text
from warp_dvct.probe import LAYOUTS, LOOKS, Lens, extract_lights, lights_usda, to_latlong

CLIPPED = 0.001  # share of pixels at an LDR image's white from which it is said that light is missing


@click.command()
@click.argument("image")
@click.option("-o", "--output", required=True, metavar="FILE", help="USD layer to write; its texture lies beside it.")
@click.option(
    "--layout", type=click.Choice(LAYOUTS), default="latlong", show_default=True, help="How directions lie in IMAGE."
)
@click.option("--exposure", type=float, default=0.0, show_default=True, metavar="STOPS", help="Of the light.")
@click.option("--peaks", type=click.IntRange(0, 64), default=4, show_default=True, help="Distant lights at most.")
@click.option(
    "--least",
    type=click.FloatRange(0.0, 1.0),
    default=0.05,
    show_default=True,
    help="Share of all light below which a peak stays in the dome.",
)
@click.option("--height", type=click.IntRange(2, 8192), help="Of the lat-long texture made of other layouts.")
@click.option("--fov", type=float, metavar="DEGREES", help="fisheye: full angle of the image circle.")
@click.option("--radius", type=float, metavar="PIXELS", help="fisheye: radius of the image circle.")
@click.option("--center", type=float, nargs=2, metavar="X Y", help="fisheye: the circle's centre; default the middle.")
@click.option(
    "--look", type=click.Choice(LOOKS), default="up", show_default=True, help="fisheye: where the lens points."
)
def probe(
    image: str,
    output: str,
    layout: str,
    exposure: float,
    peaks: int,
    least: float,
    height: int | None,
    fov: float | None,
    radius: float | None,
    center: tuple[float, float] | None,
    look: str,
) -> None:
    """Make a DomeLight, and DistantLights for its peaks, of IMAGE (HDR, or LDR with an exposure)."""
    if not output.lower().endswith((".usda", ".usd")):
        raise click.UsageError(f"OUTPUT is '{output}'; its name must end in .usda")
    texture = Path(output).with_suffix(".exr")
    for target in (output, texture):
        check_writable(target)
    lens = None
    if fov is not None and radius is not None:
        lens = Lens(float(np.radians(fov)), radius, center, look)
    try:
        pixels = read_plate(image)
    except FileError as error:
        raise FileError(str(error).replace("plate '", "image '", 1)) from error
    if float((pixels.max(-1) >= 1.0).mean()) > CLIPPED and pixels.max() <= 1.0:
        click.echo(f"warp-dvct: warning: {image}: its brightest parts are clipped, their light is missing", err=True)
    lights = extract_lights(
        to_latlong(pixels, layout, height=height, lens=lens) * 2.0**exposure, most=peaks, least=least
    )
    write_radiance(texture, lights.dome)
    write_text(output, lights_usda(lights, texture.name, os.path.basename(image)))
    given, kept = (" ".join(f"{c:.4g}" for c in e) for e in lights.horizontal)
    click.echo(f"{output}: a dome and {len(lights.peaks)} distant light(s); horizontal irradiance {given}, kept {kept}")

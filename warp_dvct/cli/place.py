"""``warp-dvct capture place``: a synthetic object onto a real surface."""

from __future__ import annotations

import os
from typing import Any

import click

from warp_dvct.cli.capture import Numbers, check_stage_name
from warp_dvct.image import check_writable

UNEVEN = 0.01  # metres rms from the plane, above which it is said
BUNNY = "bunny"
CLAY = (0.7, 0.62, 0.5)  # of the bundled stage with the bunny, whose model brings no colour


@click.command()
@click.argument("stage")
@click.argument("object_", metavar="OBJECT")
@click.option("-o", "--output", required=True, metavar="FILE", help="USD stage to write.")
@click.option("--pixel", type=Numbers(), metavar="U,V", help="Onto what this pixel of the photograph shows.")
@click.option("--frame", type=float, metavar="N", help="Time code of that photograph. Default: the first.")
@click.option("--marker", type=click.IntRange(min=0), metavar="ID", help="Onto the marker with this number.")
@click.option("--marker-size", type=click.FloatRange(0.0, min_open=True), metavar="METRES", help="Edge of its black.")
@click.option("--dictionary", default="DICT_4X4_50", show_default=True, help="Of the marker, as OpenCV names it.")
@click.option("--scale", type=float, default=1.0, show_default=True, help="Factor on the object's own size.")
@click.option("--height", type=float, metavar="METRES", help="The object's height, in place of --scale.")
@click.option(
    "--turn", type=float, default=0.0, show_default=True, metavar="DEGREES", help="About the surface's normal."
)
@click.option("--color", type=Numbers(), metavar="R,G,B", help="Linear colour of an object that brings none.")
@click.option("--camera", metavar="PATH", help="Depth camera; needed where the stage has several.")
def place(
    stage: str,
    object_: str,
    output: str,
    pixel: tuple[float, ...] | None,
    frame: float | None,
    marker: int | None,
    marker_size: float | None,
    dictionary: str,
    camera: str | None,
    **size: Any,
) -> None:
    """Stand OBJECT (a USD file, or bunny) upright on a surface of STAGE, a capture or a reconstructed scene.

    Say where by --pixel, or by --marker and --marker-size. OUTPUT holds STAGE and the object, tagged synthetic.
    """
    check_stage_name(output)
    if (pixel is None) == (marker is None):
        raise click.UsageError("say where: either --pixel U,V or --marker ID")
    if pixel is not None and len(pixel) != 2:
        raise click.UsageError("--pixel takes a column and a row, as 320,240")
    if marker is not None and marker_size is None:
        raise click.UsageError("--marker needs --marker-size: how long an edge of its black square is, in metres")
    check_writable(output)
    thing, model, reach = _object(object_, size)
    from warp_dvct.capture import spots
    from warp_dvct.capture.place import place_object
    from warp_dvct.capture.stage import open_capture
    from warp_dvct.usd.stage import open_stage

    opened = open_stage(stage)
    capture = open_capture(opened, camera=camera)
    surface = spots.fused_points(opened, capture)
    if pixel is not None:
        index = 0 if frame is None else spots.frame_index(capture, frame)
        spot = spots.spot_at_pixel(capture, index, (pixel[0], pixel[1]), reach=reach, surface=surface)
    else:
        from warp_dvct.capture.markers import spot_on_marker

        assert marker is not None
        assert marker_size is not None
        spot = spot_on_marker(capture, marker, marker_size, dictionary, surface=surface)
    if spot.roughness > UNEVEN:
        click.echo(
            f"warp-dvct: warning: the surface there is uneven, {1000 * spot.roughness:.0f} mm rms from a plane",
            err=True,
        )
    path = place_object(stage, output, spot, thing, model)
    where = " ".join(f"{x:.3f}" for x in spot.position)
    click.echo(f"{output}: {path} stands at ({where}) m on a surface with the normal {_words(spot.normal)}")


def _object(name: str, size: dict[str, Any]) -> tuple[Any, Any, float]:
    """The object, its model, and the radius that it covers."""
    from warp_dvct.capture.place import PlacedObject, footprint, read_model

    color = size.pop("color")
    if color is not None and (len(color) != 3 or min(color) < 0.0 or max(color) > 1.0):
        raise click.UsageError("--color takes three numbers from 0 to 1, as 0.7,0.6,0.5")
    if name == BUNNY and not os.path.exists(name):
        from warp_dvct.usd_scenes import bunny_model

        name, color = bunny_model(), color or CLAY
    thing = PlacedObject(name, color=color, **size)
    model = read_model(name)
    return thing, model, footprint(model, thing)


def _words(direction: Any) -> str:
    return "(" + " ".join(f"{x:.2f}" for x in direction) + ")"

"""``warp-dvct reconstruct``: from a capture to a stage that relights."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import click

from warp_dvct.cli.progress import Progress
from warp_dvct.cli.quiet import start_warp
from warp_dvct.image import check_writable

if TYPE_CHECKING:
    from warp_dvct.capture.reconstruct import Reconstruction

SKIPPED_SHOWN = 10


@click.command()
@click.argument("capture")
@click.option("-o", "--output", required=True, metavar="FILE", help="USD stage to write; its mesh lies beside it.")
@click.option(
    "--voxel", type=click.FloatRange(0.0001, 1.0), default=0.01, show_default=True, metavar="METRES", help="Edge."
)
@click.option("--near", type=float, default=0.1, show_default=True, metavar="METRES", help="Least depth used.")
@click.option("--far", type=float, default=4.0, show_default=True, metavar="METRES", help="Largest depth used.")
@click.option(
    "--truncation",
    type=click.FloatRange(1.0, 64.0),
    default=4.0,
    show_default=True,
    metavar="VOXELS",
    help="Distance behind a surface up to which a frame tells of it.",
)
@click.option(
    "--weight",
    type=click.FloatRange(1.0),
    metavar="FRAMES",
    help="Least number of frames that saw a vertex. Default: half of the frames, at most 3.",
)
@click.option("--no-smooth", is_flag=True, help="Take depth images as they are.")
@click.option(
    "--least-area",
    type=click.FloatRange(0.0),
    metavar="M2",
    help="Drop parts smaller than this. Default: the square of 10 voxels.",
)
@click.option("--close-holes", type=click.FloatRange(0.0), default=0.0, metavar="METRES", help="Up to that radius.")
@click.option("--triangles", type=click.IntRange(min=4), metavar="N", help="Decimate the mesh to that many.")
@click.option(
    "--track",
    type=click.Choice(["odometry", "model"]),
    help="Find poses anew: each frame from the one before, or from the surface fused so far.",
)
@click.option("--markers", is_flag=True, help="Find poses anew by square markers of --marker-size.")
@click.option("--marker-size", type=click.FloatRange(0.0, min_open=True), metavar="METRES", help="Edge of their black.")
@click.option("--dictionary", default="DICT_4X4_50", show_default=True, help="Of the markers, as OpenCV names it.")
@click.option("--probe", metavar="FILE", help="Lights of the real scene, as `warp-dvct probe` writes them.")
@click.option(
    "--estimate-light",
    is_flag=True,
    help="Fit a dome and one direction to the shading. The default without --probe where the capture has no lights.",
)
@click.option("--no-light", is_flag=True, help="Author no light; albedo is the camera's colour.")
@click.option(
    "--albedo",
    type=click.Choice(["irradiance", "color"]),
    default="irradiance",
    show_default=True,
    help="Photographs over the light that fell on the surface, or the camera's colour as it is.",
)
@click.option(
    "--unseen",
    type=click.Choice(["auto", "room", "dome", "none"]),
    default="auto",
    show_default=True,
    help="What reflects light where no frame has seen anything and lamps are known: a box in which walls go on, even"
    " light, or nothing. auto: a room where the scan looks like one, else a dome.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of every random number.")
@click.option(
    "--device", default="cpu", show_default=True, metavar="DEVICE", help="Of light and albedo: cpu or cuda:N."
)
@click.option("--camera", metavar="PATH", help="Depth camera; needed where the stage has several.")
@click.option("--threads", type=click.IntRange(min=1), metavar="N", help="CPU threads. Default: all cores.")
def reconstruct(
    capture: str,
    output: str,
    no_smooth: bool,
    track: str | None,
    markers: bool,
    marker_size: float | None,
    dictionary: str,
    probe: str | None,
    estimate_light: bool,
    no_light: bool,
    albedo: str,
    unseen: str,
    seed: int,
    device: str,
    camera: str | None,
    threads: int | None,
    **shape: Any,
) -> None:
    """Fuse the depth images of CAPTURE into a mesh and write a stage of it, its cameras, plates and lights."""
    if not output.lower().endswith((".usda", ".usd", ".usdc")):
        raise click.UsageError(f"OUTPUT is '{output}'; its name must end in .usda, .usd or .usdc")
    check_writable(output)
    if no_light and (probe or estimate_light):
        raise click.UsageError("--no-light goes with neither --probe nor --estimate-light")
    if markers and (track or marker_size is None):
        raise click.UsageError("--markers needs --marker-size, and goes without --track")
    start_warp(device)
    from warp_dvct.capture.frames import Skipped
    from warp_dvct.capture.fusion import FusionOptions
    from warp_dvct.capture.markers import track_by_markers
    from warp_dvct.capture.reconstruct import ReconstructOptions
    from warp_dvct.capture.reconstruct import reconstruct as run
    from warp_dvct.capture.source import CaptureFrames
    from warp_dvct.capture.stage import open_capture
    from warp_dvct.capture.tracking import track_capture

    fusion = FusionOptions(smooth=not no_smooth, **shape)
    options = ReconstructOptions(fusion, albedo, probe, estimate_light, not no_light, unseen, seed)
    opened = open_capture(capture, camera=camera)
    poses, skipped = None, Skipped()
    if track or markers:
        with Progress(f"{os.path.basename(output)}: tracking") as progress:
            if marker_size is not None and markers:
                found = track_by_markers(opened, marker_size, dictionary, progress=progress.update)
            else:
                assert track is not None
                found = track_capture(opened, track, fusion, threads=threads, progress=progress.update)
        poses, skipped.reasons = found.poses, dict(found.lost)
    frames = CaptureFrames(opened, poses)
    with Progress(os.path.basename(output)) as progress:
        more = {"device": device, "threads": threads, "progress": progress.update}
        made = run(opened, frames, output, options, poses=poses, skipped=skipped, **more)
    _report(made, output, len(opened))


def _report(made: Reconstruction, output: str, count: int) -> None:
    """What became of the frames, and what was noticed."""
    mesh = made.mesh
    for note in made.notes:
        click.echo(f"warp-dvct: {note}", err=True)
    _report_skipped(mesh.skipped, count)
    click.echo(
        f"{output}: {len(mesh.triangles)} triangles from {mesh.frames} of {count} frames;"
        f" {mesh.dropped} of {mesh.components} parts dropped"
    )


def _report_skipped(skipped: dict[int, str], count: int) -> None:
    for reason in list(skipped.values())[:SKIPPED_SHOWN]:
        click.echo(f"warp-dvct: warning: left out: {reason}", err=True)
    if len(skipped) > SKIPPED_SHOWN:
        click.echo(f"warp-dvct: warning: and {len(skipped) - SKIPPED_SHOWN} more of {count} frames", err=True)

"""``warp-dvct reconstruct``: from a capture to a stage that relights."""

from __future__ import annotations

import os

import click

from warp_dvct.cli.progress import Progress
from warp_dvct.image import check_writable

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
@click.option("--probe", metavar="FILE", help="Lights of the real scene, as `warp-dvct probe` writes them.")
@click.option("--camera", metavar="PATH", help="Depth camera; needed where the stage has several.")
@click.option("--threads", type=click.IntRange(min=1), metavar="N", help="CPU threads. Default: all cores.")
def reconstruct(
    capture: str,
    output: str,
    voxel: float,
    near: float,
    far: float,
    truncation: float,
    weight: float | None,
    no_smooth: bool,
    least_area: float | None,
    close_holes: float,
    triangles: int | None,
    probe: str | None,
    camera: str | None,
    threads: int | None,
) -> None:
    """Fuse the depth images of CAPTURE into a mesh and write a stage of it, its cameras, plates and lights."""
    if not output.lower().endswith((".usda", ".usd", ".usdc")):
        raise click.UsageError(f"OUTPUT is '{output}'; its name must end in .usda, .usd or .usdc")
    check_writable(output)
    from warp_dvct.capture.fusion import FusionOptions, fuse
    from warp_dvct.capture.scene_stage import SceneLights, write_scene
    from warp_dvct.capture.source import CaptureFrames
    from warp_dvct.capture.stage import open_capture

    options = FusionOptions(
        voxel=voxel,
        truncation=truncation,
        near=near,
        far=far,
        weight=weight,
        smooth=not no_smooth,
        least_area=least_area,
        close_holes=close_holes,
        triangles=triangles,
    )
    opened = open_capture(capture, camera=camera)
    with Progress(os.path.basename(output)) as progress:
        mesh = fuse(CaptureFrames(opened), options, threads=threads, progress=progress.update)
    lights = None if probe is None else SceneLights(file=probe)
    write_scene(output, opened, mesh, lights=lights, facts={"voxel": voxel})
    _report_skipped(mesh.skipped, len(opened))
    click.echo(
        f"{output}: {len(mesh.triangles)} triangles from {mesh.frames} of {len(opened)} frames;"
        f" {mesh.dropped} of {mesh.components} parts dropped"
    )


def _report_skipped(skipped: dict[int, str], count: int) -> None:
    for reason in list(skipped.values())[:SKIPPED_SHOWN]:
        click.echo(f"warp-dvct: warning: left out: {reason}", err=True)
    if len(skipped) > SKIPPED_SHOWN:
        click.echo(f"warp-dvct: warning: and {len(skipped) - SKIPPED_SHOWN} more of {count} frames", err=True)

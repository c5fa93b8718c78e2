"""What a frame relit from live depth takes: filtering, the live scene, its upload, the plate and the picture."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from warp_dvct.capture.importers import import_capture
from warp_dvct.capture.live import LiveSource
from warp_dvct.capture.place import PlacedObject, place_object, read_model
from warp_dvct.capture.spots import spot_at_pixel
from warp_dvct.capture.stage import Capture, open_capture
from warp_dvct.image import read_plate
from warp_dvct.launch import Launcher
from warp_dvct.relighter import Relighter
from warp_dvct.usd_scenes import bunny_model

MOST_FRAMES = 8
PICKED = 0.47, 0.86  # of the photograph's width and height: where the bunny stands
HEIGHT = 0.25  # metres


def time_live(
    stage: str | Path, capture: Capture, *, quality: str, device: str, threads: int | None
) -> tuple[float, float]:
    """Median seconds of a frame, by the clock and of processor, once kernels are compiled and a frame lies before.

    Args:
        stage: With synthetic objects in the capture's world.
    """
    source = LiveSource(stage, capture, launcher=Launcher(device, threads))
    times = [t for k, t in enumerate(capture.times) if capture.pose(k) is not None][:MOST_FRAMES]
    width, height = source.size
    relighter = Relighter(
        source.scene(times[0]), width=width, height=height, quality=quality, device=device, threads=threads
    )
    relighter.render(_plate(relighter))
    spent = []
    for number in times[1:] or times:
        wall, processor = time.perf_counter(), time.process_time()
        relighter.set_scene(source.scene(number))
        relighter.render(_plate(relighter))
        spent.append((time.perf_counter() - wall, time.process_time() - processor))
    middle = np.median(spent, axis=0)
    return float(middle[0]), float(middle[1])


def _plate(relighter: Relighter) -> np.ndarray | None:
    file = relighter.scene.plate
    return None if file is None else read_plate(file, relighter.width, relighter.height)


def time_dataset(folder: str | Path, *, quality: str, device: str, threads: int | None) -> tuple[float, float]:
    """As :func:`time_live`, of a dataset that can be imported, with a bunny low in the middle of its picture."""
    with tempfile.TemporaryDirectory() as made:
        file, placed = Path(made) / "capture.usda", Path(made) / "placed.usda"
        import_capture(folder, file)
        capture = open_capture(file)
        first = next((k for k in capture if capture.pose(k) is not None), 0)
        lens = capture.rig.color or capture.rig.depth
        pixel = PICKED[0] * lens.width, PICKED[1] * lens.height
        bunny = PlacedObject(bunny_model(), height=HEIGHT)
        place_object(file, placed, spot_at_pixel(capture, first, pixel), bunny, read_model(bunny.file))
        return time_live(placed, capture, quality=quality, device=device, threads=threads)

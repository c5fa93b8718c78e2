"""Real captures, end to end: import, reconstruct, place the bunny, relight by each method."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from captures import DATA

from warp_dvct.capture import spots
from warp_dvct.capture.fusion import FusionOptions
from warp_dvct.capture.importers import ImportOptions, import_capture
from warp_dvct.capture.place import PlacedObject, place_object, read_model
from warp_dvct.capture.reconstruct import ReconstructOptions, reconstruct
from warp_dvct.capture.source import CaptureFrames
from warp_dvct.capture.stage import open_capture
from warp_dvct.image import read_plate
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Role
from warp_dvct.usd_scenes import bunny_model

HEIGHT = 0.25  # metres
# Folder, a pixel of the floor or the table, and how much of the picture the surface covers at least.
SHOTS = {"redwood": ((300, 410), 0.5), "tum_pair": ((250, 215), 0.6)}


@pytest.fixture(scope="module", params=sorted(SHOTS))
def shot(request, tmp_path_factory) -> tuple[str, Path, spots.Spot]:
    """The capture with the bunny in it."""
    if not (DATA / request.param).is_dir():
        pytest.skip(f"{DATA / request.param} is absent")
    folder = tmp_path_factory.mktemp(request.param)
    import_capture(DATA / request.param, folder / "capture.usda", ImportOptions())
    capture = open_capture(folder / "capture.usda")
    options = ReconstructOptions(FusionOptions(voxel=0.03), estimate_light=True)
    reconstruct(capture, CaptureFrames(capture), folder / "scene.usda", options)
    from warp_dvct.usd.stage import open_stage

    stage = open_stage(folder / "scene.usda")
    pixel = SHOTS[request.param][0]
    spot = spots.spot_at_pixel(capture, 0, pixel, surface=spots.fused_points(stage, capture))
    thing = PlacedObject(bunny_model(), height=HEIGHT, color=(0.7, 0.62, 0.5))
    place_object(folder / "scene.usda", folder / "shot.usda", spot, thing, read_model(thing.file))
    return request.param, folder / "shot.usda", spot


@pytest.mark.parametrize("method", ["delta-cones", "instant-radiosity", "path-trace"])
def test_the_bunny_stands_in_the_photograph(shot, method):
    name, file, spot = shot
    settings = {"samples": 4, "bounces": 2} if method == "path-trace" else {}
    relighter = Relighter(file, method=method, quality="draft", width=640, settings=settings)
    plate = read_plate(relighter.scene.plate, 640)  # type: ignore[arg-type]
    layers = relighter.render(plate)

    covered = np.isfinite(layers.depth) | (layers.mask_synthetic > 0)
    assert covered.mean() > SHOTS[name][1]

    # Scale: as high in the picture as its height and distance say, and standing where it was put.
    rows, columns = np.nonzero(layers.mask_synthetic > 0.5)
    camera = relighter.scene.camera
    local = np.linalg.inv(camera.to_world) @ np.append(spot.position, 1.0)
    foot = (-local[0] / local[2] - camera.tan_left) / (camera.tan_right - camera.tan_left) * 640
    tall = HEIGHT / -local[2] * 640 / (camera.tan_right - camera.tan_left)
    assert abs(columns.mean() - foot) < 0.3 * tall
    assert 0.7 * tall < np.ptp(rows) < 1.4 * tall

    # It darkens the surface below it, and nothing far away.
    points = layers.position.reshape(-1, 3)
    real = (layers.mask_synthetic == 0).ravel() & np.isfinite(layers.depth).ravel()
    distance = np.linalg.norm(points - spot.position, axis=-1)
    below = real & (distance < 0.6 * HEIGHT) & (np.abs((points - spot.position) @ spot.normal) < 0.02)
    shadow = layers.shadow.reshape(-1, 3).mean(-1)
    assert below.sum() > 50
    assert np.percentile(shadow[below], 10) < 0.97
    far = real & (distance > 6.0 * HEIGHT)
    change = np.abs(layers.comp - layers.plate).reshape(-1, 3).max(-1)
    assert change[far].mean() < 0.01
    assert np.percentile(change[far], 95) < 0.01

    untouched = (layers.delta == 0).all(-1) & (layers.mask_synthetic == 0)
    assert untouched.any()
    np.testing.assert_array_equal(layers.comp[untouched], layers.plate[untouched])


def test_the_object_is_synthetic_and_the_scan_real(shot):
    scene = Relighter(shot[1], width=64).scene
    assert {m.path.split("/")[1]: m.role for m in scene.meshes} == {"Capture": Role.REAL, "Synthetic": Role.SYNTHETIC}

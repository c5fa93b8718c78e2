"""The stage that reconstruction writes, and objects placed on it."""

from __future__ import annotations

import numpy as np
import pytest

from warp_dvct.capture import spots
from warp_dvct.capture.fusion import FusionOptions
from warp_dvct.capture.place import PlacedObject, axes, place_object, read_model
from warp_dvct.capture.reconstruct import ReconstructOptions, reconstruct
from warp_dvct.capture.source import CaptureFrames
from warp_dvct.capture.stage import Capture, open_capture
from warp_dvct.errors import OptionError, StageError
from warp_dvct.relighter import Relighter
from warp_dvct.scene import LightKind, Role
from warp_dvct.usd.read import read_stage
from warp_dvct.usd_scenes import bunny_model

PLAIN = ReconstructOptions(FusionOptions(voxel=0.03), light=False)


@pytest.fixture(scope="module")
def scene(tmp_path_factory, room_capture):
    """The room's capture reconstructed under a dome."""
    folder = tmp_path_factory.mktemp("scene")
    probe = folder / "lights.usda"
    probe.write_text(
        '#usda 1.0\n(\n    defaultPrim = "Lights"\n    metersPerUnit = 0.01\n    upAxis = "Z"\n)\n'
        'def Xform "Lights"\n{\n    def DomeLight "Dome"\n    {\n        float inputs:intensity = 0.5\n    }\n'
        '    def DistantLight "Sun"\n    {\n        float inputs:intensity = 100\n    }\n}\n'
    )
    options = ReconstructOptions(FusionOptions(voxel=0.03), albedo="color", probe=str(probe))
    reconstruct(room_capture, CaptureFrames(room_capture), folder / "scene.usda", options)
    return folder / "scene.usda"


def problems(file) -> list[str]:
    from pxr import Usd, UsdValidation

    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    return [f"{e.GetName()}: {e.GetMessage()}" for e in context.Validate(Usd.Stage.Open(str(file)))]


def test_stage_is_valid_and_reads_as_real_surface(scene, room_capture):
    assert problems(scene) == []
    read = read_stage(scene, allow_empty_roles=True)
    assert [m.path for m in read.meshes] == ["/Capture/mesh"]
    assert read.meshes[0].role == Role.REAL
    assert read.camera.path == room_capture.color_path  # of the capture's two cameras, the one with the plate
    assert read.plate is not None
    assert read.plate.endswith("color/00000.png")
    material = read.materials[int(read.meshes[0].materials[0])]
    assert material.specular_color == (0.0, 0.0, 0.0)
    colors = read.meshes[0].corner_colors
    assert colors is not None
    assert np.ptp(colors.reshape(-1, 3), axis=0).min() > 0.1


def test_capture_is_still_there(scene, room_capture):
    again = open_capture(scene)
    assert again.times == room_capture.times
    np.testing.assert_allclose(again.pose(3), room_capture.pose(3))
    np.testing.assert_array_equal(again.depth(3), room_capture.depth(3))


def test_mesh_is_a_payload_in_a_crate(scene):
    from pxr import Sdf, Usd

    layer = Sdf.Layer.FindOrOpen(str(scene))
    payloads = layer.GetPrimAtPath("/Capture/mesh").payloadList.GetAddedOrExplicitItems()
    crate = scene.with_name(payloads[0].assetPath)
    assert crate.read_bytes()[:8] == b"PXR-USDC"
    unloaded = Usd.Stage.Open(str(scene), Usd.Stage.LoadNone)
    assert not unloaded.GetPrimAtPath("/Capture/mesh").GetAttribute("points").Get()


def test_lights_of_a_probe_in_other_axes_and_units_point_the_same_way(scene):
    lights = {x.kind: x for x in read_stage(scene, allow_empty_roles=True).lights}
    assert set(lights) == {LightKind.DOME, LightKind.DISTANT}
    # A distant light shines along -Z; in a z-up layer that is down.
    np.testing.assert_allclose(lights[LightKind.DISTANT].direction, [0.0, -1.0, 0.0], atol=1e-6)


def test_an_interruption_leaves_what_was_there(tmp_path, room_capture):
    target = tmp_path / "scene.usda"
    source = CaptureFrames(room_capture)
    reconstruct(room_capture, source, target, PLAIN)
    before = {f.name: f.read_bytes() for f in tmp_path.iterdir()}

    def interrupt(name: str, share: float) -> None:
        if name == "cleaning":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(room_capture, source, target, PLAIN, progress=interrupt)
    assert {f.name: f.read_bytes() for f in tmp_path.iterdir()} == before
    reconstruct(room_capture, source, target, PLAIN)
    assert {f.name for f in tmp_path.iterdir()} == set(before)


def test_a_full_disk_destroys_nothing(tmp_path, room_capture, monkeypatch):
    from warp_dvct.capture import scene_stage
    from warp_dvct.errors import FileError

    target = tmp_path / "scene.usda"
    reconstruct(room_capture, CaptureFrames(room_capture), target, PLAIN)
    before = {f.name: f.read_bytes() for f in tmp_path.iterdir()}

    def full(layer, name):
        raise FileError(f"{name} cannot be written: no space left; is the disk full?")

    monkeypatch.setattr(scene_stage, "save", full)
    with pytest.raises(FileError, match=r"scene_mesh.usdc cannot be written.*disk full"):
        reconstruct(room_capture, CaptureFrames(room_capture), target, PLAIN)
    assert {f.name: f.read_bytes() for f in tmp_path.iterdir()} == before


def test_the_capture_is_not_overwritten(room_capture):
    with pytest.raises(OptionError, match="give another name"):
        reconstruct(room_capture, CaptureFrames(room_capture), room_capture.path, PLAIN)


def floor_pixel(capture: Capture, index: int) -> tuple[int, int]:
    """A pixel that shows the floor, well inside of it."""
    local = capture.depth(index)
    points = np.full((*local.shape, 3), np.nan)
    rays = capture.rig.depth.rays()
    pose = capture.pose(index)
    assert pose is not None
    points = (rays * local[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    on_floor = (np.abs(points[..., 1]) < 0.002) & (local > 0) & (np.hypot(points[..., 0], points[..., 2]) < 1.0)
    v, u = np.nonzero(on_floor)
    middle = np.argmin(np.hypot(u - u.mean(), v - v.mean()))
    return int(u[middle]), int(v[middle])


def world_bounds(file, path: str) -> tuple[np.ndarray, np.ndarray]:
    read = read_stage(file, allow_empty_roles=True, allow_no_light=True)
    points = np.concatenate([m.points for m in read.meshes if m.path.startswith(path)])
    return points.min(0), points.max(0)


@pytest.mark.parametrize("on_mesh", [False, True])
def test_object_stands_upright_on_the_picked_point(tmp_path, room_capture, scene, on_mesh):
    from warp_dvct.usd.stage import open_stage

    index = 6
    pixel = floor_pixel(room_capture, index)
    surface = spots.fused_points(open_stage(scene), room_capture) if on_mesh else None
    spot = spots.spot_at_pixel(room_capture, index, pixel, surface=surface)
    np.testing.assert_allclose(spot.normal, [0.0, 1.0, 0.0], atol=0.01)
    assert abs(spot.position[1]) < 0.004
    seen = room_capture.rig.color.project(  # type: ignore[union-attr]
        (spot.position - room_capture.color_pose(index)[:3, 3]) @ room_capture.color_pose(index)[:3, :3]  # type: ignore[index]
    )
    np.testing.assert_allclose(seen, pixel, atol=0.01)
    thing = PlacedObject(bunny_model(), height=0.3)
    out = tmp_path / "out.usda"
    path = place_object(scene, out, spot, thing, read_model(thing.file))
    assert path == "/Synthetic/bunny"
    low, high = world_bounds(out, path)
    np.testing.assert_allclose(low[1], spot.position[1], atol=0.002)
    np.testing.assert_allclose(high[1] - low[1], 0.3, rtol=0.01)
    np.testing.assert_allclose(0.5 * (low + high)[[0, 2]], spot.position[[0, 2]], atol=0.01)
    assert problems(out) == []


def test_a_second_object_gets_a_name_of_its_own_and_both_are_relit(tmp_path, room_capture, scene):
    spot = spots.spot_at_pixel(room_capture, 6, floor_pixel(room_capture, 6))
    thing = PlacedObject(bunny_model(), height=0.3, color=(0.7, 0.6, 0.5))
    model = read_model(thing.file)
    place_object(scene, tmp_path / "one.usda", spot, thing, model)
    moved = spots.make_spot(spot.position + np.array([0.3, 0.0, 0.0]), spot.normal, spot.forward)
    assert place_object(tmp_path / "one.usda", tmp_path / "two.usda", moved, thing, model) == "/Synthetic/bunny_2"
    relighter = Relighter(tmp_path / "two.usda", time=6.0, width=160, quality="draft")
    roles = [m.role for m in relighter.scene.meshes]
    assert roles.count(Role.SYNTHETIC) == 2
    layers = relighter.render()
    assert layers.mask_synthetic.max() == 1.0
    assert layers.shadow.min() < 0.95


def test_units_and_axes_of_the_model_and_turns(tmp_path, room_capture, scene):
    model_file = tmp_path / "stick.usda"
    model_file.write_text(
        '#usda 1.0\n(\n    defaultPrim = "Stick"\n    metersPerUnit = 0.01\n    upAxis = "Z"\n)\n'
        'def Mesh "Stick"\n{\n    point3f[] points = [(0, 0, 5), (20, 0, 5), (0, 0, 45)]\n'
        "    int[] faceVertexCounts = [3]\n    int[] faceVertexIndices = [0, 1, 2]\n"
        '    float3[] extent = [(0, 0, 5), (20, 0, 45)]\n    uniform token subdivisionScheme = "none"\n}\n'
    )
    spot = spots.make_spot(np.array([0.2, 0.1, 0.3]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    model = read_model(str(model_file))
    for turn, across in ((0.0, 0), (90.0, 2)):
        out = tmp_path / f"out{turn:.0f}.usda"
        place_object(scene, out, spot, PlacedObject(str(model_file), scale=0.5, turn=turn), model)
        low, high = world_bounds(out, "/Synthetic/stick")
        np.testing.assert_allclose(low[1], 0.1, atol=1e-5)
        np.testing.assert_allclose(high[1] - low[1], 0.2, atol=1e-5)
        np.testing.assert_allclose((high - low)[across], 0.1, atol=1e-5)


def test_axes_are_a_rotation_with_the_normal_up():
    spot = spots.make_spot(np.zeros(3), np.array([0.3, 0.8, 0.2]), np.array([1.0, 0.0, 0.0]))
    turn = axes(spot, 33.0)
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    np.testing.assert_allclose(turn[:, 1], spot.normal)


def test_places_that_cannot_be_are_refused(room_capture, tmp_path):
    with pytest.raises(OptionError, match="outside of the 160 x 120 picture"):
        spots.spot_at_pixel(room_capture, 0, (200, 10))
    with pytest.raises(OptionError, match="has frames 0 to 11"):
        spots.frame_index(room_capture, 99.0)
    with pytest.raises(OptionError, match="positive"):
        PlacedObject("x.usda", height=-1.0)
    empty = tmp_path / "empty.usda"
    empty.write_text('#usda 1.0\n(\n    defaultPrim = "A"\n)\ndef Xform "A"\n{\n}\n')
    with pytest.raises(StageError, match="has no geometry"):
        read_model(str(empty))
    empty.write_text("#usda 1.0\n")
    with pytest.raises(StageError, match="default prim"):
        read_model(str(empty))


def test_a_pixel_without_depth_is_refused(room_capture, monkeypatch):
    depth = room_capture.depth(0)
    depth[30:70, 50:90] = 0.0
    monkeypatch.setattr(Capture, "depth", lambda self, index: depth)
    with pytest.raises(OptionError, match="has no depth within"):
        spots.spot_at_pixel(room_capture, 0, (70, 50))

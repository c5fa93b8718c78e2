"""Relighting from live depth: against the true geometry, through the command, and on captures of real rooms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from click.testing import CliRunner

from warp_dvct.capture.importers import ImportOptions, import_capture
from warp_dvct.capture.intrinsics import undistort
from warp_dvct.capture.live import LiveOptions, LiveSource
from warp_dvct.capture.registration import sample
from warp_dvct.capture.simulate import Simulation, simulate
from warp_dvct.capture.stage import FrameFiles, open_capture, write_capture
from warp_dvct.cli import cli
from warp_dvct.errors import OptionError, StageError
from warp_dvct.image import read_plate, write_png
from warp_dvct.metrics import flip_ldr
from warp_dvct.relighter import Relighter
from warp_dvct.scene import LightKind, Role
from warp_dvct.usd.read import read_stage
from warp_dvct.usd_scenes import path as bundled

SHARED = Path(__file__).parents[3] / "shared" / "data" / "captures"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"the captures in {SHARED} are not here")
ROOM = bundled("room_area")
BALL = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Y"
)
def Sphere "Ball"
{{
    token primvars:dvct:reality = "synthetic"
    double radius = {radius}
    double3 xformOp:translate = ({x}, {y}, {z})
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}
"""


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Four frames of the room, with the sensor's noise."""
    folder = tmp_path_factory.mktemp("live")
    return simulate(ROOM, folder, Simulation(frames=4, width=160, height=120))


@pytest.fixture(scope="module")
def source(capture, launcher):
    return LiveSource(ROOM, capture.capture, launcher=launcher)


def rendered(scene, **options):
    plate = read_plate(scene.plate)
    options = {"quality": "draft", "width": plate.shape[1], "height": plate.shape[0], **options}
    return Relighter(scene, **options).render(plate)


def test_the_picture_is_near_to_that_of_the_true_geometry(source):
    live = source.scene(3.0)
    assert live.captured
    true = read_stage(ROOM, view=live.camera, plate=live.plate)
    ours, truth = rendered(live), rendered(true)
    # Objects are at the same pixels, but for the noise of what is in front of them.
    assert np.abs(ours.mask_synthetic - truth.mask_synthetic).mean() < 0.01
    assert np.abs(ours.comp - truth.comp).mean() < 0.015
    assert flip_ldr(truth.comp, ours.comp)[0] < 0.06
    real = (truth.mask_synthetic == 0) & (ours.mask_synthetic == 0)
    shadow = truth.delta.mean(-1) < -0.05
    assert shadow.sum() > 100
    assert (ours.delta.mean(-1) < -0.02)[shadow & real].mean() > 0.8
    seen = np.isfinite(truth.depth) & np.isfinite(ours.depth) & real
    assert np.median(np.abs(ours.depth - truth.depth)[seen]) < 0.01
    assert np.median((ours.normal * truth.normal).sum(-1)[seen]) > 0.98


def test_holes_keep_the_plate_and_are_listed(source, capture):
    live = source.scene(0.0)
    layers = rendered(live)
    depth = source.filtered(0.0).depth()
    assert layers.holes is not None
    # Registered images: a pixel without depth is a hole.
    unknown = (depth == 0) & (layers.mask_synthetic == 0)
    assert layers.holes[unknown].mean() > 0.8 if unknown.any() else True
    holes = layers.holes == 1
    np.testing.assert_array_equal(layers.comp[holes], layers.plate[holes])
    known = depth > 0
    assert layers.holes[known].mean() < 0.02
    plain = rendered(read_stage(ROOM, view=live.camera, plate=live.plate))
    assert plain.holes is None


def test_a_frame_does_not_depend_on_where_a_shot_begins(source, capture, launcher):
    one = LiveSource(ROOM, capture.capture, launcher=launcher).scene(2.0)
    for time in (0.0, 1.0, 2.0):
        other = source.scene(time)
    np.testing.assert_array_equal(one.meshes[0].points, other.meshes[0].points)
    np.testing.assert_array_equal(one.meshes[0].triangles, other.meshes[0].triangles)


def test_real_prims_of_the_stage_are_left_out_and_unseen_surroundings_shine(source, capture, launcher, tmp_path):
    scene = source.scene(0.0)
    path = source.capture.depth_path
    assert [mesh.path for mesh in scene.meshes if mesh.role == Role.REAL] == [path, f"{path} (surroundings)"]
    assert any(mesh.role == Role.SYNTHETIC for mesh in scene.meshes)
    assert all(light.kind != LightKind.DOME for light in scene.lights)  # the rest of the room reflects the lamp's light
    dark = LiveSource(ROOM, capture.capture, launcher=launcher, options=LiveOptions(surroundings=False)).scene(0.0)
    assert [mesh.path for mesh in dark.meshes if mesh.role == Role.REAL] == [path]
    assert all(light.kind != LightKind.DOME for light in dark.lights)
    (tmp_path / "ball.usda").write_text(BALL.format(radius=0.1, x=0, y=0.3, z=0))
    unlit = LiveSource(tmp_path / "ball.usda", capture.capture, launcher=launcher).scene(0.0)
    assert [light.kind for light in unlit.lights] == [LightKind.DOME]
    with pytest.raises(OptionError, match="tolerance"):
        LiveOptions(tolerance=0.0)


@pytest.mark.parametrize("stage", ["room", "ball"])
def test_the_rendered_real_scene_is_as_bright_as_the_photograph(stage, capture, launcher, tmp_path):
    """On average, and from place to place: what a shadow takes is a share of what the photograph has."""
    (tmp_path / "ball.usda").write_text(BALL.format(radius=0.1, x=0, y=0.3, z=0))
    source = LiveSource(ROOM if stage == "room" else tmp_path / "ball.usda", capture.capture, launcher=launcher)
    for time in (0.0, 1.0):
        scene = source.scene(time)
        real = replace(scene, meshes=tuple(mesh for mesh in scene.meshes if mesh.role == Role.REAL))
        layers = Relighter(real, width=160, height=120).render()
        photo = read_plate(scene.plate)
        seen = (layers.mask_real == 1) & (photo.max(-1) < 0.98)
        assert layers.comp[seen].mean() == pytest.approx(photo[seen].mean(), rel=0.15)
        ratio = layers.comp[seen].sum(-1) / photo[seen].sum(-1)
        assert np.std(np.log(ratio)) < 0.25


def test_a_new_light_is_not_taken_for_that_of_the_photograph(tmp_path, capture, launcher):
    ball = BALL.format(radius=0.1, x=0, y=0.3, z=0)
    lamp = 'def SphereLight "Lamp"\n{\n    token primvars:dvct:lightRole = "added"\n    float inputs:radius = 0.1\n}\n'
    scenes = []
    for name, text in (("none", ball), ("added", ball + lamp)):
        (tmp_path / f"{name}.usda").write_text(text)
        scenes.append(LiveSource(tmp_path / f"{name}.usda", capture.capture, launcher=launcher).scene(0.0))
    domes = [[light for light in scene.lights if light.kind == LightKind.DOME] for scene in scenes]
    assert [len(d) for d in domes] == [1, 1]
    assert domes[0][0].radiance == domes[1][0].radiance
    np.testing.assert_array_equal(scenes[0].textures[-1].pixels, scenes[1].textures[-1].pixels)


def test_a_lost_frame_is_said_and_the_next_one_works(tmp_path, capture, launcher):
    opened = open_capture(capture.capture)
    frames = [
        FrameFiles(opened.depth_file(k), opened.color_file(k), None if k == 1 else opened.pose(k)) for k in range(3)
    ]
    frames[0] = FrameFiles(str(tmp_path / "gone.png"), frames[0].color, frames[0].pose)
    write_capture(tmp_path / "c.usda", opened.rig, frames, world=np.eye(4))
    source = LiveSource(ROOM, tmp_path / "c.usda", launcher=launcher)
    with pytest.raises(StageError, match=r"frame 1 .* no known pose"):
        source.scene(1.0)
    assert len(source.scene(2.0).meshes[0].triangles) > 100
    assert len(source.skipped) == 1
    assert "gone.png" in source.skipped[0]
    with pytest.raises(StageError, match=r"no frame 7; its frames are 0 to 2"):
        source.scene(7.0)


def test_the_command_relights_frame_by_frame(tmp_path, capture):
    output = tmp_path / "f.####.exr"
    arguments = ["relight", str(ROOM), str(output), "--frames", "0:1", "--real-from", str(capture.capture)]
    done = CliRunner().invoke(cli, [*arguments, "--quality", "draft"])
    assert done.exit_code == 0, done.output
    with OpenEXR.File(str(tmp_path / "f.0001.exr"), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        assert file.header()["camera"] == "/Capture/depth/color"
    assert channels["holes"].shape == (120, 160)
    assert (tmp_path / "f.0001.png").exists()
    wrong = CliRunner().invoke(cli, [*arguments, "--camera", "/World/Camera"])
    assert wrong.exit_code == 2
    assert "--camera does not go with --real-from" in wrong.output


def test_depth_jumps_are_moved_to_the_edges_of_a_photograph_that_its_lens_bends(tmp_path, capture, launcher):
    """The same photograph through a lens that bends guides as through one that does not; so is the filtered depth."""
    opened = open_capture(capture.capture)
    straight = opened.rig.color
    bent = replace(straight, distortion=(-0.2, 0.05, 0.0, 0.0, 0.0))
    y, x = np.indices((bent.height, bent.width)).astype(np.float64)
    x, y = undistort((x - bent.cx) / bent.fx, (y - bent.cy) / bent.fy, bent.distortion)
    at = np.stack([x * bent.fx + bent.cx, y * bent.fy + bent.cy], -1)
    photo = sample(opened.color(0).astype(np.float32), np.clip(at, 0.0, np.array(bent.size) - 1.0))[0]
    write_png(tmp_path / "bent.png", np.rint(photo).astype(np.uint8))
    files = [FrameFiles(opened.depth_file(0), str(tmp_path / "bent.png"), opened.pose(0))]
    write_capture(tmp_path / "c.usda", replace(opened.rig, color=bent), files, world=np.eye(4))
    plain, through = (LiveSource(ROOM, c, launcher=launcher) for c in (capture.capture, tmp_path / "c.usda"))
    inner = np.s_[10:-10, 10:-10]
    difference = np.abs(plain._guide(0).codes.astype(int) - through._guide(0).codes.astype(int))
    moved = np.abs(photo - opened.color(0))
    assert difference[inner].mean() < 0.3 * moved[inner].mean()
    expected, found = (source.filtered().depth()[inner] for source in (plain, through))
    assert (np.abs(found - expected) > 0.05).mean() < 0.005


@needs_shared
@pytest.mark.parametrize("name", ["redwood", "tum_pair"])
def test_real_captures_with_each_method(name, tmp_path, launcher):
    """A ball on the floor (or table): where it is expected, as large as expected, with a shadow below it."""
    import_capture(SHARED / name, tmp_path / "capture.usda", ImportOptions())
    capture = open_capture(tmp_path / "capture.usda")
    u, v = {"redwood": (300, 430), "tum_pair": (400, 215)}[name]
    depth, normal = (
        f(LiveSource(ROOM, capture, launcher=launcher).filtered())
        for f in (lambda f: f.depth()[v, u], lambda f: f.normals()[v, u])
    )
    radius, pose, lens = 0.1, capture.pose(0), capture.rig.depth
    ray = lens.rays()[v, u]
    center = pose[:3, :3] @ (depth * ray + radius * normal) + pose[:3, 3]
    (tmp_path / "ball.usda").write_text(BALL.format(radius=radius, x=center[0], y=center[1], z=center[2]))
    scene = LiveSource(tmp_path / "ball.usda", capture, launcher=launcher).scene()
    assert pose[:3, :3] @ normal @ [0, 1, 0] > 0.8  # what is picked faces up
    in_camera = depth * ray + radius * normal
    expected = np.pi * (radius * lens.fx / in_camera[2]) ** 2
    for method, settings in (
        ("delta-cones", {}),
        ("instant-radiosity", {"vpls.count": 64, "bounces": 1}),
        ("path-trace", {"samples": 1}),
    ):
        layers = rendered(scene, method=method, settings=settings)
        assert layers.mask_synthetic.sum() == pytest.approx(expected, rel=0.2), method
        at = lens.project(in_camera)
        y, x = np.indices(layers.mask_synthetic.shape)
        found = [(layers.mask_synthetic * axis).sum() / layers.mask_synthetic.sum() for axis in (x, y)]
        assert np.linalg.norm(found - at) < 12
        # Darker where it stands than far away, and nothing changes there that could be seen.
        below = np.hypot(x - u, y - v) < 1.3 * radius * lens.fx / in_camera[2]
        below &= layers.mask_real > 0.99
        far = (np.hypot(x - at[0], y - at[1]) > 250) & (layers.mask_real > 0.99)
        assert layers.delta[below].mean() < -0.01, method
        assert np.abs(layers.delta[far]).mean() < 0.2 * np.abs(layers.delta[below]).mean(), method
        holes = layers.holes == 1
        assert 0.005 < holes.mean() < 0.4
        np.testing.assert_array_equal(layers.comp[holes], layers.plate[holes])

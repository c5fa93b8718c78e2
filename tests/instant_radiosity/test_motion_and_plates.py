"""Frames of a shot, and plates of low dynamic range."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
import warp as wp
from click.testing import CliRunner

from warp_dvct import usd_scenes
from warp_dvct.cli import cli
from warp_dvct.errors import FileError
from warp_dvct.image import is_display_referred, read_plate, write_png, write_radiance
from warp_dvct.layers import Radiance
from warp_dvct.metrics import to_display
from warp_dvct.passes.difference import tonemap_difference
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Role
from warp_dvct.usd.read import read_stage

SMALL = {"bounces": 2, "vpls.count": 64, "vpls.further": 32, "ism.size": 32, "ism.points": 256}


def make(scene, **settings):
    return Relighter(scene, method="instant-radiosity", width=48, height=27, settings={**SMALL, **settings})


def moved(scene, offset):
    meshes = tuple(
        replace(m, points=m.points + offset) if m.role == Role.SYNTHETIC else m for m in scene.meshes
    )  # fmt: skip
    return replace(scene, meshes=meshes)


def test_vpls_are_kept_while_the_camera_moves_and_no_longer():
    """Reuse without ghosts: a frame of a shot is the frame rendered from scratch, bit for bit."""
    scene = read_stage(usd_scenes.path("room_spot"))
    to_world = scene.camera.to_world.copy()
    to_world[0, 3] += 0.1
    pushed = replace(scene, camera=replace(scene.camera, to_world=to_world))
    dimmed = tuple(replace(light, radiance=tuple(0.5 * c for c in light.radiance)) for light in scene.lights)
    shot = (pushed, moved(scene, [0.1, 0.0, 0.05]), replace(scene, lights=dimmed), scene)
    relighter = make(scene)
    relighter.render()
    for k, frame in enumerate(shot):
        relighter.set_scene(frame)
        layers = relighter.render()
        assert ("rsm" in relighter.stats["passes"]) == (k > 0)
        np.testing.assert_array_equal(layers.comp, make(frame).render().comp)


def radiance_of(launcher, before, delta, coverage):
    count = len(before)
    synthetic = np.zeros((count, 4), np.float32)
    synthetic[:, 3] = coverage
    vectors = [launcher.array(np.asarray(a, np.float32), wp.vec3) for a in (before, delta)]
    return Radiance(count, 1, vectors[0], vectors[1], launcher.array(synthetic, wp.vec4), *[None] * 5)


def test_tone_mapped_difference(launcher):
    """plate + TM(after) - TM(before), on the display; plain where the model is the plate; 0 where nothing changed."""
    rng = np.random.default_rng(0)
    before, plate = rng.random((64, 3)) * 2.0, rng.random((64, 3)).astype(np.float32)
    delta = 0.3 * (rng.random((64, 3)) - 0.5)
    delta[:8] = 0.0
    coverage = np.where(np.arange(64) % 2, 0.25, 0.0)
    out = tonemap_difference(
        launcher, radiance_of(launcher, before, delta * (1 - coverage[:, None]), coverage), plate.reshape(1, 64, 3)
    )
    found = out.delta.numpy() / (1 - coverage[:, None])
    expected = to_display(plate) + to_display(np.maximum(before + delta, 0)) - to_display(before)
    np.testing.assert_allclose(to_display(plate + found), np.clip(expected, 0, 1), atol=2e-5)
    assert (found[:8] == 0).all()
    same = tonemap_difference(launcher, radiance_of(launcher, plate, 0.1 * (0.9 - plate), 0.0 * coverage), plate[None])
    np.testing.assert_allclose(same.delta.numpy(), 0.1 * (0.9 - plate), atol=1e-5)


def test_tone_mapped_composite_is_near_the_plain_one_where_the_plate_is_the_model():
    scene = read_stage(usd_scenes.path("room_spot"))
    plate = np.clip(make(scene).render().plate, 0, 1)
    plain, mapped = (make(scene, difference=d).render(plate) for d in ("plain", "tonemapped"))
    dim = (plate.max(-1) < 0.9) & (plain.comp.max(-1) < 0.9)
    np.testing.assert_allclose(mapped.comp[dim], plain.comp[dim], atol=4e-3)
    assert np.isfinite(mapped.comp).all()
    bare = replace(scene, meshes=tuple(m for m in scene.meshes if m.role == Role.REAL))
    layers = make(bare, difference="tonemapped").render(plate)
    np.testing.assert_array_equal(layers.comp, layers.plate)
    with pytest.raises(ValueError, match="needs the radiance before"):
        tonemap_difference(None, replace(radiance_of_nothing(), before=None), plate)


def radiance_of_nothing():
    return Radiance(1, 1, *[None] * 8)


def relit(folder, plate, name, *settings):
    """The finished picture that the command makes on a plate."""
    out = folder / f"{name}.exr"
    arguments = ["relight", usd_scenes.path("room_spot"), out, "--method", "instant-radiosity", "--plate", plate]
    for pair in (*(f"{k}={v}" for k, v in SMALL.items()), *settings):
        arguments += ["--set", pair]
    result = CliRunner().invoke(cli, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    with OpenEXR.File(str(out)) as file:
        return np.array(file.channels()["comp"].pixels)


def test_a_plate_of_display_codes_gets_the_tone_mapped_difference_by_itself(tmp_path):
    """The same light in a PNG and in an EXR: the file decides, and the setting overrides it."""
    codes = np.random.default_rng(0).integers(40, 200, (27, 48, 3)).astype(np.uint8)
    write_png(tmp_path / "plate.png", codes)
    write_radiance(tmp_path / "plate.exr", read_plate(tmp_path / "plate.png"))
    auto = {kind: relit(tmp_path, tmp_path / f"plate.{kind}", kind) for kind in ("png", "exr")}
    assert np.abs(auto["png"] - auto["exr"]).max() > 0.01
    for kind, other, difference in (("png", "exr", "plain"), ("exr", "png", "tonemapped")):
        forced = relit(tmp_path, tmp_path / f"plate.{kind}", f"{kind}-{difference}", f"difference={difference}")
        np.testing.assert_array_equal(forced, auto[other])


def test_integers_are_display_codes_and_floats_are_not(tmp_path):
    image = np.full((4, 4, 3), 0.5, np.float32)
    for name, kind, expected in (
        ("a.png", "uint8", True), ("b.png", "uint16", True), ("c.jpg", "uint8", True), ("d.tif", "uint16", True),
        ("e.tif", "float", False), ("f.exr", "half", False), ("g.hdr", "float", False),
    ):  # fmt: skip
        oiio.ImageBuf(image).write(str(tmp_path / name), kind)
        assert is_display_referred(tmp_path / name) == expected
    with pytest.raises(FileError, match=r"none\.png"):
        is_display_referred(tmp_path / "none.png")

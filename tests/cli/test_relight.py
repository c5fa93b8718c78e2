"""``warp-dvct relight``: files, frames, plates, statistics."""

from __future__ import annotations

import json

import numpy as np
import OpenImageIO as oiio
import pytest

from warp_dvct.image import read_plate, write_png

SMALL = ("-w", 32, "--quality", "draft")


def names(folder) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


@pytest.fixture
def out(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    return folder


def test_a_still_becomes_layers_and_a_preview(command, room, out, read_picture):
    result = command("relight", room, out / "a.exr", *SMALL)
    assert result.code == 0, result.err
    assert str(out / "a.exr") in result.out
    assert names(out) == ["a.exr", "a.png"]
    picture = read_picture(out / "a.exr")
    comp, rgba = picture.layer("comp"), picture.layer("", "RGBA")
    assert comp.shape == (18, 32, 3)
    # The synthetic ball and crate are in the picture, and the rest of it is lit.
    assert 0.02 < rgba[..., 3].mean() < 0.5
    assert comp.mean() > 0.05
    assert picture.layer("delta").min() < -0.02
    over = rgba[..., :3] + (1 - rgba[..., 3:]) * (
        picture.layer("plate") * picture.layer("shadow") + picture.layer("added")
    )
    np.testing.assert_allclose(comp, over, rtol=2**-10, atol=2**-14)


def test_picture_is_the_same_for_any_thread_count_and_run(command, room, out):
    for name, threads in (("one", 1), ("two", 2), ("again", 2)):
        assert command("relight", room, out / f"{name}.exr", *SMALL, "--threads", threads).code == 0
    assert (out / "one.exr").read_bytes() == (out / "two.exr").read_bytes() == (out / "again.exr").read_bytes()
    assert (out / "one.png").read_bytes() == (out / "two.png").read_bytes()


def test_width_is_the_render_products_by_default(command, room, out, monkeypatch):
    result = command("plan", room, "--quality", "draft")
    assert "640 x 360" in result.out


def test_path_trace_agrees_with_the_fast_method_roughly(command, room, out, read_picture):
    same = (*SMALL, "--set", "bounces=1")
    command("relight", room, out / "fast.exr", *same)
    result = command("relight", room, out / "true.exr", *same, "--method", "path-trace", "--set", "samples=64")
    assert result.code == 0, result.err
    fast, true = (read_picture(out / f"{name}.exr").layer("comp").mean() for name in ("fast", "true"))
    assert fast == pytest.approx(true, rel=0.1)


def test_exposure_and_curve_change_the_preview_only(command, room, out):
    for name, extra in (("a", ()), ("b", ("--exposure", 1)), ("c", ("--tonemap", "filmic"))):
        assert command("relight", room, out / f"{name}.exr", *SMALL, *extra).code == 0
    assert (out / "a.exr").read_bytes() == (out / "b.exr").read_bytes() == (out / "c.exr").read_bytes()
    a, b, c = (oiio.ImageBuf(str(out / f"{name}.png")).get_pixels("uint8") for name in "abc")
    assert b.mean() > a.mean() + 10
    assert (a != c).any()


def test_frames_are_numbered_and_move(command, moving_room, out, read_picture):
    result = command(
        "relight", moving_room, out / "f.####.exr", *SMALL, "--camera", "/World/Camera", "--frames", "1:3x2"
    )
    assert result.code == 0, result.err
    assert names(out) == ["f.0001.exr", "f.0001.png", "f.0003.exr", "f.0003.png"]
    masks = [read_picture(out / f"f.000{n}.exr").channels["mask_synthetic"] for n in (1, 3)]
    assert (masks[0] != masks[1]).any()


def test_skip_existing_renders_only_what_is_missing(command, moving_room, out):
    arguments = ("relight", moving_room, out / "f.##.exr", *SMALL, "-cam", "Camera", "-f", "1,2")
    assert command(*arguments).code == 0
    kept = (out / "f.01.exr").stat().st_mtime_ns
    (out / "f.02.exr").unlink()
    result = command(*arguments, "--skip-existing")
    assert result.code == 0
    assert "1 of 2 frames" in result.err
    assert (out / "f.01.exr").stat().st_mtime_ns == kept
    assert (out / "f.02.exr").exists()
    assert "f.01.exr" not in result.out


def test_with_all_frames_there_the_stage_is_not_even_opened(command, out):
    (out / "a.exr").touch()
    assert command("relight", "no_such_stage.usda", out / "a.exr", "--skip-existing").code == 0


def test_plate_decides_the_size_and_stays_bit_identical_where_nothing_changed(command, room, out, read_picture):
    codes = np.random.default_rng(0).integers(0, 256, (36, 64, 3), dtype=np.uint8)
    write_png(out / "photo.png", codes)
    result = command("relight", room, out / "a.exr", "--quality", "draft", "--plate", out / "photo.png")
    assert result.code == 0, result.err
    picture = read_picture(out / "a.exr")
    photo = read_plate(out / "photo.png").astype(np.float16).astype(np.float32)
    np.testing.assert_array_equal(picture.layer("plate"), photo)
    same = (picture.layer("delta") == 0) & (picture.channels["mask_synthetic"] == 0)[..., None]
    np.testing.assert_array_equal(picture.layer("comp")[same], photo[same])
    assert (picture.layer("comp") != photo).any()


def test_numbered_plates_follow_the_frames(command, moving_room, out, read_picture):
    for frame, code in ((1, 40), (2, 200)):
        write_png(out / f"p.{frame:02}.png", np.full((18, 32, 3), code, np.uint8))
    arguments = ("-cam", "Camera", "-f", "1:2", "--plate", out / "p.##.png")
    result = command("relight", moving_room, out / "f.#.exr", "--quality", "draft", *arguments)
    assert result.code == 0, result.err
    means = [read_picture(out / f"f.{frame}.exr").layer("plate").mean() for frame in (1, 2)]
    np.testing.assert_allclose(means, [0.0212, 0.578], rtol=0.01)


def test_a_stages_own_plate_is_used(command, room, out, tmp_path, read_picture):
    write_png(tmp_path / "photo.png", np.full((27, 48, 3), 128, np.uint8))
    stage = tmp_path / "with_plate.usda"
    stage.write_text(
        f'#usda 1.0\n(\n    subLayers = [@{room}@]\n)\nover "World"\n{{\n    over "Camera"\n    {{\n'
        "        asset dvct:plate:file = @./photo.png@\n    }\n}\n"
    )
    result = command("relight", stage, out / "a.exr", "--quality", "draft")
    assert result.code == 0, result.err
    plate = read_picture(out / "a.exr").layer("plate")
    assert plate.shape == (27, 48, 3)
    np.testing.assert_allclose(plate, 0.2159, rtol=1e-3)


def test_statistics_have_the_documented_keys(command, moving_room, out):
    result = command("relight", moving_room, out / "a.exr", *SMALL, "-cam", "Close", "--stats", out / "s.json")
    assert result.code == 0, result.err
    stats = json.loads((out / "s.json").read_text())
    assert set(stats) == {
        "load_seconds",
        "compile_seconds",
        "render_seconds",
        "cpu_seconds",
        "passes",
        "peak_bytes",
        "plan",
        "notices",
    }
    assert 0 < sum(stats["passes"].values()) <= stats["render_seconds"] * 1.01
    assert stats["peak_bytes"] > 32 * 18 * 4
    assert stats["plan"]["width"] == 32
    assert any("/World/Synthetic/Crate" in notice for notice in stats["notices"])
    assert "not modelled: /World/Synthetic/Crate" in result.err


def test_statistics_of_a_range_list_the_frames_and_notices_come_once(command, moving_room, out):
    arguments = ("-cam", "Camera", "-f", "1:2", "--stats", out / "s.json")
    result = command("relight", moving_room, out / "f.#.exr", *SMALL, *arguments)
    assert result.code == 0, result.err
    stats = json.loads((out / "s.json").read_text())
    assert [frame["frame"] for frame in stats["frames"]] == ["1", "2"]
    assert stats["render_seconds"] == pytest.approx(np.mean([frame["render_seconds"] for frame in stats["frames"]]))
    assert result.err.count("/World/Synthetic/Crate") == 1


def test_roles_can_be_overridden(command, room, out, read_picture):
    command("relight", room, out / "a.exr", *SMALL)
    result = command("relight", room, out / "b.exr", *SMALL, "--real", "/World/Synthetic/Ball")
    assert result.code == 0, result.err
    before, after = (read_picture(out / f"{name}.exr").channels["mask_synthetic"].sum() for name in "ab")
    assert 0 < after < before


def test_plain_progress_goes_to_stderr_and_results_to_stdout(command, room, out):
    result = command("relight", room, out / "a.exr", *SMALL)
    assert result.out.count("\n") == 1
    assert "a.exr: " in result.err
    assert "%" in result.err
    assert "CUDA" not in result.err

"""Files in and out: channel names, bit depths, colour spaces, windows, and nothing half-written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from warp_dvct import image
from warp_dvct.errors import FileError
from warp_dvct.image import check_writable, read_plate, srgb_to_linear, write_exr, write_png, write_text
from warp_dvct.layers import Layers
from warp_dvct.scene import Camera

H, W = 5, 7


@pytest.fixture
def layers() -> Layers:
    rng = np.random.default_rng(4)

    def half(*shape):
        return rng.uniform(0, 2, shape).astype(np.float16).astype(np.float32)

    depth = rng.uniform(1, 9, (H, W)).astype(np.float32)
    depth[0, 0] = np.inf
    return Layers(
        rgba=half(H, W, 4),
        comp=half(H, W, 3),
        plate=half(H, W, 3),
        shadow=half(H, W, 3),
        added=half(H, W, 3),
        delta=-half(H, W, 3),
        albedo=half(H, W, 3),
        normal=half(H, W, 3) - 1,
        position=rng.uniform(-1e4, 1e4, (H, W, 3)).astype(np.float32),
        depth=depth,
        mask_real=half(H, W),
        mask_synthetic=half(H, W),
    )


def write_image(path: Path, pixels: np.ndarray, kind: str, **attributes) -> Path:
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, kind)
    for name, value in attributes.items():
        spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(pixels)
    output.close()
    return path


def test_exr_layers_come_back_by_name_and_depth(layers, tmp_path):
    write_exr(tmp_path / "a.exr", layers)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        stored = {name: channel.pixels for name, channel in file.channels().items()}
        assert file.header()["compression"] == OpenEXR.ZIP_COMPRESSION
    expected = set("RGBA") | {"depth.Z", "mask_real", "mask_synthetic"}
    expected |= {f"{name}.{c}" for name in ("comp", "plate", "shadow", "added", "delta", "albedo") for c in "RGB"}
    expected |= {f"{name}.{c}" for name in "NP" for c in "XYZ"}
    assert set(stored) == expected
    full = {"P.X", "P.Y", "P.Z", "depth.Z"}
    assert {name for name, pixels in stored.items() if pixels.dtype == np.float32} == full
    assert all(pixels.dtype == np.float16 for name, pixels in stored.items() if name not in full)
    np.testing.assert_array_equal(np.stack([stored[c] for c in "RGBA"], -1), layers.rgba)
    for name in ("comp", "plate", "shadow", "added", "delta", "albedo"):
        np.testing.assert_array_equal(np.stack([stored[f"{name}.{c}"] for c in "RGB"], -1), getattr(layers, name))
    np.testing.assert_array_equal(np.stack([stored[f"N.{c}"] for c in "XYZ"], -1), np.float16(layers.normal))
    np.testing.assert_array_equal(np.stack([stored[f"P.{c}"] for c in "XYZ"], -1), layers.position)
    np.testing.assert_array_equal(stored["depth.Z"], layers.depth)
    np.testing.assert_array_equal(stored["mask_real"], layers.mask_real)
    np.testing.assert_array_equal(stored["mask_synthetic"], layers.mask_synthetic)


def test_exr_header_carries_camera_and_software(layers, tmp_path):
    to_world = np.eye(4)
    to_world[:3, 3] = [1, 2, 3]
    write_exr(tmp_path / "a.exr", layers, camera=Camera(to_world, -1, 1, -1, 1, path="/Cam"), metadata={"frame": "12"})
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        header = dict(file.header())
    assert header["software"].startswith("warp-dvct ")
    assert header["camera"] == "/Cam"
    assert header["frame"] == "12"
    # The camera's own position is the origin of its space, for row vectors.
    np.testing.assert_allclose(np.array([1, 2, 3, 1]) @ header["worldToCamera"], [0, 0, 0, 1], atol=1e-6)


def test_other_readers_find_the_layers(layers, tmp_path):
    write_exr(tmp_path / "a.exr", layers)
    buffer = oiio.ImageBuf(str(tmp_path / "a.exr"))
    names = list(buffer.spec().channelnames)
    assert names[:4] == ["R", "G", "B", "A"]
    np.testing.assert_array_equal(buffer.get_pixels("float")[..., names.index("comp.G")], layers.comp[..., 1])


def test_png_keeps_codes_and_is_an_ordinary_file(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (H, W, 3), dtype=np.uint8)
    write_png(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(oiio.ImageBuf(str(tmp_path / "a.png")).get_pixels("uint8"), pixels)
    (tmp_path / "plain").touch()
    assert (tmp_path / "a.png").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_srgb_decoding_has_the_standards_values():
    np.testing.assert_allclose(srgb_to_linear(np.array([0.0, 0.04045, 0.5, 1.0])), [0, 0.0031308, 0.2140411, 1], 1e-4)


@pytest.mark.parametrize(("kind", "dtype"), [("uint8", np.uint8), ("uint16", np.uint16)])
def test_integer_plate_is_decoded_from_srgb(tmp_path, kind, dtype):
    codes = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (H, W, 3), dtype=dtype, endpoint=True)
    plate = read_plate(write_image(tmp_path / "p.png", codes, kind))
    assert plate.dtype == np.float32
    np.testing.assert_allclose(plate, srgb_to_linear(codes / np.iinfo(dtype).max), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(("name", "kind"), [("p.exr", "half"), ("p.exr", "float"), ("p.tif", "float")])
def test_float_plate_is_linear_already(tmp_path, name, kind):
    values = np.random.default_rng(2).uniform(0, 50, (H, W, 3)).astype(np.float16).astype(np.float32)
    np.testing.assert_array_equal(read_plate(write_image(tmp_path / name, values, kind)), values)


def test_hdr_plate_is_linear(tmp_path):
    values = np.random.default_rng(2).uniform(0.5, 50, (H, 12, 3)).astype(np.float32)
    plate = read_plate(write_image(tmp_path / "p.hdr", values, "float"))
    np.testing.assert_allclose(plate, values, atol=values.max() / 128)


def test_grey_plate_is_repeated_and_alpha_is_dropped_unmultiplied(tmp_path):
    grey = np.full((H, W, 1), 128, np.uint8)
    np.testing.assert_allclose(read_plate(write_image(tmp_path / "g.png", grey, "uint8")), 0.21586, rtol=1e-4)
    cut = np.full((H, W, 4), 128, np.uint8)
    cut[..., 3] = 10
    file = write_image(tmp_path / "a.png", cut, "uint8", **{"oiio:UnassociatedAlpha": 1})
    np.testing.assert_allclose(read_plate(file), 0.21586, rtol=1e-4)


def test_exif_orientation_is_applied(tmp_path):
    codes = np.random.default_rng(3).integers(0, 256, (H, W, 3), dtype=np.uint8)
    turned = read_plate(write_image(tmp_path / "p.tif", codes, "uint8", Orientation=6))
    np.testing.assert_allclose(turned, srgb_to_linear(np.rot90(codes, -1) / 255.0), rtol=1e-5, atol=1e-7)


def test_data_window_is_placed_in_the_display_window(tmp_path):
    inner = np.random.default_rng(4).uniform(0, 1, (2, 3, 3)).astype(np.float16)
    header = {
        "dataWindow": (np.array([3, 1], np.int32), np.array([5, 2], np.int32)),
        "displayWindow": (np.array([0, 0], np.int32), np.array([W - 1, H - 1], np.int32)),
    }
    OpenEXR.File(header, {"RGB": inner}).write(str(tmp_path / "crop.exr"))
    expected = np.zeros((H, W, 3), np.float32)
    expected[1:3, 3:6] = inner
    np.testing.assert_array_equal(read_plate(tmp_path / "crop.exr"), expected)


def test_our_own_exr_as_plate_reads_rgb_by_name(layers, tmp_path):
    write_exr(tmp_path / "a.exr", layers)
    np.testing.assert_array_equal(read_plate(tmp_path / "a.exr", W, H), layers.rgba[..., :3])


def test_plate_of_another_size_names_both_sizes_and_the_file(tmp_path):
    file = write_image(tmp_path / "p.png", np.zeros((H, W, 3), np.uint8), "uint8")
    with pytest.raises(FileError, match=r"p\.png' is 7 x 5 pixels but the picture is 8 x 6"):
        read_plate(file, 8, 6)
    assert read_plate(file, W, H).shape == (H, W, 3)


def test_missing_and_corrupt_plates_are_named(tmp_path):
    with pytest.raises(FileError, match=r"none\.png' does not exist"):
        read_plate(tmp_path / "none.png")
    with pytest.raises(FileError, match="does not exist or is not a file"):
        read_plate(tmp_path)
    (tmp_path / "text.png").write_text("not an image")
    with pytest.raises(FileError, match=r"text\.png' cannot be read: Could not open file: Not a PNG file; is it an"):
        read_plate(tmp_path / "text.png")


@pytest.mark.parametrize("name", ["p.png", "p.exr"])
def test_truncated_plate_is_refused(tmp_path, name):
    noise = np.random.default_rng(5).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    pixels, kind = (noise, "uint8") if name == "p.png" else (noise.astype(np.float32), "float")
    file = write_image(tmp_path / name, pixels, kind)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(FileError, match="cannot be read"):
        read_plate(file)


def test_check_writable_leaves_nothing_and_names_the_trouble(tmp_path):
    check_writable(tmp_path / "new.exr")
    assert not list(tmp_path.iterdir())
    with pytest.raises(FileError, match=r"folder .*/none does not exist"):
        check_writable(tmp_path / "none" / "a.exr")
    with pytest.raises(FileError, match="is a folder"):
        check_writable(tmp_path)
    with pytest.raises(FileError, match="cannot be written"):
        check_writable("/proc/a.exr")  # refuses new files even from root


@pytest.mark.parametrize("write", ["exr", "png", "text"])
def test_a_failed_write_keeps_the_old_file_and_no_other(layers, tmp_path, monkeypatch, write):
    target = tmp_path / f"a.{write}"
    target.write_text("old")

    def fail(source, destination):
        assert Path(source).stat().st_size > 0  # all of it was there before the rename
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(image.os, "replace", fail)
    call, content = {
        "exr": (write_exr, layers),
        "png": (write_png, np.zeros((H, W, 3), np.uint8)),
        "text": (write_text, "new"),
    }[write]
    with pytest.raises(FileError, match="No space left"):
        call(target, content)
    assert [p.name for p in tmp_path.iterdir()] == [target.name]
    assert target.read_text() == "old"


def test_writing_into_a_missing_folder_is_a_file_error(layers, tmp_path):
    for call in (
        lambda: write_exr(tmp_path / "no" / "a.exr", layers),
        lambda: write_png(tmp_path / "no" / "a.png", np.zeros((H, W, 3), np.uint8)),
        lambda: write_text(tmp_path / "no" / "a.json", "{}"),
    ):
        with pytest.raises(FileError, match="cannot be written"):
            call()

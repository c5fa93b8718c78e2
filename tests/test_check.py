"""``--check``: a wrong number is named with its pass, array, pixel and inputs; without one the picture is the same."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp
from click.testing import CliRunner

from warp_dvct import Relighter, usd_scenes
from warp_dvct.check import RANGES, UNWRITTEN
from warp_dvct.cli import cli
from warp_dvct.cli.warmup import kernel_modules
from warp_dvct.errors import CheckError
from warp_dvct.image import write_radiance
from warp_dvct.kernels.gbuffer import Points
from warp_dvct.launch import Launcher
from warp_dvct.passes.gbuffer import new_points

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def _divide(
    first: int,
    points: Points,
    top_in: wp.array(dtype=wp.float32),
    bottom_in: wp.array(dtype=wp.float32),
    scale: float,
    mask_real_out: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    mask_real_out[i] = scale * top_in[i] / bottom_in[i]


def divide(launcher: Launcher, top, bottom, count: int | None = None) -> None:
    """Run ``_divide`` in a pass of its own."""
    points = new_points(launcher, len(top))
    points.pixel = launcher.array(np.stack([np.arange(len(top)) % 4, np.arange(len(top)) // 4], 1), wp.vec2i)
    with launcher.scope("division"):
        out = launcher.empty(len(top), wp.float32)
        arrays = [launcher.array(np.asarray(v, np.float32), wp.float32) for v in (top, bottom)]
        launcher.launch(_divide, count or len(top), [points, *arrays, 0.5], [out])


@pytest.fixture
def checking() -> Launcher:
    return Launcher("cpu", 1, check=True)


@pytest.mark.parametrize(
    ("top", "bottom", "wrong"),
    [
        (0.0, 0.0, "is nan, which is NaN"),
        (1.0, 0.0, "is inf, which is infinite"),
        (-3.0, 1.0, "is -1.5, which is outside"),
    ],
)
def test_a_wrong_value_is_named_with_pass_array_pixel_and_inputs(checking, top, bottom, wrong):
    tops, bottoms = np.ones(8), np.ones(8)
    tops[6], bottoms[6] = top, bottom
    with pytest.raises(CheckError) as caught:
        divide(checking, tops, bottoms)
    message = str(caught.value)
    assert message.startswith(f"pass 'division', kernel _divide: mask_real_out[6] (pixel 2, 1) {wrong}")
    assert "scale = 0.5; " in message
    assert message.endswith(f"top_in[6] = {top:g}; bottom_in[6] = {bottom:g}")


def test_what_a_kernel_leaves_alone_is_no_error_but_reading_it_is(checking):
    divide(checking, np.ones(8), np.ones(8), count=5)
    unwritten = checking.empty(8, wp.float32)
    assert (unwritten.numpy() == UNWRITTEN).all()
    with pytest.raises(CheckError, match=r"mask_real_out\[0\]"):
        divide(checking, unwritten.numpy(), np.ones(8))


def test_without_check_nothing_is_looked_at():
    launcher = Launcher("cpu", 1)
    assert launcher.checker is None
    out = launcher.empty(1, wp.float32)
    zero = launcher.zeros(1, wp.float32)
    launcher.launch(_divide, 1, [new_points(launcher, 1), zero, zero, 1.0], [out])
    assert np.isnan(out.numpy()[0])


def test_ranges_name_outputs_that_kernels_have():
    names, keys = set(), set()
    for module in kernel_modules():
        for kernel in wp.get_module(module).kernels.values():
            keys.add(kernel.key)
            for argument in kernel.adj.args:
                names.add(argument.label.removesuffix("_out"))
                names |= set(getattr(argument.type, "vars", {}))
    for name in RANGES:
        kernel, _, output = name.rpartition(".")
        assert output in names
        assert not kernel or kernel in keys


@pytest.mark.cpu  # a GPU sums a patch's rays in parts, none of which overflows
def test_no_pixel_is_named_where_elements_are_something_else():
    """A light that is too bright overflows first between patches, which are no pixels."""
    stage = usd_scenes.path("room_area")
    scene = Relighter(stage, width=16).scene
    lamp = dataclasses.replace(scene.lights[0], radiance=(3e38, 1.0, 1.0))
    relighter = Relighter(dataclasses.replace(scene, lights=(lamp,)), width=16, check=True, quality="draft")
    with pytest.raises(CheckError, match=r"_link_patches: irradiance_out\[\d+\] is \(inf"):
        relighter.render()


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        ("delta-cones", {}),
        ("delta-cones", {"gather": "cones", "shadows": "cone", "glossy": "cones"}),
        ("delta-cones", {"gather": "cones", "cones.delta": "split", "cones.filter": "isotropic"}),
        ("instant-radiosity", {"vpls.count": 16, "vpls.further": 8, "ism.size": 32, "bounces": 2}),
        ("instant-radiosity", {"vpls.count": 16, "visibility": "ray", "bounces": 2}),
        ("path-trace", {"samples": 2}),
    ],
)
def test_checking_finds_nothing_and_changes_nothing(method, settings):
    stage = usd_scenes.path("room_glossy")
    options = {"width": 48, "quality": "draft", "method": method, "settings": settings, "threads": 2}
    layers = [Relighter(stage, check=check, **options).render() for check in (False, True)]
    for field in dataclasses.fields(layers[0]):
        plain, checked = (getattr(x, field.name) for x in layers)
        assert np.array_equal(plain, checked), field.name


def test_the_command_names_the_pixel_of_a_broken_plate(tmp_path):
    stage = str(usd_scenes.path("ground_dome"))
    plate = np.full((36, 64, 3), 0.5, np.float32)
    plate[3, 5, 1] = np.nan
    write_radiance(tmp_path / "plate.exr", plate)
    arguments = [
        "relight",
        stage,
        str(tmp_path / "out.exr"),
        "--plate",
        str(tmp_path / "plate.exr"),
        "--quality",
        "draft",
    ]
    result = CliRunner().invoke(cli, [*arguments, "--check"])
    assert isinstance(result.exception, CheckError)
    message = str(result.exception)
    assert "pass 'composite', kernel _composite_pixels: invalid_out[197] (pixel 5, 3) is" in message
    assert "plate_in[197] = (0.5, nan, 0.5)" in message
    assert not (tmp_path / "out.exr").exists()
    assert CliRunner().invoke(cli, arguments).exit_code == 0

"""``bench scaling``: exponents of known growth, the scenes that grow, and a tiny run of the command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from warp_dvct.bench import scaling as module
from warp_dvct.bench.__main__ import bench
from warp_dvct.bench.error import read
from warp_dvct.bench.rows import read_rows
from warp_dvct.errors import OptionError
from warp_dvct.scene import Role
from warp_dvct.usd_scenes import path


def rows(axis: str, power: float, memory: float = 0.0, constant: float = 0.0) -> list[dict]:
    """Rows that grow by known powers."""
    made = []
    for value in (1, 2, 4, 8):
        seconds = constant + value**power
        row = {"axis": axis, "value": value, "triangles": value, "seconds": seconds, "cpu_seconds": seconds}
        made.append({**row, "again_cpu_seconds": 1.0, "bytes": value**memory})
    return made


def test_known_exponents_are_found():
    found = {e.what: e for e in module.exponents(rows("resolution", 2.0, 2.0))}
    assert found["first frame"].fitted == pytest.approx(2.0)
    assert found["memory"].last == pytest.approx(2.0)
    assert found["next frame"].fitted == pytest.approx(0.0)
    assert not any(e.worse for e in found.values())


@pytest.mark.parametrize(
    ("axis", "power", "memory", "worse"),
    [
        ("resolution", 3.0, 1.0, "first frame"),
        ("resolution", 1.0, 3.0, "memory"),
        ("lights", 1.5, 0.0, "first frame"),
        ("frames", 1.5, 0.0, "all frames"),
        ("threads", 0.0, 0.0, "speed"),  # no faster with more of them
    ],
)
def test_what_grows_too_fast_is_flagged(axis, power, memory, worse):
    found = module.exponents(rows(axis, power, memory))
    assert [e.what for e in found if e.worse] == [worse]
    assert "WORSE THAN EXPECTED" in module.format_exponents(found, rows(axis, power, memory))


def test_a_constant_does_not_hide_growth():
    """The last step is compared, as what every frame costs flattens the first ones."""
    (first, *_) = module.exponents(rows("resolution", 3.0, constant=20.0))
    assert first.fitted < 2.0
    assert first.worse


def test_threads_that_pay_are_not_flagged():
    (speed, memory) = module.exponents(rows("threads", -0.9))
    assert speed.fitted == pytest.approx(0.9)
    assert not speed.worse
    assert not memory.worse


@pytest.mark.parametrize("count", [8, 1000, 100_000])
def test_a_ball_has_about_its_triangles_and_its_area(count):
    ball = module.ball(np.array([1.0, 2.0, 3.0]), 0.5, count, 0)
    assert len(ball.triangles) == pytest.approx(count, rel=0.15)
    a, b, c = (ball.points[ball.triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    assert np.all(np.sum(cross * (a + b + c - 3 * np.array([1.0, 2.0, 3.0])), 1) > 0)  # faces outwards
    if count >= 1000:
        area = 0.5 * np.linalg.norm(cross, axis=1).sum()
        assert area == pytest.approx(np.pi, rel=0.02)
        a, b, c = (p - [1.0, 2.0, 3.0] for p in (a, b, c))
        volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
        assert volume == pytest.approx(np.pi / 6, rel=0.03)  # closed


def test_scenes_that_grow():
    scene = read(path("room_area"))
    many = module._triangles(scene, 32, 1000).scene
    assert [m.role for m in many.meshes].count(Role.SYNTHETIC) == 1
    assert many.bounds(Role.REAL)[0] == pytest.approx(scene.bounds(Role.REAL)[0])
    lights = module._lights(scene, 32, 5).scene.lights
    assert len(lights) == 5
    assert np.sum([x.radiance for x in lights], 0) == pytest.approx(scene.lights[0].radiance)
    assert np.mean([x.position for x in lights], 0) == pytest.approx(scene.lights[0].position, abs=1e-9)
    assert module._lights(scene, 32, 1).scene.lights[0].position == pytest.approx(scene.lights[0].position)
    with pytest.raises(OptionError, match="no light with a place"):
        module._lights(read(path("furnace")), 32, 2)


def test_a_tiny_run(tmp_path, monkeypatch):
    """Two axes of a tiny room: rows, exponents, and a static room that is voxelised once while its box stays."""
    small = {"volume.resolution": "32", "volume.coarse": "0", "patches.count": "64", "rsm.texels": "64"}
    flags = [f"--set={k}={v}" for k, v in small.items()]
    file = tmp_path / "rows.jsonl"
    axes = tuple(
        replace(axis, quick={"lights": (1, 4), "frames": (1, 3)}.get(axis.name, axis.quick)) for axis in module.AXES
    )
    monkeypatch.setattr(module, "AXES", axes)
    words = ["scaling", "--axis", "lights", "--axis", "frames", "--width", "32", "--repeats", "1", "--out", str(file)]
    result = CliRunner().invoke(bench, [*words, "--quality", "draft", *flags], catch_exceptions=False)
    assert result.exit_code == 0
    found = read_rows(file, "scaling")
    assert [(r["axis"], r["value"]) for r in found] == [("lights", 1), ("lights", 4), ("frames", 1), ("frames", 3)]
    assert found[1]["bytes"] > found[0]["bytes"]
    assert found[0]["again_cpu_seconds"] < found[0]["cpu_seconds"]
    shots = found[2:]
    assert [r["voxelised_real"] for r in shots] == [r["places"] for r in shots]
    assert "all frames" in result.output


@pytest.mark.parametrize(
    ("options", "message"),
    [({"axes": ("depth",)}, "no axis 'depth'"), ({"repeats": 0}, "--repeats is 0")],
)
def test_unusable_options(options, message):
    with pytest.raises(OptionError, match=message):
        module.measure("room_area", module.ScalingOptions(**options))

"""``bench effects`` and ``bench figure3``: their figures on pictures with a known answer, and tiny runs."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner

from warp_dvct.bench import effects as module
from warp_dvct.bench import figure3
from warp_dvct.bench.__main__ import bench
from warp_dvct.bench.effects import EFFECTS, METHODS, EffectOptions
from warp_dvct.bench.error import read
from warp_dvct.bench.references import Reference
from warp_dvct.bench.rows import read_rows
from warp_dvct.errors import OptionError
from warp_dvct.scene import LightKind, Role
from warp_dvct.settings import make_settings
from warp_dvct.usd_scenes import path


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """References that the tests of this file share."""
    return tmp_path_factory.mktemp("references")


def made_stage(noise: float) -> module._Stage:
    """A change of -0.1 on a plate of 0.5 over the left half, with independent noise in the two parts."""
    rng = np.random.default_rng(7)
    shape = (64, 64, 3)
    region = np.zeros(shape[:2], bool)
    region[:, :32] = True
    delta = -0.1 * region[..., None] * np.ones(3)
    nothing = np.zeros((64, 64, 4), np.float32)
    plate = np.full(shape, 0.5)
    parts = [Reference(plate, delta + noise * rng.standard_normal(shape), nothing, 0.0) for _ in range(2)]
    return module._Stage(EFFECTS[0], EffectOptions(), None, (parts[0], parts[1]), region)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_errors_of_known_pictures(noise):
    """The truth has no error, the untouched plate all of it, half of the change half; whatever the truth's noise."""
    stage = made_stage(noise)
    plate, change = np.full((64, 64, 3), 0.5), -0.1 * stage.region[..., None]
    for share, error in ((1.0, 0.0), (0.0, 1.0), (0.5, 0.5), (2.0, 1.0)):
        found = module._figures(stage, plate + share * change)
        assert found["error"] == pytest.approx(error, abs=0.15 if error == 0.0 and noise else 0.05)
        assert found["share"] == 0.5


def test_every_effect_that_is_asked_for_is_there_and_its_scene_shows_it():
    names = {e.name for e in EFFECTS} | {module.THIN_WALLS}
    asked = {"hard shadow", "soft shadow", "diffuse bounce", "glossy", "mirror", "blocked sky", "thin walls"}
    assert names == asked | {"small objects"}
    scenes = {e.name: e.make(read(path(e.stage))) for e in EFFECTS}
    (light,) = scenes["hard shadow"].lights
    (soft,) = scenes["soft shadow"].lights
    area = [np.linalg.norm(np.cross(x.axis_x, x.axis_y)) for x in (light, soft)]
    assert 2 * np.linalg.norm(light.axis_x) == pytest.approx(0.02)
    assert light.radiance[0] * area[0] == pytest.approx(soft.radiance[0] * area[1])
    assert [m.roughness for m in scenes["mirror"].materials if m.name.endswith("Floor")] == [0.0]
    assert [x.kind for x in scenes["blocked sky"].lights] == [LightKind.DOME]
    low, high = scenes["small objects"].bounds(Role.SYNTHETIC)
    first = next(m for m in scenes["small objects"].meshes if m.role == Role.SYNTHETIC)
    assert np.ptp(first.points, 0).max() < 0.06 * np.max(high - low)
    for _, settings in METHODS.values():
        make_settings("balanced", settings)
    for effect, method, settings, _ in module.FAILURES.values():
        assert effect in scenes
        make_settings("balanced", {**METHODS[method][1], **settings})


def test_a_tiny_run_prints_a_table_and_draws_the_failure(cache, tmp_path):
    words = ["effects", "--effect", "hard shadow", "--width", "64", "--spp", "8", "--cache", str(cache)]
    flags = ["--quality", "draft", "--images", str(tmp_path), "--out", str(tmp_path / "rows.jsonl")]
    result = CliRunner().invoke(bench, [*words, *flags], catch_exceptions=False)
    assert result.exit_code == 0
    rows = {r["method"]: r for r in read_rows(tmp_path / "rows.jsonl", "effects")}
    assert set(rows) == set(METHODS)
    assert rows["delta-cones"]["error"] < 0.3 < rows["the paper's form"]["error"]
    assert "| hard shadow |" in result.output
    assert (tmp_path / "failure_shadow_cone.jpg").stat().st_size > 1000


def test_walls_leak_by_cones_and_not_in_the_truth():
    options = EffectOptions(width=48, quality="draft")
    truth, _ = module._leak("path-trace", {"samples": "2"}, options)
    (rays, _), (cones, _) = (module._leak("delta-cones", s, options) for s in ({}, {"gather": "cones"}))
    assert truth["error"] == 0.0
    assert rays["error"] < 0.5 * cones["error"]


@pytest.mark.parametrize(
    ("options", "message"),
    [({"effects": ("rain",)}, "no effect 'rain'"), ({"width": 8}, "--width"), ({"samples": 1}, "--spp")],
)
def test_unusable_options(options, message):
    with pytest.raises(OptionError, match=message):
        module.measure(EffectOptions(**options))


def test_the_sign_of_the_error_decides_its_color():
    error = np.zeros((1, 3, 3))
    error[0, 0], error[0, 1] = 0.05, -0.05
    taken, left, none = figure3.signed_colors(error)[0]
    assert taken[0] > taken[2] == 0
    assert left[2] > left[0]
    assert none.max() == 0


def test_figure_3_of_tiny_renders(tmp_path):
    """Both occupancies in one march make eq. 9 all but exact; a single one does not."""
    file = tmp_path / "figure.png"
    result = CliRunner().invoke(bench, ["figure3", str(file), "--width", "32"], catch_exceptions=False)
    assert result.exit_code == 0
    assert file.stat().st_size > 5000
    rms = {tuple(line.split()[:2]): float(line.split()[2]) for line in result.output.splitlines()[1:]}
    for kind in ("diffuse", "glossy"):
        assert rms[kind, "dual"] < 0.25 * rms[kind, "split"]

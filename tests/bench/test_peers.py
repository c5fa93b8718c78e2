"""``bench peers``: the stage that Mitsuba gets is ours, and who is missing is named."""

import importlib
import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from warp_dvct.bench import peers as module
from warp_dvct.bench.__main__ import bench
from warp_dvct.bench.error import read
from warp_dvct.bench.mitsuba_scene import describe_materials, mitsuba_description
from warp_dvct.bench.peers import MitsubaPair, PeerOptions
from warp_dvct.bench.references import ReferenceStore
from warp_dvct.errors import OptionError
from warp_dvct.metrics import flip_ldr, rmse
from warp_dvct.scene import Camera
from warp_dvct.usd_scenes import path

WIDTH, HEIGHT, SPP = 64, 36, 256


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """References that the tests of this file share."""
    return tmp_path_factory.mktemp("references")


@pytest.fixture(scope="module")
def mi():
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


@pytest.mark.parametrize("stage", ["room_area", "ground_dome", "thin_wall"])
def test_mitsuba_renders_our_stage(stage, mi, cache, launcher, tmp_path):
    """Diffuse stages map exactly: lights, textures, sky and near plane agree, region by region within noise."""
    scene = read(path(stage))
    store = ReferenceStore(scene, WIDTH, HEIGHT, samples=SPP, seed=1, cache=cache, launcher=launcher, quiet=True)
    truth = store.get(1)
    assert describe_materials(scene) == "diffuse"
    pair = MitsubaPair(mi, scene, truth, tmp_path, 1, False)
    comp = pair.composite(64)
    real = truth.coverage == 0
    assert comp[real].mean() == pytest.approx(truth.comp[real].mean(), rel=0.01)
    assert comp[~real].mean() == pytest.approx(truth.comp[~real].mean(), rel=0.03)
    assert flip_ldr(truth.comp, comp)[0] < 0.05
    before = pair.picture(pair._scenes[0], 64, 9, None)
    quarters = [p.reshape(4, HEIGHT // 4, 4, WIDTH // 4, 3).mean((1, 3)) for p in (before, truth.before)]
    # Not the top: the ceiling beside the lamp, which in Mitsuba is a panel that blocks light.
    np.testing.assert_allclose(quarters[0][1:], quarters[1][1:], atol=0.05 * truth.before.mean())


def test_a_coated_material_is_near(mi, cache, launcher, tmp_path, monkeypatch):
    """The bunny's clay, a dielectric over a diffuse base: within 5 % of its mean radiance, by another BRDF."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    scene = read(path("bunny"))
    store = ReferenceStore(scene, WIDTH, HEIGHT, samples=SPP, seed=1, cache=cache, launcher=launcher, quiet=True)
    truth = store.get(1)
    comp = MitsubaPair(mi, scene, truth, tmp_path, 1, False).composite(64)
    whole = truth.coverage == 1
    assert whole.sum() > 20
    assert comp[whole].mean() == pytest.approx(truth.comp[whole].mean(), rel=0.05)


def test_the_peers_are_measured_and_printed(cache, tmp_path, monkeypatch):
    """With Mitsuba and the denoiser; without the latter it is named and left out."""
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(module, "VARIANTS", ("scalar_rgb",))
    real_import = importlib.import_module

    def without_oidn(name, *rest):
        if name == "pyoidn":
            raise ImportError("No module named 'pyoidn'")
        return real_import(name, *rest)

    monkeypatch.setattr(module.importlib, "import_module", without_oidn)
    file = tmp_path / "figures.json"
    arguments = ["peers", "--stage", "room_area", "--stage", "room_spot", "--width", "64", "--spp", str(SPP)]
    arguments += ["--samples", "2", "--samples", "16", "--cache", str(cache), "--json", str(file)]
    result = CliRunner().invoke(bench, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert "left out: Intel Open Image Denoise: No module named 'pyoidn'" in result.output
    assert "/World/Light: Mitsuba's spot" in result.output
    room, spot = json.loads(file.read_text())["stages"]
    rows = {row["name"]: row for row in room["rows"]}
    assert list(rows)[:3] == ["delta-cones draft", "delta-cones balanced", "delta-cones high"]
    for tool in ("path-trace", "Mitsuba"):
        assert rows[f"{tool} 16 spp"]["flip"] < rows[f"{tool} 2 spp"]["flip"]
        assert rows[f"{tool} 16 spp"]["rmse"] < 0.6 * rows[f"{tool} 2 spp"]["rmse"]
    assert all(row["seconds"] > 0 for row in rows.values())
    assert not any("Mitsuba" in row["name"] for row in spot["rows"])


def test_denoising_helps(mi, cache, launcher, tmp_path):
    """Guides reach the denoiser: a picture of 4 samples comes far closer to the truth."""
    denoise = pytest.importorskip("pyoidn").denoise
    scene = read(path("room_area"))
    truth = ReferenceStore(scene, WIDTH, HEIGHT, samples=SPP, seed=1, cache=cache, launcher=launcher, quiet=True).get(1)
    pair = MitsubaPair(mi, scene, truth, tmp_path, 1, True)
    noisy, clean = (rmse(truth.comp, pair.composite(4, d)) for d in (None, denoise))
    assert clean < 0.6 * noisy


def test_missing_mitsuba_is_named(cache, monkeypatch):
    def missing(name, *rest):
        raise ImportError(f"No module named '{name}'")

    monkeypatch.setattr(module.importlib, "import_module", missing)
    report = module.measure(
        "room_area", PeerOptions(width=WIDTH, samples=SPP, peer_samples=(2,), qualities=("draft",), cache=cache)
    )
    assert [row.name for row in report.rows] == ["delta-cones draft", "path-trace 2 spp"]
    assert report.left_out == ["Mitsuba 3: No module named 'mitsuba'; pip install 'warp-dvct[bench]'"]


def test_a_variant_that_does_not_exist_does_not_work():
    pytest.importorskip("mitsuba")
    assert not module.variant_works("llvm_ad_nonsense")


def test_what_has_no_counterpart_is_refused(mi, tmp_path):
    scene = read(path("room_area"))
    size = {"width": 8, "height": 8, "bounces": 1, "aov": False}
    camera = Camera(scene.camera.to_world, -0.2, 0.6, -0.3, 0.3, path="/World/Camera")
    with pytest.raises(OptionError, match="/World/Camera"):
        mitsuba_description(mi, replace(scene, camera=camera), (), tmp_path, **size)
    with pytest.raises(OptionError, match="/World/Light"):
        mitsuba_description(mi, read(path("room_spot")), (), tmp_path, **size)

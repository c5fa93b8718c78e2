"""Budgets: counts, unit costs and the choice of settings; nothing here depends on how fast the machine is."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from warp_dvct import Relighter
from warp_dvct.budget import LADDERS, Choice, choose, load_accuracy
from warp_dvct.calibrate import DEAREST, calibrate, subdivide
from warp_dvct.cost import (
    CostModel,
    Sample,
    count_work,
    fit,
    load_model,
    model_file,
    non_negative,
    save_model,
)
from warp_dvct.errors import FileError, OptionError
from warp_dvct.launch import Launcher
from warp_dvct.settings import NAMES, make_settings
from warp_dvct.survey import Survey, survey
from warp_dvct.usd.read import read_stage
from warp_dvct.usd_scenes import path


@pytest.fixture(scope="module")
def surveys(launcher) -> dict[str, Survey]:
    """Of three stages: a closed diffuse room, one with mirrors, an open scene."""
    found = {}
    for name in ("room_area", "room_glossy", "ground_dome"):
        scene = read_stage(path(name))
        found[name] = survey(scene, make_settings(), launcher, 16 / 9, has_plate=True)
    return found


def test_a_survey_counts_what_is_in_the_picture(surveys):
    """Known of the stages: what covers the picture, that rooms are closed, who has lobes, lights and domes."""
    room, glossy, ground = surveys.values()
    assert (room.lights, room.dome, ground.lights, ground.dome) == (1, False, 1, True)
    assert room.real + room.object == pytest.approx(1.0)
    assert 0.05 < room.object < 0.15
    assert ground.real + ground.object < 0.95  # the sky
    assert room.met > 0.95
    assert ground.met < 0.7
    assert room.roughness is None
    assert glossy.roughness == pytest.approx(0.15)
    assert (room.glossy, ground.glossy) == (0.0, 0.0)
    assert 0.2 < glossy.glossy < 0.6
    assert room.object < room.affected <= 1.0
    assert 0.0 < room.near < 1.0
    # A room of 3.6 x 2.2 x 4 m, from within: what lies in the coarse volume, over its edge squared.
    assert 2.0 < room.area_coarse < 8.0


def test_a_survey_is_the_same_every_time_and_for_any_threads(surveys):
    scene = read_stage(path("room_area"))
    assert survey(scene, make_settings(), Launcher("cpu", 1), 16 / 9, has_plate=True) == surveys["room_area"]


def test_a_scene_without_changes_needs_nothing(launcher):
    scene = read_stage(path("room_area"))
    empty = replace(scene, meshes=tuple(m for m in scene.meshes if m.role == 0))
    found = survey(empty, make_settings(), launcher, 16 / 9, has_plate=True)
    assert (found.changes, found.affected, found.object, found.feature) == (False, 0.0, 0.0, 0.0)
    assert set(count_work(make_settings(), found, 64, 36)) == {"upload", "gbuffer", "resolve", "composite", "rest"}


def test_counts_follow_their_settings(surveys):
    """Doubling a setting doubles what it counts: rays, records by the square, texels by the square, transfers."""
    room = surveys["room_area"]

    def counted(**changes):
        names = {k.replace("__", "."): v for k, v in changes.items()}
        return count_work(make_settings("balanced", names), room, 320, 180)

    base = counted(gather__rays=64, rsm__texels=64, volume__resolution=128, volume__coarse=0, bounces=5)
    assert counted(gather__rays=128, rsm__texels=64)["gather"]["real rays"] == 2 * base["gather"]["real rays"]
    assert counted(rsm__texels=128, volume__coarse=0)["rsm"]["texels"] == pytest.approx(4 * base["rsm"]["texels"])
    fine = counted(volume__resolution=256, volume__coarse=0)["voxelize"]["records"]
    assert fine == pytest.approx(4 * base["voxelize"]["records"])
    assert counted(bounces=9)["bounces"]["transfers"] == 2 * base["bounces"]["transfers"]
    assert "bounces" not in counted(bounces=1)
    assert "specular" not in base
    assert "specular" in count_work(make_settings(), surveys["room_glossy"], 320, 180)
    twice = count_work(make_settings(), room, 640, 360)["gbuffer"]["pixels"]
    assert twice == pytest.approx(4 * base["gbuffer"]["pixels"])
    without = count_work(make_settings(), replace(room, plate=False), 320, 180)
    assert without["gather"]["real rays"] > base["gather"]["real rays"]
    assert without["direct"]["before"] > 0 == base["direct"]["before"]


def test_records_are_about_those_of_a_plan(surveys):
    """The surface's count of voxels agrees with what a voxelised room holds, within a factor that the fit absorbs."""
    from warp_dvct.device_scene import DeviceScene
    from warp_dvct.methods.delta_cone_tracing import light_volumes
    from warp_dvct.plan import make_plan

    launcher, scene = Launcher("cpu", 2), read_stage(path("room_area"))
    ratios = []
    for resolution in (32, 64):
        settings = make_settings("draft", {"volume.resolution": resolution, "volume.coarse": 32, "bounces": 1})
        plan = make_plan(scene, settings, "delta-cones", 32, 18)
        uploaded = DeviceScene.upload(launcher, scene, np.asarray(plan.origin), plan.scale)
        volumes = light_volumes(launcher, scene, uploaded, plan).volumes
        found = sum(v.level_records[0] for v in volumes)
        ratios.append(found / (1e6 * count_work(settings, surveys["room_area"], 32, 18)["voxelize"]["records"]))
    assert 0.3 < ratios[0] < 2
    assert ratios[1] == pytest.approx(ratios[0], rel=0.25)


def test_non_negative_least_squares():
    """Known unknowns are found; where the best would be negative it is 0 and the rest is the best without it."""
    rng = np.random.default_rng(0)
    matrix, known = rng.uniform(size=(30, 4)), np.array([2.0, 0.0, 1.0, 3e-3])
    np.testing.assert_allclose(non_negative(matrix, matrix @ known), known, atol=1e-9)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        matrix, values = rng.normal(size=(12, 5)), rng.normal(size=12)
        found = non_negative(matrix, values)
        slope = matrix.T @ (values - matrix @ found)
        assert (found >= 0).all()
        assert (slope <= 1e-9).all()  # Karush, Kuhn and Tucker
        np.testing.assert_allclose(slope[found > 0], 0, atol=1e-9)


def made_model(threads: int = 2) -> CostModel:
    """Unit costs of one's own, in about the proportions of a real machine."""
    units = {
        "survey": {"frame": 0.05},
        "voxelize": {"frame": 0.02, "records": 0.15},
        "rsm": {"texels": 0.17},
        "bounces": {"frame": 0.01, "rays": 0.05, "records": 0.05},
        "direct": {"frame": 0.005, "probes": 0.05, "near": 0.05},
        "gather": {"frame": 0.005, "real rays": 0.3, "object rays": 0.6, "points": 0.2},
        "specular": {"rays": 1.0},
        "gbuffer": {"points": 0.3},
    }
    return CostModel("cpu", threads, "made", units, {"gather": 2.0, "rsm": 1.5}, 0.1)


def test_a_fit_finds_the_units_that_made_the_samples(surveys):
    """Frames of a known machine, a tenth of noise: times of other settings are found within a tenth."""
    truth, rng = made_model(), np.random.default_rng(4)
    samples = []
    for found in surveys.values():
        for _ in range(15):
            knobs = {}
            for ladder in LADDERS:
                knobs |= ladder.settings(int(rng.choice(ladder.values[:5])))
            work = count_work(make_settings("balanced", knobs), found, int(rng.choice([160, 320])), 180)
            cpu = {name: truth._cost(name, counts) * rng.uniform(0.9, 1.1) for name, counts in work.items()}
            wall = {name: value / truth.speedup.get(name, 1.0) for name, value in cpu.items()}
            samples.append(Sample(work, cpu, wall))
    model = fit(samples, device="cpu", threads=2, machine="made")
    for found in surveys.values():
        work = count_work(make_settings("high"), found, 640, 360)
        assert model.cpu_seconds(work) == pytest.approx(truth.cpu_seconds(work), rel=0.1)
        assert model.seconds(work, 2) == pytest.approx(truth.seconds(work, 2), rel=0.1)
    assert model.spread < 0.1
    with pytest.raises(ValueError, match="no frame"):
        fit([], device="cpu", threads=2, machine="made")


def test_threads_by_amdahl(surveys):
    """A gain of 1.5 by two threads leaves a third on one thread: three times as fast at most."""
    model = made_model()
    work = {"rsm": {"texels": 1.0}}
    assert model.seconds(work, 1) == pytest.approx(0.17)
    assert model.seconds(work, 2) == pytest.approx(0.17 / 1.5)
    assert model.seconds(work, 4) == pytest.approx(0.17 * (1 / 3 + 2 / 3 / 4))
    assert made_model(threads=1).seconds(work, 2) == pytest.approx(0.17)


def chosen(surveys, stage: str = "room_area", **request) -> Choice:
    """A choice on the made machine at 320 x 180."""
    return choose(surveys[stage], made_model(), width=320, height=180, threads=2, **request)


@pytest.mark.parametrize("stage", ["room_area", "room_glossy", "ground_dome"])
def test_more_time_is_used_and_predicts_less_error(surveys, stage):
    """The prediction lands within a tenth of the budget, and the error never rises with it."""
    last = math.inf
    for budget in (0.25, 0.5, 1.0, 2.0, 5.0, 20.0):
        choice = chosen(surveys, stage, seconds=budget)
        assert 0.9 * budget <= choice.seconds <= budget
        assert choice.error <= last
        last = choice.error
        for ladder in LADDERS:
            for name, value in ladder.settings(ladder.values[0]).items():
                assert getattr(choice.settings, NAMES[name]) >= (1 if "stride" in name else value)


def test_the_cheapest_that_keeps_an_error(surveys):
    reached = [1.01 * chosen(surveys, seconds=s).error for s in (0.4, 2.0)]
    easy, hard = (chosen(surveys, max_error=e) for e in reached)
    assert easy.error <= reached[0]
    assert hard.error <= reached[1] < reached[0]
    assert easy.seconds < hard.seconds <= 2.0
    with pytest.raises(OptionError, match=r"--max-error 0.0001 is below what .*about 0\.0"):
        chosen(surveys, max_error=1e-4)


def test_what_is_given_stays_and_what_is_not_needed_is_left_out(surveys):
    choice = chosen(surveys, seconds=1.0, fixed={"gather.stride": 8, "bounces": 2})
    assert choice.settings.gather_stride == 8
    assert choice.settings.bounces == 2
    text = choice.describe()
    assert "bounces=2: given" in text
    assert "left out: glossy.rays, no material has a lobe" in text
    assert "predicted: " in text
    assert "roughness 0.15" in chosen(surveys, "room_glossy", seconds=1.0).describe()
    thin = replace(surveys["room_area"], feature=1e-3)
    small = choose(thin, made_model(), width=320, height=180, threads=2, seconds=1.0)
    assert "--set volume.resolution=2000" in small.describe()
    json.dumps(choice.to_dict())


@pytest.mark.parametrize("budget", [0.0, -1.0, math.nan, math.inf])
def test_what_is_no_budget(surveys, budget):
    for name in ("seconds", "max_error"):
        with pytest.raises(OptionError, match="positive number"):
            chosen(surveys, **{name: budget})


def test_the_floor_is_said(surveys):
    with pytest.raises(OptionError, match=r"--budget 0.01 s is below the floor: .* takes about (\d\.\d+) s"):
        chosen(surveys, seconds=0.01)
    with pytest.raises(OptionError, match="not both"):
        chosen(surveys)
    with pytest.raises(OptionError, match="not both"):
        chosen(surveys, seconds=1.0, max_error=0.1)


def test_the_shipped_table_orders_values(surveys):
    """Dearer values never err more, and the presets come out in their order."""
    table = load_accuracy()
    assert set(table.knobs) >= {"diffuse", "glossy"}
    for knobs in table.knobs.values():
        for knob, values in knobs.items():
            errors = [e for _, e in values]
            assert errors == sorted(errors, reverse=knob != "gather.stride"), knob
    for found in surveys.values():
        draft, balanced, high = (table.error(make_settings(q), found, 320) for q in ("draft", "balanced", "high"))
        assert draft > balanced > high > 0
    more = [table.excess("gather.rays", rays, surveys["room_area"]) for rays in (512, 1024, 8192, 65536)]
    assert more == sorted(more, reverse=True)
    assert more[-1] > -1


def test_models_are_kept_by_machine(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert load_model("cpu").shipped
    with pytest.raises(OptionError, match=r"calibrate --device cuda:0"):
        load_model("cuda:0")
    save_model(made_model(), model_file("cpu"))
    assert load_model("cpu") == made_model()
    assert model_file("cpu") != model_file("cuda:0")
    for text in ("{", "{}", '{"device": "cpu", "threads": 1, "machine": "", "units": {}, "speedup": {}, "spread": 0}'):
        model_file("cpu").write_text(text)
        with pytest.raises(FileError, match="warp-dvct calibrate"):
            load_model("cpu")


def test_subdivided_triangles_are_the_same_surface():
    scene = read_stage(path("colour_bleeding"))
    finer = subdivide(scene, 2)
    for mesh, split in zip(scene.meshes, finer.meshes, strict=True):
        assert len(split.triangles) == 16 * len(mesh.triangles)
        areas = [
            np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1).sum()
            for p in (m.points[m.triangles] for m in (mesh, split))
        ]
        assert areas[0] == pytest.approx(areas[1])


def test_calibrating_measures_every_pass(monkeypatch):
    """The least design on small stages: each pass of a frame gets a cost, and a plan can be made from it."""
    from warp_dvct import calibrate as module

    monkeypatch.setattr(module, "STAGES", ("colour_bleeding",))
    monkeypatch.setattr(module, "WIDTHS", (32, 48))
    monkeypatch.setattr(module, "DEAREST", {**DEAREST, "volume.resolution": 64, "rsm.texels": 128, "volume.coarse": 64})
    seen = []
    model, samples = calibrate(frames=4, report=lambda name, share: seen.append(share))
    assert seen[-1] == 1.0
    assert len(samples) == 2 * 2 * 4
    assert {"survey", "voxelize", "rsm", "inject", "direct", "gather", "gbuffer", "rest"} <= set(model.units)
    assert all(value > 0 for units in model.units.values() for value in units.values())
    assert all(1.0 <= gain <= model.threads for gain in model.speedup.values())
    with pytest.raises(OptionError, match="--frames is 3"):
        calibrate(frames=3)


def test_a_relighter_keeps_a_budget(monkeypatch, tmp_path):
    """The chosen settings are those of the next frame; path-trace is timed, instant-radiosity refused."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    relighter = Relighter(path("colour_bleeding"), width=48, settings={"bounces": 2})
    choice = relighter.keep_budget(2.0)
    assert relighter.settings == choice.settings == relighter.plan.settings
    assert choice.settings.bounces == 2
    assert "another machine" in choice.describe()
    assert np.isfinite(relighter.render().comp).all()
    tracer = Relighter(path("colour_bleeding"), method="path-trace", width=48)
    few, many = tracer.keep_budget(2.0), tracer.keep_budget(40.0)
    assert 1 <= few.settings.samples < many.settings.samples
    assert "not predicted" in many.describe()
    with pytest.raises(OptionError, match="noise of path-trace"):
        tracer.keep_budget(max_error=0.1)
    with pytest.raises(OptionError, match="below the floor"):
        tracer.keep_budget(1e-5)
    with pytest.raises(OptionError, match="delta-cones and path-trace"):
        Relighter(path("colour_bleeding"), method="instant-radiosity", width=48).keep_budget(1.0)

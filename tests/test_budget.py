"""Budgets: counts, unit costs and the choice of settings; nothing here depends on how fast the machine is."""

from __future__ import annotations

import json
import math
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from known_costs import chosen, made_model

from warp_dvct import Relighter
from warp_dvct.accuracy import LADDERS
from warp_dvct.budget import choose
from warp_dvct.calibrate import calibrate, subdivide
from warp_dvct.cost import FIRST_RAYS, count_work
from warp_dvct.cost_model import Sample, fit, load_model, model_file, non_negative, save_model
from warp_dvct.errors import FileError, OptionError
from warp_dvct.kernels.survey import EVEN
from warp_dvct.launch import Launcher
from warp_dvct.scene import PointCloud, Role
from warp_dvct.settings import NAMES, make_settings
from warp_dvct.survey import survey
from warp_dvct.usd.read import read_stage
from warp_dvct.usd_scenes import path


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
    assert (room.sharp, ground.sharp, room.blurred) == (0.0, 0.0, 0.0)
    assert 0.2 < glossy.sharp < 0.6
    assert (glossy.focuses, room.focuses) == (True, False)
    assert room.object < room.affected <= 1.0
    assert 0.0 < room.near < 1.0
    # Rays from the objects start in their box, few of those from the walls pass it, and more where detail is.
    assert room.on_object.entered > 0.8
    assert 0.02 < room.on_real.entered < room.on_real.entered_again < 0.5
    assert ground.on_real.entered_again > 2 * ground.on_real.entered
    # A room of 3.6 x 2.2 x 4 m, from within: 47.8 square metres in a coarse volume of about 4.1 m an edge.
    assert 2.5 < room.coarse.records / room.coarse.n**2 < 8.0


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
        return count_work(make_settings("balanced", {"gather.aimed": 0, **names}), room, 320, 180)

    base = counted(gather__detail=0, rsm__texels=64, volume__coarse=0, bounces=5)
    twice = counted(gather__detail=0, gather__rays=128, gather__object_rays=128, rsm__texels=64)["gather"]
    more = FIRST_RAYS * math.sqrt(64), FIRST_RAYS * math.sqrt(128)
    assert twice["rays"] == pytest.approx(base["gather"]["rays"] * (128 + more[1]) / (64 + more[0]))
    assert twice["gathered"] == pytest.approx(base["gather"]["gathered"])
    assert counted(rsm__texels=128, volume__coarse=0)["rsm"]["texels"] == pytest.approx(4 * base["rsm"]["texels"])
    fine = counted(volume__resolution=128, volume__coarse=0)["voxelize"]["records"]
    assert fine == pytest.approx(4 * base["voxelize"]["records"])
    few, many = (counted(bounces=b)["bounces"]["transfers"] for b in (4, 6))
    assert many == pytest.approx(2 * few)
    assert "bounces" not in counted(bounces=1)
    assert "specular" not in base
    assert "specular" in count_work(make_settings(), surveys["room_glossy"], 320, 180)
    twice = count_work(make_settings(), room, 640, 360)["gbuffer"]["pixels"]
    assert twice == pytest.approx(4 * base["gbuffer"]["pixels"])
    without = count_work(make_settings(), replace(room, plate=False), 320, 180)
    assert without["gather"]["rays"] > counted()["gather"]["rays"]
    assert without["direct"]["before deep"] > 0 == base["direct"]["before deep"]
    assert counted(gather__aimed=0.25)["gather"]["rays"] < counted(gather__aimed=0.5)["gather"]["rays"]
    alone = {"gather__detail": 0, "antialias": 0, "gather__object_stride": 64}
    aimed, even = (counted(gather__aimed=share, **alone)["gather"]["rays"] for share in (0.25, 0))
    sent = 16 * (1 + room.on_real.toward)
    share = (sent + FIRST_RAYS * math.sqrt(sent)) / (64 + more[0])
    assert aimed / even == pytest.approx(1 - room.on_real.aimed * (1 - share), rel=0.02)


@pytest.fixture
def counted_gathers(monkeypatch) -> list[float]:
    """How many rays each gather traces, a point's first ones counted as what they cost; rendering fills it."""
    found: list[float] = []
    launch = Launcher.launch

    def counting(self, kernel, count, inputs, outputs=()):
        if kernel.key.startswith("_gather_rays"):
            index = next(value for value in inputs if isinstance(value, wp.array))
            rays = next(value for value in inputs if isinstance(value, int))
            found.append(int((index.numpy() >= 0).sum()) * (rays + FIRST_RAYS * math.sqrt(rays)))
        return launch(self, kernel, count, inputs, outputs)

    def first(self, *launch):
        """What would run beside other work."""
        counting(self, *launch)
        return nullcontext()

    monkeypatch.setattr(Launcher, "launch", counting)
    monkeypatch.setattr(Launcher, "beside", first)
    return found


@pytest.mark.parametrize("stage", ["room_area", "room_glossy", "ground_dome"])
@pytest.mark.parametrize(("stride", "detail"), [(16, 0.25), (8, 0.25), (8, 0.125), (6, 0.0)])
def test_gathered_rays_are_those_of_a_frame(surveys, counted_gathers, stage, stride, detail):
    """Rays told from the survey against those that a frame of another size traces, halved strides included."""
    settings = {"gather.stride": stride, "gather.object_stride": stride // 2, "gather.detail": detail}
    settings |= {
        "gather.rays": 4,
        "gather.object_rays": 4,
        "gather.aimed": 0,
        "volume.resolution": 32,
        "volume.coarse": 32,
        "bounces": 4,
    }
    relighter = Relighter(path(stage), width=256, settings=settings)
    relighter.render(np.full((relighter.height, 256, 3), 0.5, np.float32))
    expected = count_work(relighter.settings, surveys[stage], 256, relighter.height)["gather"]["rays"]
    assert 1e6 * expected == pytest.approx(sum(counted_gathers), rel=0.3)


@pytest.mark.parametrize("stage", ["room_area", "room_glossy", "ground_dome"])
def test_aimed_points_are_those_of_a_frame(surveys, monkeypatch, stage):
    """The share of real gather points whose rays are aimed, told from the survey, against a frame's kept rays; and how
    many they aim for each even one, against NumPy's count at the frame's points."""
    from warp_dvct.bench.twins.aim import Aims
    from warp_dvct.passes import gather

    shares, toward = [], []
    run = gather.Gatherer.run

    def watching(self, launcher, points, index, count, nearness=None, kept=None, **kwargs):
        result = run(self, launcher, points, index, count, nearness, kept, **kwargs)
        if kept is not None and kwargs["part"] == gather.REAL_PARTS[0]:
            filled = kept.point.numpy() >= 0
            shares.append(float((kept.count.numpy()[filled] < self.rays).mean()))
            place, normal = (a.numpy()[kept.point.numpy()[filled]] for a in (points.position, points.normal))
            aims = Aims.of(self.scene.targets, place.astype(float), normal.astype(float), int(EVEN))
            toward.append(float(aims.rays.sum(0)[aims.aimed].mean()) / int(EVEN))
        return result

    monkeypatch.setattr(gather.Gatherer, "run", watching)
    settings = {"gather.rays": 16, "gather.stride": 4, "volume.resolution": 32, "volume.coarse": 32, "bounces": 1}
    relighter = Relighter(path(stage), width=256, settings=settings)
    relighter.render(np.full((relighter.height, 256, 3), 0.5, np.float32))
    assert [surveys[stage].on_real.aimed] == pytest.approx(shares, abs=0.03)
    assert 0.2 < shares[0] < 1.0
    assert [surveys[stage].on_real.toward] == pytest.approx(toward, rel=0.05)


def test_voxels_and_patches_are_those_of_a_frame(surveys):
    """Counts from 32 voxels an edge against those of volumes of 64 and 128, whose numbers nothing here fits."""
    from warp_dvct.cost import _patches
    from warp_dvct.device_scene import DeviceScene
    from warp_dvct.methods.light_field import light_volumes
    from warp_dvct.plan import make_plan

    launcher, scene, room = Launcher("cpu", 2), read_stage(path("room_area")), surveys["room_area"]
    for resolution in (64, 128):
        named = {"volume.resolution": resolution, "volume.coarse": 64, "patches.rays": 1, "rsm.texels": 64}
        settings = make_settings("draft", {**named, "patches.count": 1024})
        plan = make_plan(scene, settings, "delta-cones", 32, 18)
        uploaded = DeviceScene.upload(launcher, scene, np.asarray(plan.origin), plan.scale)
        lit = light_volumes(launcher, scene, uploaded, plan)
        counts = count_work(settings, room, 32, 18)["voxelize"]
        records = sum(v.level_records[0] for v in lit.volumes)
        fragments = sum(v.fragments.count for v in lit.volumes)
        assert 1e6 * counts["records"] == pytest.approx(records, rel=0.1)
        assert 1e6 * counts["fragments"] == pytest.approx(fragments, rel=0.25)
        patches = lit.bounces.irradiance.shape[0] // 2
        assert _patches(settings, room, room.coarse, 64) == pytest.approx(patches, rel=0.3)


def test_edge_points_share_their_pixel_s_samples(surveys):
    """More points an edge pixel do not draw more samples; rays of sharp and of blurred lobes are counted apart."""
    room, glossy = surveys["room_area"], surveys["room_glossy"]
    few, many = (
        count_work(make_settings("balanced", {"antialias": n}), room, 320, 180)["direct"]["probes"] for n in (2, 8)
    )
    assert many == pytest.approx(few)
    assert room.outline * 320 > 1000
    specular = count_work(make_settings("balanced", {"glossy.rays": 16, "antialias": 4}), glossy, 320, 180)["specular"]
    assert specular["blurred"] == 0.0
    assert specular["sharp"] == pytest.approx(16 * specular["points"], rel=0.3)


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


def test_a_fit_finds_the_units_that_made_the_samples(surveys):
    """Frames of a known machine, a tenth of noise: times of other settings are found within a tenth."""
    truth, rng = made_model(), np.random.default_rng(4)
    samples = []
    for found in surveys.values():
        for _ in range(15):
            knobs = {}
            for ladder in LADDERS:
                knobs |= ladder.settings(ladder.values[rng.integers(min(5, len(ladder.values)))])
            work = count_work(make_settings("balanced", knobs), found, int(rng.choice([160, 320])), 180)
            cpu = {name: truth.cpu_seconds({name: counts}) * rng.uniform(0.9, 1.1) for name, counts in work.items()}
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
    """A gain of 1.5 by two threads leaves a third on one thread: three times as fast at most. What every frame takes
    gains nothing."""
    model = made_model()
    alone = {"gather": {"frame": 1.0}}
    assert model.seconds(alone, 4) == model.seconds(alone, 1) == pytest.approx(0.005)
    work = {"rsm": {"texels": 1.0}}
    assert model.seconds(work, 1) == pytest.approx(0.17)
    assert model.seconds(work, 2) == pytest.approx(0.17 / 1.5)
    assert model.seconds(work, 4) == pytest.approx(0.17 * (1 / 3 + 2 / 3 / 4))
    assert made_model(threads=1).seconds(work, 2) == pytest.approx(0.17)


@pytest.mark.parametrize("stage", ["room_area", "room_glossy", "ground_dome"])
def test_more_time_is_used_and_predicts_less_error(surveys, stage):
    """The prediction lands within a tenth of the budget, but where more rays would not show; and the error never rises
    with it."""
    last = math.inf
    for budget in (0.25, 0.5, 1.0, 2.0, 5.0, 20.0):
        choice = chosen(surveys, stage, seconds=budget)
        assert choice.seconds <= budget
        assert choice.seconds >= 0.9 * budget or (choice.enough and budget > 5.0)
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
    monkeypatch.setattr(module, "MOST_SECONDS", 0.15)
    seen = []
    model, samples = calibrate(frames=4, report=lambda name, share: seen.append(share))
    assert seen[-1] == 1.0
    assert len(samples) == 2 * (4 + 4 + 2 + 1)  # surveys, frames, two by cones, and one of instant radiosity
    assert {
        "survey",
        "choosing",
        "probe",
        "voxelize",
        "rsm",
        "inject",
        "direct",
        "gather",
        "gbuffer",
        "rest",
        "ism",
    } <= set(model.units)
    assert all(value > 0 for units in model.units.values() for value in units.values())
    assert all(1.0 <= gain <= model.threads for gain in model.speedup.values())
    with pytest.raises(OptionError, match="--frames is 3"):
        calibrate(frames=3)


@pytest.mark.cpu
def test_a_relighter_keeps_a_budget(monkeypatch, tmp_path):
    """The chosen settings are those of the next frame."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    relighter = Relighter(path("colour_bleeding"), width=48, settings={"bounces": 2})
    choice = relighter.keep_budget(2.0)
    assert relighter.settings == choice.settings == relighter.plan.settings
    assert choice.settings.bounces == 2
    assert "another machine" in choice.describe()
    assert np.isfinite(relighter.render().comp).all()
    few = Relighter(path("colour_bleeding"), method="instant-radiosity", width=48).keep_budget(1.0)
    assert few.method == "instant-radiosity"
    assert few.to_dict()["chosen"]["vpls.further"] == few.settings.vpls_further


def test_paths_buy_what_their_time_says(monkeypatch):
    """Paths of a known time and noise: the samples that a budget holds, the fewest that keep an error, the floor."""
    from warp_dvct import planning

    known = planning._Paths(2e-6, 4e-6, spent=0.1, spent_cpu=0.2, noise=0.02, falls=0.5)
    monkeypatch.setattr(planning, "_try_paths", lambda *args: known)
    tracer = Relighter(path("colour_bleeding"), method="path-trace", width=48)
    each = 2e-6 * tracer.width * tracer.height
    few, many = tracer.keep_budget(1.0), tracer.keep_budget(20.0)
    for budget, choice in ((1.0, few), (20.0, many)):
        samples = choice.settings.samples
        assert choice.seconds == pytest.approx(0.1 + samples * each)
        assert 0.1 + samples * each <= 0.95 * budget < 0.1 + (samples + 1) * each
        assert choice.error == pytest.approx(
            planning.FLIP_OF_NOISE * 0.02 * math.sqrt(planning.PILOT_SAMPLES / samples)
        )
    for error in (0.5 * few.error, 0.03 * few.error):
        samples = tracer.keep_budget(max_error=error).settings.samples
        assert known.error(samples) <= error < known.error(samples - 1)
    with pytest.raises(OptionError, match=r"would take \d+ samples a pixel"):
        tracer.keep_budget(max_error=1e-9)
    with pytest.raises(OptionError, match=rf"below the floor: .* about {0.1 + each:.2f} s"):
        tracer.keep_budget(0.1)


def test_paths_are_tried_on_the_scene():
    """The noise is the scene's and the same each time; only what a path takes is the clock's."""
    from warp_dvct.planning import FALLS, _try_paths

    tries = []
    for stage in ("colour_bleeding", "colour_bleeding", "room_area"):
        scene = read_stage(path(stage))
        tries.append(_try_paths(scene, Launcher("cpu", 2), 48, 27, make_settings("balanced")))
        assert tries[-1].seconds > 0 < tries[-1].cpu_seconds
        assert tries[-1].spent > 8 * 48 * 27 * tries[-1].seconds  # two pictures of four samples, and the upload
        assert FALLS[0] <= tries[-1].falls <= FALLS[1]
    assert tries[0].noise == tries[1].noise > 0
    assert tries[0].falls == tries[1].falls
    assert tries[2].noise != tries[0].noise


def test_the_noise_of_paths_is_about_that_measured():
    """FLIP of few samples against many, of the same small picture, within the factor that predictions promise."""
    from warp_dvct.metrics import flip_ldr

    scene = read_stage(path("room_area"))
    truth = Relighter(scene, method="path-trace", width=96, settings={"samples": 512, "seed": 9})
    plate = truth.render().plate
    exact = truth.render(plate).comp
    tracer = Relighter(scene, method="path-trace", width=96, settings={"samples": 4})
    expected = tracer.keep_budget(20.0, has_plate=True).error
    assert flip_ldr(exact, tracer.render(plate).comp)[0] == pytest.approx(expected, rel=0.5)


def test_virtual_lights_fit_a_budget(surveys):
    """Instant radiosity's own settings: more time means more of them, and what is given stays."""
    cheap, dear = (chosen(surveys, seconds=s, method="instant-radiosity") for s in (0.8, 10.0))
    assert cheap.seconds <= 0.8
    assert 0.9 * 10.0 <= dear.seconds <= 10.0 or dear.enough
    assert dear.error < cheap.error
    assert dear.settings.vpls_count > cheap.settings.vpls_count
    given = chosen(surveys, seconds=10.0, method="instant-radiosity", fixed={"vpls.count": 99})
    assert given.settings.vpls_count == 99


def test_a_budget_that_buys_nothing_more_is_said(surveys):
    """Far beyond what shows, the rest of the time is left, and the choice says so."""
    choice = chosen(surveys, seconds=10_000.0)
    assert choice.enough
    assert choice.seconds < 9_000
    assert "more would not show" in choice.describe()
    assert not chosen(surveys, seconds=1.0).enough


@pytest.mark.cpu
def test_a_scan_s_points_are_part_of_what_is_surveyed(monkeypatch, tmp_path):
    """Point clouds are drawn as surfels; a budget that did not see them would find less of the scene."""
    from warp_dvct import planning

    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    scene, found = read_stage(path("colour_bleeding")), []
    whole = planning.survey
    monkeypatch.setattr(planning, "survey", lambda *args, **kwargs: found.append(whole(*args, **kwargs)) or found[-1])
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3))
    up = np.tile(np.array([0.0, 1.0, 0.0], np.float32), (50, 1))
    cloud = PointCloud(points, up, np.full(50, 0.01, np.float32), Role.REAL)
    for clouds in ((), (cloud,)):
        Relighter(replace(scene, point_clouds=clouds), width=48).keep_budget(3.0)
    assert found[1].real_triangles >= found[0].real_triangles + 50
    assert found[1].synthetic_triangles == found[0].synthetic_triangles

"""What budgets say of errors, and what cones take: the shipped table, plans against presets, counts of marches."""

from __future__ import annotations

import math

import pytest
from known_costs import chosen, made_model

from warp_dvct import Relighter
from warp_dvct.accuracy import BOUNCES, DENSITY, LEAST_NOISE, REFERENCE, STRIDE, load_accuracy
from warp_dvct.budget import AIM, choose
from warp_dvct.cost import CHOOSING, count_survey, count_work
from warp_dvct.cost_cones import march_steps
from warp_dvct.cost_model import shipped_model
from warp_dvct.metrics import flip_ldr
from warp_dvct.settings import QUALITIES, make_settings
from warp_dvct.survey import survey
from warp_dvct.usd.read import read_stage
from warp_dvct.usd_scenes import path

STAGES = (
    *("room_area", "room_spot", "room_glossy", "ground_dome"),
    *("bunny", "thin_wall", "colour_bleeding", "double_shadow"),
)


@pytest.mark.parametrize("stage", STAGES)
def test_a_plan_is_no_worse_than_a_preset_of_its_time(surveys, launcher, stage):
    """On the shipped machine and on a made one, for every preset: within its predicted time no more predicted error."""
    scene = read_stage(path(stage))
    found = surveys.get(stage) or survey(scene, make_settings(), launcher, scene.camera.aspect, has_plate=True)
    width, height = 320, 180
    for model in (shipped_model(), made_model()):
        planning = {"survey": count_survey(found), CHOOSING: {"frame": 1.0}}
        for quality in QUALITIES:
            preset = make_settings(quality)
            seconds = model.seconds(count_work(preset, found, width, height) | planning, 2)
            plan = choose(found, model, width=width, height=height, threads=2, seconds=seconds / AIM)
            assert plan.seconds <= 1.0001 * seconds
            assert plan.error <= load_accuracy().error(preset, found, width), quality


def test_texels_and_voxels_are_chosen_together(surveys):
    """What a map's limit keeps from being texels is not counted as such, by how far it does."""
    table = load_accuracy()
    for found in surveys.values():

        def excess(density: float, n: int = 64, texels: int = 1024, found=found) -> float:
            knobs = {DENSITY: density, "volume.resolution": n, "volume.coarse": n, "rsm.texels": texels}
            return table.excess(DENSITY, make_settings("balanced", knobs), found)

        assert excess(1) > excess(2) == pytest.approx(0.0, abs=0.01)
        assert excess(4, texels=math.ceil(max(64 * max(m.fine, m.coarse) for m in found.maps))) <= excess(1)
        assert excess(4, texels=math.floor(min(64 * min(m.fine, m.coarse) for m in found.maps))) >= excess(1)
        assert excess(2, n=512) > excess(2, n=256) >= excess(2)


def test_missing_bounces_are_what_the_survey_saw(surveys):
    """None are missing of all; errors fall from bounce to bounce, faster where light leaves the scene; patches that no
    bounce needs cost no error."""
    table = load_accuracy()
    for found in surveys.values():
        values = [table.excess(BOUNCES, make_settings("balanced", {"bounces": b}), found) for b in (0, 1, 2, 4, 6, 8)]
        assert values == sorted(values, reverse=True)
        assert values[-1] == 0.0 < values[1]
        few = make_settings("balanced", {"bounces": 1, "patches.count": 8})
        assert table.excess("patches.count", few, found) == 0.0
    room, ground = surveys["room_area"], surveys["ground_dome"]
    assert 0.4 < room.decay < 0.8
    assert ground.decay < 0.1
    assert room.later > 5 * ground.later


def test_cones_are_counted_instead_of_rays(surveys):
    """Marches take steps by the volumes' resolution and the cones' step; rays, their detail and probes cost nothing."""
    for found in surveys.values():
        cones = {"gather": "cones", "shadows": "cone", "glossy": "cones"}
        base, rays = (count_work(make_settings("balanced", x), found, 320, 180) for x in (cones, {}))
        twice = count_work(make_settings("balanced", {**cones, "cones.count": 18}), found, 320, 180)
        assert twice["gather"]["cones"] == pytest.approx(2 * base["gather"]["cones"])
        short = count_work(make_settings("balanced", {**cones, "cones.step": 0.5}), found, 320, 180)
        for name, unit in (("gather", "steps"), ("direct", "shadow steps")):
            assert short[name][unit] == pytest.approx(2 * base[name][unit], rel=0.15)
        finer = {**cones, "volume.resolution": 128, "volume.coarse": 128, "cones.aperture": 1}
        narrow = count_work(make_settings("balanced", {**cones, "cones.aperture": 1}), found, 320, 180)
        steps = count_work(make_settings("balanced", finer), found, 320, 180)["gather"]["steps"]
        assert steps == pytest.approx(2 * narrow["gather"]["steps"], rel=0.1)
        assert "rays" in rays["gather"]
        assert "rays" not in base["gather"]
        assert "probes" not in base["direct"]
        assert "pyramid" in base
        assert "pyramid" not in rays
        alone = {"bounces": 0, "shadows": "cone"}  # a volume for shadows alone
        assert "voxelize" in count_work(make_settings("balanced", alone), found, 320, 180)


@pytest.mark.parametrize("stage", ["room_area", "room_glossy", "ground_dome"])
def test_cones_march_as_many_steps_as_counted(surveys, stage, launcher):
    """Steps of the march, taken in NumPy through the very levels and boxes, from points of the fine volume's middle."""
    found, settings = surveys[stage], make_settings("balanced", {"gather": "cones", "cones.count": 9})
    counts = count_work(settings, found, 320, 180)["gather"]
    mean = counts["steps"] / counts["cones"]
    aperture = 2 * math.acos(1 - 0.5 / (9 * 2 / 3))
    fine, coarse = 1 / 64, found.reach / 64
    for near in (False, True):
        at, steps = 0.0, 0
        while at < 0.5 * found.reach:
            width = max(2 * math.tan(aperture / 2) * 0.5 * at, fine)
            voxel = fine if near and at < 0.5 else coarse
            while 2 * voxel <= width:
                voxel *= 2
            at, steps = at + voxel, steps + 1
        assert steps == march_steps(fine, coarse, found.reach, math.tan(aperture / 2), 1.0, near=near)
        assert 0.4 * steps < mean < 2.5 * steps


def test_a_budget_by_cones_turns_their_knobs(surveys):
    """More time buys more cones and finer strides, and no rays, which nobody traces."""
    fixed = {"gather": "cones", "shadows": "cone", "glossy": "cones"}
    few, many = (chosen(surveys, "room_glossy", seconds=s, fixed=fixed) for s in (0.4, 5.0))
    assert few.error > many.error
    assert few.seconds < many.seconds <= 5.0
    assert few.settings.gather_rays == many.settings.gather_rays == make_settings().gather_rays
    assert few.settings.glossy_rays == many.settings.glossy_rays == make_settings().glossy_rays
    assert (many.settings.cones_count, -many.settings.gather_stride) > (4, -16)
    assert "cones.count" in many.describe()
    assert "cones.count" not in chosen(surveys, seconds=5.0).describe()
    assert many.pace is None
    by_rays, by_cones = (chosen(surveys, seconds=2.0, fixed=x) for x in ({}, fixed))
    assert by_rays.error < by_cones.error


def test_where_every_ray_brings_the_same_light_only_outlines_err(launcher):
    """The furnace: no noise is seen, and the error is that of the objects' outlines, at any points an edge pixel; what
    more time would buy does not show."""
    width, height = 160, 90
    scene = read_stage(path("furnace"))
    found = survey(scene, make_settings(), launcher, scene.camera.aspect, has_plate=True)
    assert found.noise <= LEAST_NOISE
    assert found.outlined > 0.1
    truth = Relighter(
        scene, method="path-trace", width=width, height=height, settings={"samples": 256, "bounces": 8}
    ).render()
    for antialias in (0, 2, 8):
        settings = make_settings("balanced", {"antialias": antialias, "bounces": 8})
        picture = Relighter(scene, width=width, height=height, settings={"antialias": antialias, "bounces": 8}).render(
            truth.plate
        )
        measured = flip_ldr(truth.comp, picture.comp)[0]
        assert 1 / 1.5 < measured / load_accuracy().error(settings, found, width) < 1.5, antialias
    plan = choose(found, made_model(), width=width, height=height, threads=2, seconds=20.0)
    assert plan.enough


def test_the_shipped_table_is_of_the_presets_of_today():
    """Whoever changes ``balanced`` measures the table anew: docs/tradeoff.md says how."""
    assert make_settings("balanced", REFERENCE) == make_settings("balanced", {BOUNCES: REFERENCE[BOUNCES]})
    coefficients = {"diffuse", "glossy", "noise", "shown", "change", "width", "outlined", "bounces"}
    coefficients |= {"diffuse overlap", "glossy overlap"}
    assert coefficients <= set(load_accuracy().base)
    tables = load_accuracy().knobs
    for kind in ("diffuse", "glossy"):
        assert {DENSITY, "volume.resolution", "cones.count", "shadows=cone"} <= set(tables[kind])
        assert {v: e for v, e in tables[kind][DENSITY]}[REFERENCE[DENSITY]] == pytest.approx(0.0, abs=0.03)
    assert "glossy=cones" in tables["glossy"]


def test_the_shipped_table_orders_values(surveys):
    """Dearer values never err more, and the presets come out in their order."""
    table = load_accuracy()
    assert set(table.knobs) >= {"diffuse", "glossy", "instant-radiosity closed", "instant-radiosity open"}
    for knobs in table.knobs.values():
        for knob, values in knobs.items():
            errors = [e for _, e in values]
            assert errors == sorted(errors, reverse=not knob.startswith((STRIDE, "vpls.tiles"))), knob
    for found in surveys.values():
        draft, balanced, high = (table.error(make_settings(q), found, 320) for q in ("draft", "balanced", "high"))
        assert draft > balanced > high > 0
        finer = [
            table.excess(STRIDE, make_settings("balanced", {STRIDE: 16, "gather.detail": d}), found)
            for d in (0.0, 0.5, 0.3, 0.25, 0.125)
        ]
        assert finer == sorted(finer, reverse=True)
    rays = [make_settings("balanced", {"gather.rays": n}) for n in (512, 1024, 8192, 65536)]
    more = [table.excess("gather.rays", settings, surveys["room_area"]) for settings in rays]
    assert more == sorted(more, reverse=True)
    assert more[-1] > -1

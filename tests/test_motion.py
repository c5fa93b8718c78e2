"""Moving shots: every frame equals the frame from scratch bit for bit, and what is static is kept."""

from __future__ import annotations

from dataclasses import replace

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct.bench.motion import MotionOptions, flicker_of, format_report, measure, same, shot
from warp_dvct.errors import OptionError
from warp_dvct.frame import volume_frame
from warp_dvct.kept import Kept
from warp_dvct.kernels import gather, gbuffer
from warp_dvct.launch import Launcher
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Camera, Light, LightKind, LightRole, Material, Role

SMALL = {
    "volume.resolution": 40,
    "volume.coarse": 20,
    "rsm.texels": 64,
    "gather.rays": 8,
    "gather.object_rays": 8,
    "shadows.samples": 4,
    "shadows.probes": 2,
    "patches.count": 200,
    "patches.rays": 8,
    "glossy.rays": 2,
    "bounces": 3,
}
SHINY = Material(base_color=(0.6, 0.5, 0.4), roughness=0.3)
BULB = Light(LightKind.POINT, (0.2, 0.2, 0.3), position=(0.25, 0.6, 0.7), role=LightRole.ADDED, path="/World/Bulb")


def scene(offset=(0.0, 0.0, 0.0), *, bulb=(0.0, 0.0, 0.0), lights=2, material=lit.GREY, camera_x=0.5):
    middle = np.array([0.5, 0.3, 0.5]) + offset
    parts = [lit.mesh(lit.room(0.45)), lit.mesh(lit.cuboid((0.25, 0.15, 0.3), 0.08))]
    parts += [
        lit.mesh(lit.cuboid(middle, 0.1), Role.SYNTHETIC),
        lit.mesh(lit.ball(middle + 0.15, 0.06, 12), Role.SYNTHETIC),
    ]
    to_world = np.eye(4)
    to_world[:3, 3] = (camera_x, 0.5, 0.93)
    moved = replace(BULB, position=tuple(np.array(BULB.position) + bulb))
    made = lit.scene_of(*parts, lights=(lit.LAMP, moved)[:lights], materials=(material,))
    return replace(made, camera=Camera(to_world, -0.8, 0.8, -0.6, 0.6, path="/World/Camera"))


def relighter(of, threads=2, **overrides) -> Relighter:
    settings = {**SMALL, **{k.replace("__", "."): v for k, v in overrides.items()}}
    return Relighter(of, settings=settings, width=64, height=48, threads=threads)


def of_all(name: str) -> bool:
    """Whether a kept result is one of all surfaces, synthetic ones as well."""
    return name.startswith("all ")


@pytest.fixture(scope="module")
def plate() -> np.ndarray:
    return np.ascontiguousarray(relighter(scene()).render().plate)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("material", [lit.GREY, SHINY], ids=["matte", "glossy"])
def test_frames_of_a_random_walk_equal_frames_from_scratch(plate, threads, material):
    """Small steps that keep the box, and large ones that move it; with two lights, one of them added."""
    rng = np.random.default_rng(4)
    moving = relighter(scene(material=material), threads)
    moving.render(plate)
    last, kept = None, []
    for step in (0.004, 0.01, 0.01, 0.1, 0.01):
        moment = scene(rng.uniform(-step, step, 3), material=material)
        moving.set_scene(moment)
        frame = moving.render(plate)
        assert same(frame, relighter(moment, 3 - threads).render(plate)), "another number of threads, from scratch"
        assert last is None or not np.array_equal(frame.comp, last.comp), "the object moved"
        last = frame
        kept.append(moving.stats["kept"])
    assert any(all(k[name] for name in k if not of_all(name)) for k in kept), kept
    assert not any(k[name] for k in kept for name in k if of_all(name)), "the object is part of it"


def test_without_a_plate_and_with_a_moving_camera():
    moving = relighter(scene())
    for k in range(3):
        moment = scene((0.004 * k, 0.0, 0.0), camera_x=0.5 + 0.01 * (k // 2))
        moving.set_scene(moment)
        assert same(moving.render(), relighter(moment).render())
    kept = moving.stats["kept"]
    assert not kept["camera's real hits"], "the camera moved"
    assert not kept["gathered real hits"]
    assert kept["real fragments, fine volume"], "the room did not"


@pytest.mark.parametrize("other", [{"antialias": 0}, {"antialias": 2}, {"seed": 5}], ids=str)
def test_edges_come_back_after_frames_with_others(plate, other):
    """A budget may leave them out for a while, in which objects move."""
    moving = relighter(scene())
    moving.render(plate)
    settings = moving.settings
    for k, changed in enumerate((other, {})):
        moving.settings = replace(settings, **changed)
        moment = scene((0.03 * (k + 1), 0.02, 0.0))
        moving.set_scene(moment)
        frame = moving.render(plate)
    assert same(frame, relighter(moment).render(plate))


def test_objects_leave_and_come_back(plate):
    """Without any, no row changes, and all edges stay."""
    moving = relighter(scene())
    moving.render(plate)
    empty = replace(scene(), meshes=tuple(m for m in scene().meshes if m.role == Role.REAL))
    for moment in (empty, empty, scene((0.03, 0.02, 0.0))):
        moving.set_scene(moment)
        frame = moving.render(plate)
        assert same(frame, relighter(moment).render(plate))


def test_edges_above_the_objects_are_not_traced_again(plate, monkeypatch):
    traced = []
    launch = Launcher.launch

    def count(launcher, kernel, elements, *arrays):
        if kernel is gbuffer._see_edges:
            traced.append(elements)
        return launch(launcher, kernel, elements, *arrays)

    monkeypatch.setattr(Launcher, "launch", count)
    moving = relighter(scene())
    for k in range(2):
        moment = scene((0.004 * k, 0.0, 0.0))
        moving.set_scene(moment)
        frame = moving.render(plate)
    assert same(frame, relighter(moment).render(plate))
    assert 0 < traced[1] < traced[2]


def test_a_moving_light_leaves_geometry_and_the_other_light():
    moving = relighter(scene())
    moving.render()
    moment = scene(bulb=(0.02, 0.0, 0.0))
    moving.set_scene(moment)
    assert same(moving.render(), relighter(moment).render())
    kept = moving.stats["kept"]
    assert {name.split(",")[0] for name, reused in kept.items() if not reused} == {"real map of light 1", "lights"}


@pytest.mark.parametrize("material", [lit.GREY, SHINY], ids=["matte", "glossy"])
@pytest.mark.parametrize("plated", [True, False], ids=["plate", "no plate"])
def test_while_only_a_light_moves_all_that_rays_met_is_kept(plate, monkeypatch, material, plated):
    """Even and aimed rays; then the objects move, which the next two frames take up again, and come back."""
    passed = []
    launch = Launcher.launch

    def look(launcher, kernel, count, inputs, *outputs):
        result = launch(launcher, kernel, count, inputs, *outputs)
        if kernel in (gather._gather_rays, gather._gather_rays_glossy) and inputs[-1].slots:
            passed.append(inputs[-1])
        return result

    moving = relighter(scene(material=material), gather__aimed=0.5)
    kept = []
    for bulb, shift in ((0.0, 0.0), (0.02, 0.0), (0.04, 0.0), (0.05, 0.01), (0.06, 0.01), (0.07, 0.01), (0.02, 0.0)):
        moment = scene((shift, 0.0, 0.0), bulb=(bulb, 0.0, 0.0), material=material)
        fresh = relighter(moment, gather__aimed=0.5).render(plate if plated else None)
        monkeypatch.setattr(Launcher, "launch", look)
        passed.clear()
        moving.set_scene(moment)
        assert same(moving.render(plate if plated else None), fresh)
        monkeypatch.setattr(Launcher, "launch", launch)
        kept.append([bool(of.whole) for of in passed])
    assert [set(frame) for frame in kept] == [{False}, {True}, {True}, {False}, {True}, {True}, {False}]


def test_cones_read_all_levels(plate):
    moving = relighter(scene(), gather="cones")
    moving.render(plate)
    moment = scene((0.004, 0.0, 0.003))
    moving.set_scene(moment)
    assert same(moving.render(plate), relighter(moment, gather="cones").render(plate))


def test_real_geometry_that_moves_is_not_kept(plate):
    moving = relighter(scene())
    moving.render(plate)
    still = scene()
    moment = replace(
        still,
        meshes=(still.meshes[0], replace(still.meshes[1], points=still.meshes[1].points + 0.01), *still.meshes[2:]),
    )
    moving.set_scene(moment)
    assert same(moving.render(plate), relighter(moment).render(plate))
    assert not any(moving.stats["kept"].values())


def test_set_scene_needs_a_scene(tmp_path):
    from warp_dvct.usd_scenes import path

    with pytest.raises(OptionError, match="set_time"):
        Relighter(path("furnace"), width=16).set_scene(scene())


@pytest.mark.parametrize("scale", [1.0, 1.5, 2.0, 5.0])
def test_the_box_goes_in_steps_and_holds_the_objects(scale):
    """Its edge is within 9 % of what was asked for (more only to hold the objects), its middle within a sixteenth."""
    rng = np.random.default_rng(1)
    frames = set()
    for _ in range(200):
        moment = scene(rng.uniform(-0.05, 0.05, 3))
        bounds = moment.bounds(Role.SYNTHETIC)
        assert bounds is not None
        low, high = bounds
        frame = volume_frame(moment, scale)
        corner = frame.origin + frame.fine * frame.edge
        assert (low >= corner - 1e-12).all()
        assert (high <= corner + frame.edge + 1e-12).all()
        asked = scale * (high - low).max()
        assert frame.edge > asked * 0.917
        assert frame.edge < max(asked * 1.091, (high - low).max() * 8 / 7 * 1.19)
        assert (np.abs(corner + 0.5 * frame.edge - 0.5 * (low + high)) <= frame.edge / 16 + 1e-12).all()
        np.testing.assert_allclose(frame.origin + frame.low * frame.edge, 0.05, atol=1e-12)
        frames.add((*frame.origin, *frame.fine, frame.edge, *frame.low, *frame.high))
    assert len(frames) < 60


def test_volume_space_stays_while_the_fine_volume_follows(plate):
    """A step of the box costs what is its own, and nothing of what lies in volume space."""
    moving = relighter(scene())
    moving.render(plate)
    moved = set()
    for k in range(1, 12):
        moment = scene((0.02 * k, 0.0, 0.0))
        before = moving.plan
        moving.set_scene(moment)
        frame = moving.render(plate)
        if moving.plan.fine != before.fine:
            assert same(frame, relighter(moment).render(plate))
        for name in ("origin", "scale", "coarse", "start"):
            assert getattr(moving.plan, name) == getattr(before, name)
        kept = moving.stats["kept"]
        moved |= {name.split(", ")[-1] for name in kept if not of_all(name) and not kept[name]}
    assert moved == {"fine volume"}


def test_origins_are_near_objects_in_a_wide_scene():
    """Coordinates on an object stay below five of its volume's edges, however far the real scene reaches."""
    ground = lit.mesh(lit.rectangle((0.0, 0.0, 0.0), (0.0, 0.0, 500.0), (500.0, 0.0, 0.0)))
    rng = np.random.default_rng(3)
    for _ in range(50):
        middle = np.array([*rng.uniform(-400.0, 400.0, 2), 0.2])[[0, 2, 1]]
        frame = volume_frame(lit.scene_of(ground, lit.mesh(lit.cuboid(middle, 0.1), Role.SYNTHETIC)), 2.0)
        assert np.abs(frame.middle).max() < 4.1
        np.testing.assert_allclose(frame.origin + frame.middle * frame.edge, middle, atol=frame.edge / 16 + 1e-12)


def test_objects_outside_of_the_real_scene_are_in_the_coarse_volume():
    ground = lit.mesh(lit.rectangle((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)))
    above = lit.scene_of(ground, lit.mesh(lit.cuboid((0.5, 0.1003, 0.5), 0.1), Role.SYNTHETIC))
    frame = volume_frame(above, 2.0)
    bounds = above.bounds()
    assert bounds is not None
    low, high = bounds
    assert (frame.origin + frame.low * frame.edge <= low + 1e-12).all()
    assert (frame.origin + frame.high * frame.edge >= high - 1e-12).all()


def test_kept_results_are_replaced_by_key_and_dropped_with_the_real_scene():
    kept, made = Kept(), []

    def make(value):
        made.append(value)
        return value

    kept.set_scene("room", "ball")
    assert [kept.get("a", k, lambda k=k: make(k)) for k in (1, 1, 2)] == [1, 1, 2]
    assert kept.reused == {"a": False}
    kept.set_scene("room", "ball")
    assert kept.get("a", 2, lambda: make(3)) == 2
    assert kept.reused == {"a": True}
    kept.set_scene("hall", "ball")
    assert kept.get("a", 2, lambda: make(4)) == 4
    assert made == [1, 2, 4]


def test_shot_moves_objects_or_a_light_and_nothing_else():
    still = scene()
    for moment in shot(still, 8, False)[1:]:
        offsets = [b.points - a.points for a, b in zip(still.meshes, moment.meshes, strict=True)]
        assert not offsets[0].any()
        assert not offsets[1].any()
        assert np.ptp(offsets[2], 0).max() < 1e-12
        assert abs(offsets[2][0, 1]) < 1e-12, "the camera's up is y"
        assert moment.lights is still.lights
    assert {m.lights[0].position for m in shot(still, 8, True)} != {lit.LAMP.position}
    with pytest.raises(OptionError, match="no light"):
        shot(replace(still, lights=()), 8, True)
    with pytest.raises(OptionError, match="at least 2"):
        shot(still, 1, False)


def test_flicker_of_a_steady_error_is_nothing():
    rng = np.random.default_rng(0)
    truths = [rng.uniform(0.2, 0.6, (32, 48, 3)).astype(np.float32) for _ in range(3)]
    steady = [t + np.float32(0.1) for t in truths]
    noisy = [t + rng.normal(0, 0.05, t.shape).astype(np.float32) for t in truths]
    assert flicker_of(steady, truths) < 1e-3
    assert flicker_of(noisy, truths) > 0.05


@pytest.mark.parametrize(("light", "plate"), [(False, True), (True, True), (True, False)])
def test_the_truth_of_flicker_says_what_its_own_noise_is_worth(light, plate, tmp_path):
    """A short shot from end to end. Without what the two halves of the truth differ by, figures against four and
    against 256 samples a pixel agree better than with it; frames equal frames from scratch."""

    def report(samples: int):
        options = MotionOptions(
            frames=6, light=light, quality="draft", width=48, checks=1, flicker=3, flicker_width=48, samples=samples
        )
        return measure("room_area", replace(options, plate=plate, cache=tmp_path))

    few, many = report(4), report(256)
    assert many.checked == many.equal == 1
    one, other = few.flicker, many.flicker
    assert other.truth_noise < 0.3 * one.truth_noise
    for rough, fine in ((one.ours, other.ours), (one.peer, other.peer)):
        assert 0.0 < other.net(fine) < fine
        assert abs(one.net(rough) - other.net(fine)) < 0.5 * abs(rough - other.net(fine))
    assert f"without the truth's own {other.truth_noise:.4f}" in format_report(many)

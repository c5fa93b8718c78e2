"""Averages over frames: they converge, follow the camera, and never show what is gone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from warp_dvct import usd_scenes
from warp_dvct.bench.references import ReferenceStore
from warp_dvct.device_scene import DeviceScene, camera_frame
from warp_dvct.metrics import flip_ldr
from warp_dvct.passes.gbuffer import render_gbuffer
from warp_dvct.passes.history import Blender
from warp_dvct.plan import make_plan
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Role
from warp_dvct.settings import make_settings
from warp_dvct.usd.read import read_stage

WIDTH, HEIGHT = 96, 54
SMALL = {"bounces": 1, "vpls.count": 64, "ism.size": 32, "ism.points": 256, "vpls.frames": 8}


@pytest.fixture(scope="module")
def room():
    return read_stage(usd_scenes.path("room_spot"))


def make(scene, threads=None, **settings):
    values = {**SMALL, **{k.replace("__", "."): v for k, v in settings.items()}}
    return Relighter(scene, method="instant-radiosity", width=48, height=27, settings=values, threads=threads)


def pushed(scene, meters):
    to_world = scene.camera.to_world.copy()
    to_world[:3, 3] += meters * to_world[:3, 0]
    return replace(scene, camera=replace(scene.camera, to_world=to_world))


def object_moved(scene):
    meshes = tuple(replace(m, points=m.points + np.array([0.2, 0, 0.1])) if m.role else m for m in scene.meshes)
    return replace(scene, meshes=meshes)


def lamp_moved(scene):
    lights = tuple(replace(light, position=(0.3, *light.position[1:])) for light in scene.lights)
    return replace(scene, lights=lights)


def lamp_dimmed(scene):
    return replace(scene, lights=tuple(replace(x, radiance=tuple(0.5 * c for c in x.radiance)) for x in scene.lights))


def real_wall_moved(scene):
    meshes = list(scene.meshes)
    index = next(i for i, m in enumerate(meshes) if m.role == Role.REAL)
    meshes[index] = replace(meshes[index], points=meshes[index].points + np.array([0, 0, -0.05]))
    return replace(scene, meshes=tuple(meshes))


def repainted(scene):
    materials = tuple(replace(m, base_color=tuple(0.7 * c for c in m.base_color)) for m in scene.materials)
    return replace(scene, materials=materials)


@pytest.mark.parametrize("change", [object_moved, lamp_moved, lamp_dimmed, real_wall_moved, repainted])
def test_nothing_that_changed_leaves_a_ghost(room, change):
    """After still and moving frames, the first one of what changed is that from scratch, bit for bit."""
    relighter = make(room)
    for meters in (0.0, 0.0, 0.05, 0.05):
        relighter.set_scene(pushed(room, meters))
        before_change = relighter.render()
    changed = pushed(change(room), 0.05)
    relighter.set_scene(changed)
    layers = relighter.render()
    scratch = make(changed).render()
    for name in ("comp", "plate", "delta", "rgba"):
        np.testing.assert_array_equal(getattr(layers, name), getattr(scratch, name))
    assert not np.array_equal(layers.comp, before_change.comp)


def test_the_first_frame_is_that_without_averaging(room):
    np.testing.assert_array_equal(make(room).render().comp, make(room, vpls__frames=1).render().comp)


def test_frames_repeat_for_any_number_of_threads(room):
    shots = []
    for threads in (1, 2, 2):
        relighter = make(room, threads)
        for meters in (0.0, 0.0, 0.04):
            relighter.set_scene(pushed(room, meters))
            layers = relighter.render()
        shots.append(layers)
    for other in shots[1:]:
        np.testing.assert_array_equal(shots[0].comp, other.comp)


def test_a_plate_that_comes_or_goes_starts_anew(room):
    relighter = make(room)
    plate = relighter.render().plate
    relighter.render()
    with_plate = relighter.render(plate)
    assert np.isfinite(with_plate.comp).all()
    assert relighter.render(plate).comp.shape == plate.shape
    assert np.isfinite(relighter.render().comp).all()


@pytest.mark.parametrize("step", [0.0, 0.02])
def test_frames_converge_to_the_truth(launcher, tmp_path, step):
    """While the camera stands or moves, each frame adds VPLs: the error against the path tracer falls."""
    room = read_stage(usd_scenes.path("room_area"))
    truth = ReferenceStore(
        room, WIDTH, HEIGHT, samples=96, seed=1, cache=tmp_path, launcher=launcher, quiet=True
    ).get(1)  # fmt: skip
    settings = {"bounces": 1, "vpls.frames": 64, "vpls.count": 128}
    errors = []
    for frames in (1, 12):
        shot = [pushed(room, step * (k + 1 - frames)) for k in range(frames)]
        relighter = Relighter(shot[0], method="instant-radiosity", width=WIDTH, height=HEIGHT, settings=settings)
        for scene in shot:
            relighter.set_scene(scene)
            layers = relighter.render(truth.before)
        errors.append(float(flip_ldr(truth.comp, layers.comp)[0]))
    assert errors[1] < 0.75 * errors[0], errors


def blended(launcher, scene, old_camera, values):
    """Values of the last frame's points, found again by the scene's camera, and over how many frames they are."""
    plan = make_plan(scene, make_settings(), "instant-radiosity", 64, 36)
    origin = np.asarray(plan.origin)
    uploaded = DeviceScene.upload(launcher, scene, origin, plan.scale)
    buffers, frames = [], [camera_frame(c, origin, plan.scale) for c in (old_camera, scene.camera)]
    for frame in frames:
        placed = replace(uploaded, camera=frame)
        buffers.append(render_gbuffer(launcher, placed, 64, 36, edge_samples=0, behind=False))
    first = Blender(launcher, None, buffers[0], "a", True, frames[0], 1000)
    first.irradiance(*(launcher.array(values(buffers[0].points), wp.vec3) for _ in range(2)))
    history = first.history()
    history.past.frames.fill_(99.0)
    after = [launcher.zeros(buffers[1].count, wp.vec3) for _ in range(2)]
    second = Blender(launcher, history, buffers[1], "b", True, frames[1], 1000)
    second.irradiance(*after)
    known = second.history().past.frames.numpy()
    points = buffers[1].points
    return points, after[0].numpy() * (known / np.maximum(known - 1, 1))[:, None], known


def test_values_are_found_at_the_same_place(launcher, room):
    """What is a linear function of the place keeps its value, to the curvature of the surfaces."""
    points, found, known = blended(launcher, pushed(room, 0.1), room.camera, lambda p: p.position.numpy())
    seen = (known > 1.5) & (points.role.numpy() >= 0)
    assert seen.mean() > 0.85
    gap = np.linalg.norm(found - points.position.numpy(), axis=-1)[seen] / points.footprint.numpy()[seen]
    assert np.median(gap) < 0.05
    assert gap.max() < 4.0


def test_roles_and_surfaces_do_not_mix(launcher, room):
    """Normals and roles that are carried along are those of the point: nothing comes from another surface."""

    def tag(p):
        return np.stack([p.role.numpy(), p.normal.numpy()[:, 1], p.normal.numpy()[:, 2]], -1).astype(np.float32)

    points, found, known = blended(launcher, pushed(room, 0.3), room.camera, tag)
    seen = (known > 1.5) & (points.role.numpy() >= 0)
    assert seen.mean() > 0.7
    assert (~seen[points.role.numpy() >= 0]).sum() > 20  # what was hidden or out of sight starts anew
    np.testing.assert_allclose(found[seen, 0], points.role.numpy()[seen], atol=1e-5)
    cosine = 1 - 0.5 * ((found[seen, 1:] - tag(points)[seen, 1:]) ** 2).sum(-1)
    assert cosine.min() > 0.85


def test_what_was_behind_the_camera_is_not_known(launcher, room):
    to_world = room.camera.to_world.copy()
    to_world[:3, [0, 2]] *= -1.0  # look the other way
    _, _, known = blended(launcher, room, replace(room.camera, to_world=to_world), lambda p: p.position.numpy())
    assert (known == 1).all()

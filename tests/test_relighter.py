"""Whole frames: what repeats bit for bit, what does not depend on the scene's size, what stays on the device."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct import usd_scenes
from warp_dvct.device_scene import DeviceScene
from warp_dvct.errors import DeviceError, OptionError
from warp_dvct.layers import Layers
from warp_dvct.methods import light_field
from warp_dvct.relighter import Relighter, relight
from warp_dvct.scene import Light, LightKind, LightRole, Material, Mesh, Role, Scene

FAST = {
    "volume.resolution": 48,
    "volume.coarse": 32,
    "rsm.texels": 96,
    "gather.rays": 16,
    "gather.object_rays": 16,
    "shadows.samples": 4,
    "glossy.rays": 2,
    "patches.count": 400,
    "patches.rays": 16,
    "bounces": 3,
}
SIZE = {"width": 48, "height": 32}
ARRAYS = [f.name for f in fields(Layers) if f.name not in ("holes", "clamped", "invalid")]
MATERIALS = [
    Material(base_color=(0.6, 0.6, 0.6), ior=1.0),
    Material(base_color=(0.7, 0.2, 0.1), ior=1.0),
    Material(base_color=(0.4, 0.5, 0.6), roughness=0.2),
]


def lamp(**more) -> Light:
    return Light(
        LightKind.RECT,
        **{
            "radiance": (9.0, 8.0, 7.0),
            "position": (0.5, 0.88, 0.5),
            "axis_x": (0.1, 0, 0),
            "axis_y": (0, 0, 0.1),
            "direction": (0, -1, 0),
            **more,
        },
    )


def room(*lights: Light, objects: tuple[Mesh, ...] | None = None) -> Scene:
    """A closed room with a red side, a shiny ball and a box in it."""
    walls = lit.room(0.4)
    colors = np.where(walls.mean(1)[:, 0] < 0.11, 1, 0).astype(np.int32)
    if objects is None:
        objects = (
            lit.mesh(lit.ball((0.62, 0.22, 0.42), 0.12), Role.SYNTHETIC, 2),
            lit.mesh(lit.cuboid((0.36, 0.2, 0.35), (0.08, 0.1, 0.08), 25.0), Role.SYNTHETIC),
        )
    camera = lit.look_at((0.5, 0.55, 0.86), (0.5, 0.35, 0.4), half=0.6, aspect=1.5)
    return lit.scene_of(
        replace(lit.mesh(walls), materials=colors),
        *objects,
        lights=lights or (lamp(),),
        materials=MATERIALS,
        camera=camera,
    )


def render(scene, plate=None, threads=2, **settings) -> Layers:
    return Relighter(scene, settings=FAST | settings, threads=threads, **SIZE).render(plate)


def assert_same_bytes(one: Layers, other: Layers) -> None:
    for name in ARRAYS:
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name


def random_plate(seed=0) -> np.ndarray:
    return np.random.default_rng(seed).lognormal(-1, 1, (32, 48, 3)).astype(np.float32)


def half(values) -> np.ndarray:
    return np.asarray(values, np.float32).astype(np.float16).astype(np.float32)


VARIANTS = {
    "rays": {},
    "cones": {"gather": "cones", "shadows": "cone", "glossy": "cones"},
    "paper": {"gather": "cones", "cones.delta": "split", "cones.filter": "isotropic", "cones.coverage": "product"},
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_same_bytes_for_any_number_of_threads_and_on_every_run(variant):
    sky = Light(LightKind.DOME, (0.3, 0.4, 0.5))
    scene = room(lamp(), sky)
    first = render(scene, threads=1, **VARIANTS[variant])
    assert first.delta.any()
    assert (first.mask_synthetic > 0).any()
    for threads in (2, 3):
        assert_same_bytes(first, render(scene, threads=threads, **VARIANTS[variant]))


def test_second_frame_of_a_relighter_equals_the_first():
    """Also after another picture in between, and the kept volumes equal fresh ones."""
    relighter = Relighter(room(), settings=FAST, **SIZE)
    first = relighter.render()
    with_plate = relighter.render(random_plate())
    assert_same_bytes(first, relighter.render())
    assert_same_bytes(with_plate, render(room(), random_plate()))


def test_seed_changes_noise_and_nothing_else():
    one, other = render(room()), render(room(), seed=5)
    assert np.abs(one.comp - other.comp).max() > 0
    assert np.abs(one.comp - other.comp).mean() < 0.1 * one.comp.mean()
    np.testing.assert_array_equal(one.depth, other.depth)


def moved(scene: Scene, factor: float, shift) -> Scene:
    """The scene scaled about the world's origin, then shifted; radiance stays, radiant intensity grows with area."""
    shift = np.asarray(shift, float)

    def place(p):
        return tuple(np.asarray(p, float) * factor + shift)

    lights = []
    for light in scene.lights:
        growth = factor**2 if light.kind == LightKind.POINT else 1.0
        lights.append(
            replace(
                light,
                radiance=tuple(np.array(light.radiance) * growth),
                position=place(light.position),
                axis_x=tuple(np.array(light.axis_x) * factor),
                axis_y=tuple(np.array(light.axis_y) * factor),
                radius=light.radius * factor,
            )
        )
    to_world = scene.camera.to_world.copy()
    to_world[:3, 3] = place(to_world[:3, 3])
    camera = replace(scene.camera, to_world=to_world)
    meshes = tuple(replace(m, points=m.points * factor + shift) for m in scene.meshes)
    return replace(scene, meshes=meshes, lights=tuple(lights), camera=camera)


LIGHTS = (
    lamp(),
    Light(LightKind.POINT, (0.05, 0.05, 0.05), position=(0.2, 0.7, 0.7)),
    Light(LightKind.SPHERE, (5.0, 4.0, 3.0), position=(0.8, 0.7, 0.7), radius=0.03),
    Light(LightKind.DOME, (0.3, 0.4, 0.5)),
)


@pytest.mark.parametrize(
    ("factor", "shift"),
    [(1e-3, (0, 0, 0)), (1e3, (0, 0, 0)), (1.0, (1e4, -1e4, 1e4)), (1e-3, (3.0, 4.0, 5.0))],
    ids=["mm", "km", "far", "mm aside"],
)
def test_picture_does_not_depend_on_size_and_place(factor, shift):
    """Same seeds, so only rounding differs: some texels fall into a neighbouring voxel. 98 % of values within 1 %."""
    scene = room(*LIGHTS)
    scene = moved(scene, 1.0, (-0.5, -0.5, -0.5))
    plain, other = render(scene), render(moved(scene, factor, shift))
    for name in ("comp", "plate", "rgba"):
        one, two = getattr(plain, name), getattr(other, name)
        close = np.abs(one - two) <= 0.01 * np.maximum(np.abs(one), 0.05)
        assert close.mean() > 0.98, name
        assert two.mean() == pytest.approx(one.mean(), rel=2e-3), name
    seen = np.isfinite(plain.depth)
    tolerance = 1e-4 * factor + 1e-6 * np.abs(shift).max()
    np.testing.assert_allclose(other.depth[seen], plain.depth[seen] * factor, rtol=1e-3)
    expected = plain.position * factor + np.array(shift)
    close = np.abs(other.position - expected).max(-1) < 10 * tolerance
    assert close[seen].mean() > 0.98


EMPTY = {
    "no object": (),
    "no triangles": (Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, np.int32), Role.SYNTHETIC),),
}


@pytest.mark.parametrize("name", EMPTY)
@pytest.mark.parametrize("variant", VARIANTS)
def test_without_objects_the_plate_comes_back_bit_for_bit(name, variant):
    plate = random_plate()
    out = render(room(*LIGHTS, objects=EMPTY[name]), plate, **VARIANTS[variant])
    np.testing.assert_array_equal(out.comp, half(plate))
    assert not out.rgba.any()
    assert not out.delta.any()
    assert (out.shadow == 1).all()
    own = render(room(*LIGHTS, objects=EMPTY[name]), None, **VARIANTS[variant])
    np.testing.assert_array_equal(own.comp, own.plate)
    assert own.plate.any()


def test_an_object_that_no_light_and_no_eye_meets_changes_nothing():
    """Sealed in a real box in the middle of the room: direct light alone, the plate is returned bit for bit; with
    indirect light only what shares voxels with it may change, by less than 1 %."""
    sealed = (lit.mesh(lit.cuboid((0.5, 0.2, 0.35), 0.08)), lit.mesh(lit.ball((0.5, 0.2, 0.35), 0.03), Role.SYNTHETIC))
    plate = np.full((32, 48, 3), 0.5, np.float32)
    out = render(room(objects=sealed), plate, bounces=0)
    np.testing.assert_array_equal(out.comp, plate)
    out = render(room(objects=sealed), plate, bounces=1)
    np.testing.assert_array_equal(out.comp, plate)
    out = render(room(objects=sealed), plate)
    assert np.abs(out.comp - plate).max() < 0.005


def test_an_invisible_object_of_a_stage(tmp_path):
    stage = tmp_path / "hidden.usda"
    stage.write_text(
        f"""#usda 1.0
(
    subLayers = [@{usd_scenes.path("room_area")}@]
)
over "World"
{{
    over "Synthetic"
    {{
        token visibility = "invisible"
    }}
}}
"""
    )
    plate = random_plate()
    relighter = Relighter(stage, settings=FAST, **SIZE)
    np.testing.assert_array_equal(relighter.render(plate).comp, half(plate))


@pytest.mark.parametrize("variant", VARIANTS)
def test_shadows_do_not_need_indirect_light(variant):
    """bounces=0: the ground under the objects darkens, by rays and by cones."""
    out = render(room(), bounces=0, **VARIANTS[variant])
    real = (out.mask_real == 1) & (out.plate.max(-1) > 0.05)
    assert out.shadow[real].min() < 0.2
    assert not out.added.any()


def test_added_light_only_adds():
    """On real surfaces nothing gets darker, objects or not."""
    scene = room(lamp(radiance=(1.0, 1.0, 1.0)), lamp(position=(0.3, 0.88, 0.5), role=LightRole.ADDED), objects=())
    out = render(scene)
    assert (out.delta >= -1e-6).all()
    assert out.added.mean() > 0.05
    assert (out.comp >= out.plate).all()
    assert (out.shadow == 1).all()


def test_rendered_plate_and_the_same_plate_given_agree():
    """By the same rays: on a plate some would be aimed."""
    own = render(room())
    again = render(room(), own.plate, **{"gather.aimed": 0})
    assert np.abs(again.comp - own.comp).max() < 0.02 * own.comp.max()
    np.testing.assert_allclose(again.delta, own.delta, atol=0.02 * own.plate.max())


class Spy:
    """Counts calls of a function that it stands for."""

    def __init__(self, monkeypatch, owner, name) -> None:
        self.calls = 0
        original = getattr(owner, name)

        def counted(*args, **more):
            self.calls += 1
            return original(*args, **more)

        monkeypatch.setattr(owner, name, staticmethod(counted) if isinstance(owner, type) else counted)


@pytest.fixture
def shot(tmp_path) -> Path:
    """The bundled room; the camera moves from 1 to 2, the ball as well from 2 to 3, and the light dims at 4."""
    stage = tmp_path / "shot.usda"
    stage.write_text(
        f"""#usda 1.0
(
    subLayers = [@{usd_scenes.path("room_area")}@]
)
over "World"
{{
    over "Camera"
    {{
        double3 xformOp:translate.timeSamples = {{ 1: (0, 1.25, 2.1), 2: (0.3, 1.25, 2.1), 3: (0.5, 1.25, 2.1) }}
    }}
    over "Light"
    {{
        float inputs:intensity.timeSamples = {{ 3: 13, 4: 6.5 }}
    }}
    over "Synthetic"
    {{
        over "Ball"
        {{
            double3 xformOp:translate.timeSamples = {{ 2: (0.5, 0.25, -0.1), 3: (-0.5, 0.25, 0.3) }}
        }}
    }}
}}
"""
    )
    return stage


def test_what_did_not_change_stays_on_the_device(shot, monkeypatch):
    uploads = Spy(monkeypatch, DeviceScene, "upload")
    volumes = Spy(monkeypatch, light_field, "light_volumes")
    relighter = Relighter(shot, settings=FAST, time=1, **SIZE)
    frames = {1: relighter.render()}
    assert (uploads.calls, volumes.calls) == (1, 1)
    relighter.set_time(2)
    frames[2] = relighter.render()
    assert (uploads.calls, volumes.calls) == (1, 1), "only the camera moved"
    relighter.render(random_plate())
    assert (uploads.calls, volumes.calls) == (1, 1), "a plate is no reason either"
    relighter.set_time(3)
    frames[3] = relighter.render()
    assert (uploads.calls, volumes.calls) == (2, 2), "the ball moved"
    relighter.set_time(4)
    frames[4] = relighter.render()
    assert (uploads.calls, volumes.calls) == (3, 3), "the light changed"
    for time, frame in frames.items():
        assert_same_bytes(frame, Relighter(shot, settings=FAST, time=time, **SIZE).render())
    assert np.abs(frames[1].comp - frames[2].comp).max() > 0.05
    assert frames[4].plate.mean() == pytest.approx(0.5 * frames[3].plate.mean(), rel=0.02)


def slid(mesh: Mesh, offset) -> Mesh:
    return replace(mesh, points=mesh.points + np.asarray(offset, float))


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_frame_of_a_shot_equals_the_same_frame_alone(variant):
    """Whatever moved before, and whatever was kept: objects, real things, lights, camera, plate or none."""
    start = room(lamp(), Light(LightKind.DOME, (0.2, 0.3, 0.4)))
    walls, ball, box = start.meshes
    crate = lit.mesh(lit.cuboid((0.7, 0.2, 0.6), 0.06, 10.0))
    start = replace(start, meshes=(walls, crate, ball, box))
    nearer = lit.look_at((0.45, 0.5, 0.8), (0.5, 0.3, 0.4), half=0.6, aspect=1.5)
    shot = [
        start,
        replace(start, meshes=(walls, crate, slid(ball, (0.02, 0.01, 0.0)), box)),
        replace(start, meshes=(walls, crate, slid(ball, (-0.2, 0.2, 0.1)), box)),
        replace(start, meshes=(walls, slid(crate, (0.0, 0.1, 0.05)), ball, box)),
        replace(start, meshes=(walls, slid(crate, (0.0, 0.1, 0.05)), ball)),
        replace(start, meshes=(walls, crate, ball, box), lights=(lamp(position=(0.4, 0.88, 0.5)), start.lights[1])),
        replace(start, camera=nearer),
        replace(start, materials=(MATERIALS[1], *MATERIALS[1:])),
        replace(start, meshes=(walls, crate)),
        start,
    ]
    relighter = Relighter(start, settings=FAST | VARIANTS[variant], **SIZE)
    for frame, scene in enumerate(shot):
        plate = random_plate() if frame % 3 == 1 else None
        relighter._stage = scene
        relighter.set_time(None)
        assert_same_bytes(relighter.render(plate), render(scene, plate, **VARIANTS[variant]))


def test_stats_and_progress():
    relighter = Relighter(room(), settings=FAST, **SIZE)
    calls = []
    relighter.render(progress=lambda name, share: calls.append((name, share)))
    stats = relighter.stats
    assert set(stats) >= {
        "load_seconds", "compile_seconds", "render_seconds", "passes", "peak_bytes", "plan", "notices"
    }  # fmt: skip
    assert stats["render_seconds"] > 0
    assert stats["peak_bytes"] > 1e6
    assert {"voxelize", "rsm", "inject", "gbuffer", "direct", "gather", "resolve", "composite"} <= set(stats["passes"])
    assert sum(stats["passes"].values()) <= stats["render_seconds"] * 2
    shares = [share for _, share in calls]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    relighter.render()
    assert "voxelize" not in relighter.stats["passes"], "the second frame's times are its own"


def test_path_tracing_through_the_relighter_agrees_with_delta_cones():
    """Mean of the composite within 12 % at one bounce, on a tiny picture."""
    truth = Relighter(room(), method="path-trace", settings={"samples": 64, "bounces": 1}, **SIZE).render()
    out = render(room(), bounces=1, **{"gather.rays": 64, "gather.object_rays": 64, "volume.resolution": 96})
    for name in ("comp", "plate"):
        np.testing.assert_allclose(
            getattr(out, name).mean((0, 1)), getattr(truth, name).mean((0, 1)), rtol=0.12, err_msg=name
        )
    np.testing.assert_allclose(out.mask_synthetic.mean(), truth.mask_synthetic.mean(), rtol=0.05)
    centers = np.isfinite(truth.depth)
    np.testing.assert_allclose(out.depth[centers], truth.depth[centers], rtol=1e-4)


@pytest.mark.parametrize(
    ("plate", "message"),
    [
        (np.zeros((48, 32, 3), np.float32), r"\(48, 32, 3\); the picture needs \(32, 48, 3\)"),
        (np.zeros((32, 48), np.float32), r"\(32, 48\); the picture needs"),
        (np.zeros((32, 48, 4), np.float32), r"\(32, 48, 4\); the picture needs"),
    ],
)
def test_plates_of_another_shape_name_both(plate, message):
    with pytest.raises(OptionError, match=message):
        Relighter(room(), settings=FAST, **SIZE).render(plate)


def test_unsuitable_arguments_are_named():
    with pytest.raises(OptionError, match="method is 'magic'; choose one of delta-cones"):
        Relighter(room(), method="magic")
    with pytest.raises(OptionError, match=r"did you mean 'gather\.rays'"):
        Relighter(room(), settings={"gather.ray": 3})
    with pytest.raises(OptionError, match="0 x"):
        Relighter(room(), width=0)
    with pytest.raises(OptionError, match="threads is 0"):
        Relighter(room(), threads=0)
    with pytest.raises(DeviceError, match="'cuda:99' is not present; present: cpu"):
        Relighter(room(), device="cuda:99")


@pytest.mark.parametrize(
    ("size", "expected"), [({"width": 60}, (60, 40)), ({"height": 40}, (60, 40)), ({}, (960, 640))]
)
def test_missing_sizes_follow_the_camera(size, expected):
    relighter = Relighter(room(), **size)
    assert (relighter.width, relighter.height) == expected


def test_relight_is_one_call():
    out = relight(room(), settings=FAST, **SIZE)
    assert out.comp.shape == (32, 48, 3)
    assert out.comp.dtype == np.float32
    assert (out.clamped, out.invalid) == (0, 0)

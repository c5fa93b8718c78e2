"""The plan: volumes, map sizes, what is left out and why."""

from __future__ import annotations

import json
from dataclasses import replace

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct import plan as planning
from warp_dvct.passes.voxels import Box
from warp_dvct.plan import make_plan
from warp_dvct.scene import Light, LightKind, LightRole, Material, Role
from warp_dvct.settings import make_settings

SHINY = Material(base_color=(0.5, 0.5, 0.5), roughness=0.1)


def light(kind=LightKind.POINT, **more) -> Light:
    return Light(
        kind,
        (1.0, 1.0, 1.0),
        path=f"/World/{kind.name}",
        **{"position": (0.5, 0.8, 0.5), "direction": (0, -1, 0), **more},
    )


def room(*lights, inserted=True, material=lit.GREY, half=0.1):
    parts = [lit.mesh(lit.room(0.45))]
    if inserted:
        parts.append(lit.mesh(lit.cuboid((0.5, 0.3, 0.5), half), Role.SYNTHETIC))
    return lit.scene_of(*parts, lights=lights or (light(),), materials=(material,))


def plan_of(scene, quality="balanced", has_plate=False, method="delta-cones", **overrides):
    settings = make_settings(quality, {k.replace("__", "."): v for k, v in overrides.items()})
    return make_plan(scene, settings, method, 64, 48, has_plate=has_plate)


def needed(plan) -> dict[str, bool]:
    return {p.name: p.needed for p in plan.passes}


def why(plan, name) -> str:
    return next(p.why for p in plan.passes if p.name == name)


def test_fine_volume_is_a_cube_around_the_objects():
    """About twice their largest edge by default, near their middle; the coarse one holds the scene."""
    plan = plan_of(room(half=(0.1, 0.05, 0.02)))
    edge = 1 / plan.scale
    assert edge == pytest.approx(0.4, rel=0.0906), "steps of a quarter of an octave"
    middle = np.array(plan.origin) + (np.array(plan.fine.low) + 0.5) * edge
    np.testing.assert_allclose(middle, [0.5, 0.3, 0.5], atol=edge / 16)
    assert (plan.fine.edge, plan.fine.n) == (1.0, 64)
    np.testing.assert_allclose(plan.origin, 0.5, atol=1e-12, err_msg="the middle of the room")
    assert plan.coarse is not None
    corners = (np.array([[0.05] * 3, [0.95] * 3]) - plan.origin) * plan.scale
    low = np.array(plan.coarse.low)
    assert (corners[0] > low).all()
    assert (corners[1] < low + plan.coarse.edge).all()
    wider = plan_of(room(half=(0.1, 0.05, 0.02)), volume__scale=3, volume__resolution=100)
    assert 1 / wider.scale == pytest.approx(0.6, rel=0.0906)
    assert wider.fine.n == 100


def test_no_coarse_volume_where_the_fine_one_holds_all():
    assert plan_of(room(), volume__scale=10).coarse is None
    assert plan_of(room(), volume__coarse=0).coarse is None
    assert plan_of(room(inserted=False)).coarse is None


def test_coarse_volume_is_cut_to_its_reach():
    ground = lit.mesh(lit.rectangle((0.5, 0, 0.5), (0, 0, 1000), (1000, 0, 0)))
    scene = lit.scene_of(ground, lit.mesh(lit.cuboid((0.5, 0.3, 0.5), 0.1), Role.SYNTHETIC), lights=(light(),))
    plan = plan_of(scene, volume__reach=16)
    assert plan.coarse.edge == pytest.approx(16, rel=0.03)


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
def test_plan_does_not_depend_on_the_scenes_size(factor):
    scene = room(light(LightKind.RECT, axis_x=(0.1, 0, 0), axis_y=(0, 0, 0.1)))
    meshes = tuple(replace(m, points=m.points * factor) for m in scene.meshes)
    lamp = scene.lights[0]
    lamp = replace(lamp, **{k: tuple(np.array(getattr(lamp, k)) * factor) for k in ("position", "axis_x", "axis_y")})
    plan, other = plan_of(scene), plan_of(replace(scene, meshes=meshes, lights=(lamp,)))
    assert other.scale * factor == pytest.approx(plan.scale)
    assert other.maps == plan.maps
    assert needed(other) == needed(plan)
    np.testing.assert_allclose(other.coarse.low, plan.coarse.low)


def test_specular_pass_is_left_out_without_gloss():
    plan = plan_of(room())
    assert not needed(plan)["specular"]
    assert "no material" in why(plan, "specular")
    assert plan.alpha_max == -1
    shiny = plan_of(room(material=SHINY))
    assert needed(shiny)["specular"]
    assert shiny.alpha_max > 0
    assert not needed(plan_of(room(material=SHINY), glossy__roughness=0.05))["specular"]
    unused = replace(room(), materials=(lit.GREY, SHINY))
    assert not needed(plan_of(unused))["specular"], "a material that nothing uses does not count"
    assert needed(plan_of(room(material=replace(lit.GREY, metallic=1.0, roughness=0.2))))["specular"]
    black = replace(SHINY, specular_color=(0.0, 0.0, 0.0))
    assert not needed(plan_of(room(material=black)))["specular"]


def test_what_bounces_need():
    names = ["voxelize", "rsm /World/POINT", "bounces", "gather"]
    many, one, none = (needed(plan_of(room(), bounces=k)) for k in (4, 1, 0))
    assert [many[n] for n in names] == [True, True, True, True]
    assert [one[n] for n in names] == [True, True, False, True]
    assert [none[n] for n in names] == [False, False, False, False]
    assert needed(plan_of(room(light(LightKind.DOME)), bounces=0))["gather"], "a dome is gathered"


def test_pyramid_is_for_cones():
    assert not needed(plan_of(room()))["pyramid"]
    assert "no cones" in why(plan_of(room()), "pyramid")
    for overrides in ({"gather": "cones"}, {"shadows": "cone"}, {"shadows": "cone", "bounces": 0}):
        plan = plan_of(room(), **overrides)
        assert needed(plan)["pyramid"], overrides
        assert needed(plan)["voxelize"], overrides
    shiny = plan_of(room(material=SHINY), glossy="cones", bounces=0)
    assert needed(shiny)["pyramid"]


def test_nothing_changes_without_objects_and_added_lights():
    plan = plan_of(room(inserted=False), has_plate=True)
    assert not plan.changes
    assert {n for n, on in needed(plan).items() if on} == {"gbuffer", "composite"}
    assert "the plate stays as it is" in why(plan, "direct")
    rendered = plan_of(room(inserted=False), has_plate=False)
    assert not rendered.changes
    assert needed(rendered)["direct"]
    assert needed(rendered)["gather"]
    assert needed(rendered)["before"]
    assert plan_of(room(light(role=LightRole.ADDED), inserted=False), has_plate=True).changes


def test_before_is_rendered_only_without_a_plate():
    assert needed(plan_of(room()))["before"]
    assert not needed(plan_of(room(), has_plate=True))["before"]


PAIRS = {
    "point": (light(), True),
    "spot at it": (light(cone_angle=0.4), True),
    "spot away": (light(cone_angle=0.4, direction=(0, 1, 0)), False),
    "spot beside": (light(cone_angle=0.2, position=(0.1, 0.8, 0.5)), False),
    "spot that grazes": (light(cone_angle=0.7, position=(0.1, 0.8, 0.5)), True),
    "rect above, down": (light(LightKind.RECT, axis_x=(0.1, 0, 0), axis_y=(0, 0, 0.1)), True),
    "rect that faces away": (light(LightKind.RECT, axis_x=(0.1, 0, 0), axis_y=(0, 0, 0.1), direction=(0, 1, 0)), False),
    "sphere": (light(LightKind.SPHERE, radius=0.05), True),
    "sun": (light(LightKind.DISTANT), True),
    "dome": (light(LightKind.DOME), True),
}


@pytest.mark.parametrize("name", PAIRS)
def test_a_pair_of_maps_only_where_an_object_stands_in_the_light(name):
    source, pair = PAIRS[name]
    plan = plan_of(room(source))
    assert plan.maps[0].pair is pair
    assert ("no synthetic object in its light" in why(plan, f"rsm {source.path}")) is not pair
    assert plan_of(room(source, inserted=False)).maps[0].pair is False


@pytest.mark.parametrize(
    ("source", "shape"),
    [
        (light(position=(0.45, 0.35, 0.5)), "sphere"),
        (light(position=(0.5, 3.0, 0.5)), "cap"),
        (light(cone_angle=0.3), "perspective"),
        (light(cone_angle=0.3, position=(0.5, 9.0, 0.5)), "cap"),
        (light(LightKind.SPHERE, radius=0.05, position=(0.5, 2.0, 0.5)), "cap"),
        (light(LightKind.RECT, axis_x=(0.1, 0, 0), axis_y=(0, 0, 0.1)), "hemisphere"),
        (light(LightKind.RECT, axis_x=(0.1, 0, 0), axis_y=(0, 0, 0.1), position=(0.5, 5.0, 0.5)), "cap"),
        (light(LightKind.DISTANT), "orthographic"),
        (light(LightKind.DOME), "orthographic"),
    ],
    ids=["near point", "far point", "spot", "far spot", "sphere", "rect", "far rect", "sun", "dome"],
)
def test_texels_are_no_larger_than_voxels(source, shape):
    """At the fine volume's far side, for a surface that faces the light; and at most 2.5 times finer than needed."""
    plan = plan_of(room(source), rsm__texels=8192, volume__resolution=64)
    entry = plan.maps[0]
    assert not entry.limited
    assert entry.shape == shape
    edge = 1 / plan.scale
    center, radius = np.array(plan.origin) + (np.array(plan.fine.low) + 0.5) * edge, edge * np.sqrt(3) / 2
    voxel = edge / 64
    if entry.shape == "orthographic":
        texel = np.pi * radius**2 / entry.size**2
    else:
        distance = np.linalg.norm(np.array(source.position) - center)
        bound = radius + source.radius + np.linalg.norm(source.axis_x) + np.linalg.norm(source.axis_y)
        cap = 2 if distance <= bound else 1 - np.sqrt(1 - (bound / distance) ** 2)
        spread = {
            "sphere": 4 * np.pi,
            "cap": 2 * np.pi * cap,
            "perspective": 2 * np.pi * (1 - np.cos(source.cone_angle)),
            "hemisphere": np.pi,
        }[entry.shape]
        texel = spread / entry.size**2 * (distance + radius) ** 2
    assert texel <= voxel**2 * 1.001
    assert entry.size <= 16 or texel > voxel**2 / 2.5**2
    limited = plan_of(room(source), rsm__texels=20, volume__resolution=256).maps[0]
    assert limited.limited
    assert limited.size == 20


def test_describe_names_every_pass():
    plan = plan_of(room(light(), light(LightKind.DOME), material=SHINY))
    text = plan.describe()
    for entry in plan.passes:
        line = next(x for x in text.splitlines() if x.strip().startswith(entry.name))
        assert ("left out" in line) is not entry.needed
        assert entry.why in line
        assert ("MiB" in line) is entry.needed
    assert "64^3" in text
    assert "64 x 48 pixels" in text


@pytest.mark.parametrize("method", ["delta-cones", "path-trace", "instant-radiosity"])
def test_plan_is_json(method):
    plan = plan_of(room(light(), light(LightKind.DOME)), method=method)
    again = json.loads(json.dumps(plan.to_dict(), allow_nan=False))
    assert again["method"] == method
    assert [p["name"] for p in again["passes"]] == [p.name for p in plan.passes]
    assert again["settings"]["volume_resolution"] == 64


@pytest.mark.parametrize("n", [64, 200])
def test_memory_of_the_volume_is_about_right(launcher, n):
    """Within a factor of two of what voxelisation keeps."""
    scene = room(half=0.15)
    plan = plan_of(scene, volume__resolution=n, volume__scale=10)
    from warp_dvct.device_scene import DeviceScene

    device_scene = DeviceScene.upload(launcher, scene, np.array(plan.origin), plan.scale)
    volume = lit.voxels_of(launcher, device_scene, n, plan.fine.low).volume
    held = volume.field.capacity + volume.cells.capacity + volume.tables.capacity
    said = next(p.bytes for p in plan.passes if p.name == "voxelize")
    assert 0.5 < said / held < 2


def test_a_scene_of_one_point_has_a_volume():
    """Degenerate extents do not divide by zero."""
    dot = lit.mesh(np.full((1, 3, 3), 0.5), Role.SYNTHETIC)
    plan = plan_of(lit.scene_of(dot, lights=(light(),)))
    assert np.isfinite(plan.scale)
    plan = plan_of(lit.scene_of(lights=(light(),)))
    assert np.isfinite(plan.scale)


def test_cones_under_a_dome_need_the_volume_without_bounces():
    plan = plan_of(room(light(LightKind.DOME)), bounces=0, gather="cones")
    assert needed(plan)["voxelize"]
    assert needed(plan)["pyramid"]
    assert not needed(plan_of(room(light(LightKind.DOME)), bounces=0))["voxelize"], "rays need none"


def test_surface_inside_of_boxes_is_that_of_a_loop(monkeypatch):
    """Random triangles in several blocks, against a sum triangle by triangle; bounds leave unused points out."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 2, (40, 1, 3)) + rng.uniform(-0.2, 0.2, (40, 3, 3))
    points[34:] *= 50.0  # so large that the border bounds what they count for
    points[:10] = rng.uniform(0.2, 0.8, (10, 3, 3))  # a block of its own, inside of both boxes
    unused = np.full((1, 3), 99.0)
    triangles = np.arange(120, dtype=np.int32).reshape(40, 3)
    mesh = replace(room().meshes[0], points=np.concatenate([points.reshape(-1, 3), unused]), triangles=triangles)
    scene = replace(room(), meshes=(mesh,), point_clouds=())
    np.testing.assert_array_equal(scene.bounds(), (points.reshape(-1, 3).min(0), points.reshape(-1, 3).max(0)))
    origin, scale = np.array([-0.1, 0.0, 0.1]), 0.9
    boxes = Box((0.0, 0.0, 0.0), 1.0, 8), Box((-0.5, -0.4, -0.3), 1.8, 8)
    monkeypatch.setattr(planning, "TRIANGLES_AT_ONCE", 10)
    found = planning.surface_areas(scene, boxes, scale, origin)
    for box, area in zip(boxes, found, strict=True):
        low, high = np.array(box.low), np.array(box.low) + box.edge
        whole, cut, crossing = 0.0, 0.0, 0
        for corners in (points - origin) * scale:
            size = 0.5 * np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
            if np.all((corners.mean(0) >= low) & (corners.mean(0) <= high)):
                whole += size
            elif np.all(corners.min(0) <= high) and np.all(corners.max(0) >= low):
                cut, crossing = cut + size, crossing + 1
        assert crossing > 0
        assert area == pytest.approx(whole + min(cut, 2.0 * box.edge**2 * crossing))

"""Differential instant radiosity against the path tracer, closed forms and itself."""

from __future__ import annotations

from dataclasses import replace

import lit_scenes as lit
import numpy as np
import pytest

from warp_dvct import usd_scenes
from warp_dvct.bench.instant_radiosity import agreement
from warp_dvct.device_scene import DeviceScene, camera_frame
from warp_dvct.errors import DeviceError
from warp_dvct.methods.instant_radiosity import first_vpls, lit_region, make_vpls
from warp_dvct.methods.path_tracing import gather_irradiance_reference
from warp_dvct.passes import vpl_memory
from warp_dvct.passes.gbuffer import render_gbuffer
from warp_dvct.passes.ism import draw_isms, new_isms, ray_sight
from warp_dvct.passes.point_cloud import sample_surfaces
from warp_dvct.passes.vpl_shading import VplLight, compare_sight, light_picture
from warp_dvct.passes.vpls import LUMINANCE, light_maps, share_out
from warp_dvct.plan import make_plan
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Camera, Light, LightKind, LightRole, Material, Mesh, PointCloud, Role, Scene
from warp_dvct.settings import make_settings
from warp_dvct.usd.read import read_stage

GREY, RED = (
    Material(specular_color=(0, 0, 0), base_color=(0.6, 0.6, 0.6)),
    Material(specular_color=(0, 0, 0), base_color=(0.7, 0.2, 0.1)),
)


def quad(corner, u, v, role, material=0, path="/Quad"):
    corner, u, v = (np.asarray(x, float) for x in (corner, u, v))
    points = np.stack([corner, corner + u, corner + u + v, corner + v])
    return Mesh(points, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.full(2, material, np.int32), role, path=path)


def looking_down(height=4.0):
    to_world = np.eye(4)
    to_world[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    to_world[:3, 3] = (0, height, 0)
    return Camera(to_world, -0.5, 0.5, -0.5, 0.5)


def scene_of(*lights, card=True):
    """A floor and a wall, both real; a synthetic card that stands on the floor. Lights come from above."""
    meshes = [
        quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), Role.REAL, path="/Floor"),
        quad((-2, 0, -2), (4, 0, 0), (0, 2, 0), Role.REAL, 1, path="/Wall"),
    ]
    if card:
        meshes.append(quad((0.2, 0, 0.3), (0.6, 0, 0.3), (0, 0.7, 0), Role.SYNTHETIC, 1, path="/Card"))
        meshes[-1] = replace(meshes[-1], double_sided=True)
    return Scene(tuple(meshes), (GREY, RED), (), tuple(lights), looking_down())


def down(kind, **more):
    return Light(kind, (5.0, 4.0, 3.0), position=(0.3, 3.0, 0.5), direction=(0.0, -1.0, 0.0), path="/Light", **more)


LIGHTS = {
    "point": down(LightKind.POINT),
    "sphere": down(LightKind.SPHERE, radius=0.2),
    "spot": down(LightKind.SPHERE, radius=0.05, cone_angle=0.5, cone_softness=0.3),
    "rect": down(LightKind.RECT, axis_x=(0.5, 0, 0), axis_y=(0, 0, 0.3)),
    "disk": down(LightKind.DISK, axis_x=(0.4, 0, 0), axis_y=(0, 0, 0.4)),
    "distant": Light(LightKind.DISTANT, (3.0, 3.0, 2.0), direction=(0.3, -0.9, -0.316), angle=0.01, path="/Light"),
    "dome": Light(LightKind.DOME, (1.0, 0.9, 0.8), path="/Light"),
}


class Setup:
    """A scene on the device, its plan and its shading points."""

    def __init__(self, launcher, scene, width=24, height=24, **settings):
        values = make_settings("balanced", {"bounces": 1, **{k.replace("__", "."): v for k, v in settings.items()}})
        self.launcher, self.scene = launcher, scene
        self.plan = make_plan(scene, values, "instant-radiosity", width, height)
        origin = np.asarray(self.plan.origin)
        self.device_scene = replace(
            DeviceScene.upload(launcher, scene, origin, self.plan.scale),
            camera=camera_frame(scene.camera, origin, self.plan.scale),
        )
        self.region = lit_region(scene, self.device_scene, self.plan)
        self.buffer = render_gbuffer(launcher, self.device_scene, width, height, edge_samples=0, behind=False)

    def lights(self, **settings):
        """The VPLs under changed settings."""
        values = {k.replace("__", "_"): v for k, v in settings.items()}
        return make_vpls(
            self.launcher,
            self.scene,
            self.device_scene,
            replace(self.plan, settings=replace(self.plan.settings, **values)),
        )

    def irradiance(self, lights, tiles=1):
        """Before and after at every pixel."""
        light = VplLight(self.device_scene, lights.vpls, lights.sight, tiles, with_before=True)
        return [a.numpy() for a in light_picture(self.launcher, self.buffer, light)]


def bundled(launcher, name, width=32, **settings):
    scene = read_stage(usd_scenes.path(name))
    return Setup(launcher, scene, width, max(1, round(width / scene.camera.aspect)), **settings)


@pytest.mark.parametrize("kind", LIGHTS)
@pytest.mark.parametrize("added", [False, True])
def test_flux_of_the_vpls_is_that_of_the_maps(launcher, kind, added):
    light = replace(LIGHTS[kind], role=LightRole.ADDED if added else LightRole.PLATE)
    setup = Setup(launcher, scene_of(light))
    maps = light_maps(
        launcher, setup.device_scene, 0, added=added, size=256, region=setup.region, focus=0.7, least=0.15,
        single=False, seed=0,
    )  # fmt: skip
    vpls = setup.lights(vpls_count=4096, vpls_map=256, visibility="ray").vpls
    surface = vpls.kind.numpy()[: vpls.count] == 0
    flux = vpls.flux.numpy()[: vpls.count][surface].sum(0, dtype=np.float64)
    assert maps.flux > 0
    assert flux @ LUMINANCE == pytest.approx(maps.flux, rel=0.01)
    real, hidden = (a.numpy()[: vpls.count][surface] for a in (vpls.real, vpls.hidden))
    assert real.any() != added
    assert hidden.any() != added
    assert (real[hidden == 1] == 1).all()


def test_the_flux_of_a_rect_light_is_the_light_s_times_albedo(launcher):
    """Above a floor that catches nearly all of it: pi A L, times the floor's albedo."""
    light = down(LightKind.RECT, axis_x=(0.1, 0, 0), axis_y=(0, 0, 0.1))
    light = replace(light, position=(0.0, 0.02, 0.0))
    scene = scene_of(light, card=False)
    scene = replace(scene, meshes=(*scene.meshes[:1], quad((1.4, 0, 1.8), (0.5, 0, 0), (0, 0.5, 0), Role.SYNTHETIC)))
    setup = Setup(launcher, scene)
    vpls = setup.lights(vpls_count=2048, visibility="ray").vpls
    expected = np.pi * 0.04 * np.array(light.radiance) * 0.6
    flux = vpls.flux.numpy()[: vpls.count].sum(0, dtype=np.float64) / setup.plan.scale**2
    np.testing.assert_allclose(flux, expected, rtol=0.01)


def test_error_falls_with_the_number_of_vpls(launcher):
    """Ray visibility, clamping off: N^-1/2 or faster towards the path tracer's one-bounce light, before and after."""
    setup = bundled(launcher, "room_area", width=16, visibility="ray", vpls__clamp=0.0)
    role = setup.buffer.points.role.numpy()
    position, normal = setup.buffer.points.position.numpy(), setup.buffer.points.normal.numpy()
    truth = gather_irradiance_reference(
        launcher, setup.device_scene, setup.scene, position, normal, samples=8192, bounces=1, seed=5
    )
    counts, errors = (64, 256, 1024, 4096), {"before": [], "after": []}
    for count in counts:
        squares = {"before": 0.0, "after": 0.0}
        seeds = 16 if count < 1000 else 6
        for seed in range(seeds):
            pair = setup.irradiance(setup.lights(vpls_count=count, vpls_map=512, seed=seed))
            for name, ours, true in zip(squares, pair, truth, strict=True):
                squares[name] = squares[name] + ((ours - true) ** 2).sum(-1) / seeds
        for name, square in squares.items():
            # The median pixel: without clamping some next to a corner need far more seeds for their mean to settle.
            chosen = role == Role.REAL if name == "before" else role >= 0
            errors[name].append(float(np.sqrt(np.median(square[chosen]))) / float(truth[0].mean()))
    for name, series in errors.items():
        slope = np.polyfit(np.log(counts), np.log(series), 1)[0]
        assert slope < -0.45, (name, series)  # -0.5, but for the noise of the fit
        assert series[-1] < 0.08, (name, series)


def test_clamping_darkens_less_with_more_vpls(launcher):
    setup = bundled(launcher, "room_area", width=32, visibility="ray")
    bias = []
    for count in (64, 1024):
        free, clamped = (
            setup.irradiance(setup.lights(vpls_count=count, vpls_clamp=clamp, vpls_map=512))[1] for clamp in (0.0, 1.0)
        )
        assert (clamped <= free * (1 + 1e-5) + 1e-6).all()
        bias.append(1.0 - clamped.mean() / free.mean())
    assert 0.0 < bias[1] < 0.6 * bias[0] < 0.2


@pytest.mark.parametrize("stage", ["room_area", "ground_dome"])
def test_shadow_maps_agree_with_rays(launcher, stage):
    rows = agreement(
        read_stage(usd_scenes.path(stage)), (128, 512, 1024, 4096), settings={}, launcher=launcher, width=40
    )
    shares = [row.agreement.agree for row in rows]
    assert shares[2] >= 0.95
    assert shares == sorted(shares)
    assert rows[0].agreement.pairs > 20_000


def test_a_constant_dome_lights_open_ground_evenly(launcher):
    setup = Setup(launcher, scene_of(LIGHTS["dome"]), bounces=0, vpls__sky=1024, visibility="ray")
    lights = setup.lights()
    assert lights.ends == (1024,)
    floor = replace(setup.scene, meshes=setup.scene.meshes[:1])
    open_ground = Setup(launcher, floor, bounces=0)
    light = VplLight(open_ground.device_scene, lights.vpls, lights.sight, 1, with_before=True)
    before, after = (a.numpy() for a in light_picture(launcher, open_ground.buffer, light))
    real = open_ground.buffer.points.role.numpy() == Role.REAL
    np.testing.assert_allclose(before[real], np.pi * np.array([[1.0, 0.9, 0.8]]).repeat(real.sum(), 0), rtol=0.01)
    np.testing.assert_array_equal(before, after)


def test_no_sky_comes_through_the_walls_of_a_closed_room():
    """Maps of the sky had holes, and showed the surroundings of the objects alone: added domes lit whole rooms."""
    walls = lit.mesh(lit.room(0.4))
    crate = lit.mesh(lit.cuboid((0.5, 0.2, 0.5), 0.05), Role.SYNTHETIC)
    camera = lit.look_at((0.5, 0.5, 0.85), (0.5, 0.3, 0.5))
    for role in LightRole:
        scene = lit.scene_of(walls, crate, lights=(Light(LightKind.DOME, (1.0, 1.0, 1.0), role=role),), camera=camera)
        layers = Relighter(scene, method="instant-radiosity", width=24, height=24, settings={"bounces": 2}).render()
        assert layers.mask_synthetic.any()
        assert layers.comp.max() < 1e-3


def test_a_sky_texture_lights_as_its_own_integral(launcher):
    texture = np.exp(np.random.default_rng(1).standard_normal((24, 48, 3))).astype(np.float32)
    texture[3, 7] = 300.0  # a sun
    dome = Light(LightKind.DOME, (1.0, 1.0, 1.0), texture=texture, path="/Sky")
    setup = Setup(launcher, scene_of(dome), bounces=0)
    vpls = setup.lights(vpls_sky=4096, visibility="ray").vpls
    up = np.clip(vpls.normal.numpy()[:, 1:2], 0, None)
    # The environment map has sizes of powers of two; integrate what the VPLs were drawn from.
    env = setup.lights(vpls_sky=16, visibility="ray").env
    texels = env.before.numpy()[: env.width * env.height].reshape(env.height, env.width, 3).astype(np.float64)
    edges = np.cos(np.linspace(0, np.pi, env.height + 1))
    weight = np.clip(edges[:-1], 0, None) ** 2 - np.clip(edges[1:], 0, None) ** 2
    expected = (texels * weight[:, None, None]).sum((0, 1)) * np.pi / env.width
    np.testing.assert_allclose((vpls.flux.numpy() * up).sum(0), expected, rtol=0.01)


def test_merged_tiles_agree_with_all_vpls(launcher):
    setup = bundled(launcher, "room_spot", width=96, visibility="ray")
    lights = setup.lights(vpls_count=256)
    whole, merged = setup.irradiance(lights)[1], setup.irradiance(lights, tiles=4)[1]
    assert merged.mean() == pytest.approx(whole.mean(), rel=0.02)
    assert np.abs(merged - whole).mean() < 0.08 * whole.mean()


def test_three_bounces_carry_the_right_light(launcher):
    setup = bundled(launcher, "room_area", width=16, bounces=3)
    points = setup.buffer.points
    truth = gather_irradiance_reference(
        launcher,
        setup.device_scene,
        setup.scene,
        points.position.numpy(),
        points.normal.numpy(),
        samples=1024,
        bounces=3,
    )
    real = points.role.numpy() == Role.REAL
    for visibility, slots, clamp, tolerance in (
        ("ray", "drawn", 0.0, 0.06),
        ("ism", "drawn", 0.5, 0.15),
        ("ray", "strongest", 0.5, 0.15),
    ):
        lights = setup.lights(
            vpls_count=1024, vpls_further=512, visibility=visibility, vpls_slots=slots, vpls_clamp=clamp
        )
        before, after = setup.irradiance(lights)
        assert before[real].mean() == pytest.approx(truth[0][real].mean(), rel=tolerance)
        assert after.mean() == pytest.approx(truth[1].mean(), rel=tolerance)
        single = setup.irradiance(replace(lights, vpls=first_vpls(lights.vpls, lights.ends[1])))[1]
        assert single.mean() < 0.75 * after.mean()


def test_flags_of_further_bounces(launcher):
    """(9), (10): light that met something synthetic stays out of the picture before; VPL3's light stays in it alone."""
    setup = bundled(launcher, "room_spot", width=16, bounces=3)
    lights = setup.lights()
    vpls, last = lights.vpls, lights.ends[1]
    real, hidden = (a.numpy()[last : vpls.count] for a in (vpls.real, vpls.hidden))
    assert {(1, 0), (0, 0), (1, 1)} == set(zip(real.tolist(), hidden.tolist(), strict=True))
    low, high = ((b - setup.device_scene.origin) * setup.plan.scale for b in setup.scene.bounds(Role.SYNTHETIC))
    position = vpls.position.numpy()[last : vpls.count]
    inside = ((position > low - 1e-3) & (position < high + 1e-3)).all(-1)
    assert (inside[real == 1]).mean() < 0.05  # real surfaces between the objects may lie inside of their bounds


def test_before_is_that_of_the_scene_without_the_objects(launcher):
    """VPL3 and the shadow test of eq. 7 together: the objects leave no trace in the picture before."""
    setup = bundled(launcher, "room_spot", width=24, visibility="ray")
    alone = Setup(
        launcher, replace(setup.scene, meshes=tuple(m for m in setup.scene.meshes if m.role == Role.REAL)), 24, 14
    )
    real = (setup.buffer.points.role.numpy() == Role.REAL) & (alone.buffer.points.role.numpy() == Role.REAL)
    before = setup.irradiance(setup.lights(vpls_count=2048))[0]
    truth = alone.irradiance(alone.lights(vpls_count=2048, visibility="ray"))[1]
    assert before[real].mean() == pytest.approx(truth[real].mean(), rel=0.03)
    without_vpl3 = setup.irradiance(setup.lights(vpls_count=2048, shadow_maps="single"))[0]
    assert without_vpl3[real].mean() < 0.93 * truth[real].mean()


def test_results_do_not_depend_on_runs_or_threads(launcher):
    pictures = []
    for threads in (1, 2, 2):
        relighter = Relighter(
            read_stage(usd_scenes.path("room_spot")),
            method="instant-radiosity",
            width=48,
            threads=threads,
            settings={"bounces": 2, "vpls.count": 64, "vpls.further": 32, "ism.size": 32, "ism.points": 256},
        )
        pictures.append(relighter.render())
    for other in pictures[1:]:
        for name in ("comp", "delta", "plate", "rgba"):
            np.testing.assert_array_equal(getattr(pictures[0], name), getattr(other, name))


def test_nothing_inserted_leaves_the_plate_bit_for_bit(launcher):
    scene = read_stage(usd_scenes.path("room_glossy"))
    scene = replace(scene, meshes=tuple(m for m in scene.meshes if m.role == Role.REAL))
    plate = np.random.default_rng(2).random((18, 32, 3)).astype(np.float16).astype(np.float32)
    for given in (plate, None):
        layers = Relighter(scene, method="instant-radiosity", width=32, height=18).render(given)
        np.testing.assert_array_equal(layers.comp, layers.plate)
        assert (layers.delta == 0).all()


def test_a_light_that_meets_nothing_is_noted(launcher):
    """Zero importance everywhere: no VPLs, a notice, and a picture without NaN."""
    up = Light(LightKind.RECT, (5, 5, 5), (0, 3, 0), (0.1, 0, 0), (0, 0, 0.1), direction=(0, 1, 0), path="/Up")
    relighter = Relighter(scene_of(up), method="instant-radiosity", width=16, height=16)
    layers = relighter.render()
    assert any(n.startswith("/Up: it lights nothing") for n in relighter.stats["notices"])
    assert layers.invalid == 0
    assert (layers.comp == 0).all()


def test_maps_that_do_not_fit_are_refused(launcher):
    with pytest.raises(DeviceError, match=r"500000 VPLs at ism.size=2048 need .* VPLs would fit: lower vpls.count"):
        new_isms(launcher, 500_000, size=2048, bias=0.1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"vpls.count": 131072, "ism.size": 512},
            r"131328 VPLs at ism.size=512 need .* MiB are free; \d+ VPLs would fit",
        ),
        ({"bounces": 64, "vpls.further": 131072}, r"imperfect shadow maps of 8257792 VPLs .* or take visibility=ray"),
        ({"ism.points": 1048576, "ism.blocks": 4096}, r"ism.blocks=4096 sets of ism.points=1048576 .*; \d+ would fit"),
        ({"ism.points": 1048576, "ism.blocks": 2048, "visibility": "ray"}, r"ism.blocks=2048 .* would fit"),
    ],
)
def test_more_than_memory_holds_is_refused_before_anything_is_made(settings, message):
    relighter = Relighter(
        scene_of(LIGHTS["spot"]), method="instant-radiosity", width=8, height=8, settings={"bounces": 2, **settings}
    )
    with pytest.raises(DeviceError, match=message):
        relighter.render()
    assert relighter._launcher.peak_bytes < 2**20  # the scene alone was uploaded


def test_maps_of_many_lights_that_do_not_fit_are_refused(launcher, monkeypatch):
    monkeypatch.setattr(vpl_memory, "free_bytes", lambda launcher: 2**30)
    with pytest.raises(DeviceError, match=r"maps of 9 light\(s\) at vpls.map=4096 need 18432 MiB .*; 965 would fit"):
        vpl_memory.check_memory(launcher, make_settings("balanced", {"vpls.map": 4096}), lights=9, dome=False)
    rays = make_settings("balanced", {"visibility": "ray", "bounces": 64, "vpls.further": 2**17})
    monkeypatch.setattr(vpl_memory, "free_bytes", lambda launcher: 2**28)
    with pytest.raises(DeviceError, match=r"8257792 VPLs .*: lower the largest, virtual point lights"):
        vpl_memory.check_memory(launcher, rays, lights=1, dome=False)


def test_share_out():
    assert share_out([1.0, 3.0], 8) == [2, 6]
    assert share_out([1.0, 1e9, 0.0], 4) == [1, 3, 0]
    assert share_out([0.0, 0.0], 4) == [0, 0]
    assert sum(share_out([0.3, 0.3, 0.4], 256)) == 256


def scan_of(cloud, setup, role):
    """Points on the surfaces of one role, as a scanner would give them: shuffled."""
    order = np.random.default_rng(3).permutation(cloud.count)
    points = cloud.position.numpy().astype(float) / setup.plan.scale + np.asarray(setup.plan.origin)
    radii = np.sqrt(cloud.area.numpy() / np.pi) / setup.plan.scale
    return PointCloud(points[order], cloud.normal.numpy()[order], radii[order].astype(np.float32), role, path="/Scan")


def test_points_of_a_scan_cast_the_shadow_of_the_surface_they_were_taken_from(launcher):
    """Maps drawn from given points alone see as those drawn from the surfaces do."""
    setup = bundled(launcher, "room_area", width=24)
    lights = setup.lights(visibility="ray", vpls_count=64)
    drawn = sample_surfaces(launcher, setup.device_scene, setup.region, block=1024, blocks=32, seed=5)
    scans = [scan_of(drawn.real, setup, Role.REAL), scan_of(drawn.synthetic, setup, Role.SYNTHETIC)]
    bare = replace(setup.device_scene, triangles_vs=setup.device_scene.triangles_vs[:0])
    bare.geometry.synthetic_first, kept = 0, bare.geometry.synthetic_first
    cloud = sample_surfaces(launcher, bare, setup.region, block=1024, blocks=16, seed=0, scans=scans)
    bare.geometry.synthetic_first = kept
    given = set(map(tuple, drawn.real.position.numpy().round(4)))
    assert set(map(tuple, cloud.real.position.numpy().round(4))) <= given
    for ours, theirs in ((cloud.real, drawn.real), (cloud.synthetic, drawn.synthetic)):
        assert ours.area.numpy().sum() == pytest.approx(theirs.area.numpy().sum(), rel=0.03)
    maps = new_isms(launcher, lights.vpls.count, size=128, bias=0.08)
    draw_isms(launcher, maps, lights.vpls, cloud, 0, lights.vpls.count, grow=1.3)
    result = compare_sight(
        launcher, setup.device_scene, setup.buffer.points, setup.buffer.count, lights.vpls, maps, ray_sight(launcher)
    )
    assert result.agree > 0.95

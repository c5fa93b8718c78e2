"""Gathering from lit volumes against closed forms: the furnace, form factors, and the path-traced room."""

from __future__ import annotations

from dataclasses import replace

import lit_scenes as lit
import numpy as np
import pytest
from lit_scenes import cone_settings as cone

from warp_dvct.methods.path_tracing import gather_irradiance_reference
from warp_dvct.passes.gather import Gatherer, gather_all
from warp_dvct.passes.injection import empty_flux, inject
from warp_dvct.passes.rsm import render_rsm
from warp_dvct.scene import Light, LightKind, Material, Role, Scene


def gathered(launcher, points, count, gatherer) -> tuple[np.ndarray, np.ndarray]:
    before, after = gather_all(launcher, points, count, gatherer)
    return before.numpy()[:count].astype(float), after.numpy()[:count].astype(float)


B = np.array([1.0, 2.0, 3.0])


def furnace(launcher, n: int, inserted: bool, degrees: float) -> lit.Lit:
    """A closed room, with or without a ball in it, all of radiosity B."""
    parts = [lit.mesh(lit.room(0.32 if degrees else 0.4, degrees))]
    if inserted:
        parts.append(lit.mesh(lit.ball((0.5, 0.45, 0.5), 0.12), Role.SYNTHETIC))
    return lit.lit_world(launcher, lit.scene_of(*parts), n, lambda _, v: lit.uniform_flux(launcher, v, B))


@pytest.mark.parametrize("degrees", [0.0, 20.0])
@pytest.mark.parametrize("inserted", [False, True])
@pytest.mark.parametrize("n", [64, 128, 256])
def test_furnace(launcher, n, inserted, degrees):
    """Irradiance is B everywhere, for rays and any set of cones: within 1e-3, where 3 % mean and 8 % worst were asked.

    Of cones this shows that no light is made and none is lost, not how well they see: an exact ray closes what the
    march leaves open, so that a closed room is closed. What the march alone covers is the next test.
    """
    world = furnace(launcher, n, inserted, degrees)
    count = 600
    points, _ = lit.points_on(launcher, world.device_scene, count)
    on_object = points.role.numpy()[:count] == Role.SYNTHETIC
    assert on_object.any() == inserted
    for number in (0, 9, 16, 36):
        gatherer = Gatherer(world.device_scene, world.world, 64, 0, number, cone() if number else None)
        before, after = gathered(launcher, points, count, gatherer)
        np.testing.assert_allclose(after / B, 1.0, atol=1e-3, err_msg=f"{number} cones, after")
        np.testing.assert_allclose(before[~on_object] / B, 1.0, atol=1e-3, err_msg=f"{number} cones, before")


# Mean of what the march covers: measured .83 (9 cones, empty aligned room) to .96; wide cones slip past walls' ends.
COVERED = {9: 0.81, 16: 0.86, 36: 0.90}


@pytest.mark.parametrize("degrees", [0.0, 20.0])
@pytest.mark.parametrize("inserted", [False, True])
@pytest.mark.parametrize("n", [64, 256])
def test_furnace_by_the_march_alone(launcher, n, inserted, degrees):
    """With ``cones.escape=volume`` the open rest of a cone is sky (black here): the directional pyramid's own leak."""
    world = furnace(launcher, n, inserted, degrees)
    count = 1500
    points, _ = lit.points_on(launcher, world.device_scene, count)
    means = []
    for number, least in COVERED.items():
        gatherer = Gatherer(world.device_scene, world.world, 64, 0, number, cone("volume"))
        after = gathered(launcher, points, count, gatherer)[1] / B
        assert after.mean() > least, f"{number} cones"
        assert after.max() < 1.001, "light was made"
        assert after.min() > 0.6
        means.append(after.mean())
    assert means[0] < means[-1] + 0.01, "narrower cones leak less"


def test_furnace_by_the_papers_filter_is_dark(launcher):
    """Mip-averaged occupancy with eq. 4's product, as in the paper: most of the light is lost through the walls."""
    scene = lit.scene_of(lit.mesh(lit.room(0.4)))
    world = lit.lit_world(launcher, scene, 128, lambda _, v: lit.uniform_flux(launcher, v, B), filter="isotropic")
    points, _ = lit.points_on(launcher, world.device_scene, 800)
    gatherer = Gatherer(world.device_scene, world.world, 64, 0, 9, cone("volume", additive=0))
    paper = gathered(launcher, points, 800, gatherer)[1] / B
    assert paper.mean() < 0.75


def parallel_square(height: float, half: float) -> float:
    """Form factor from a point to a parallel square straight above it."""
    x = half / height
    return 4 * (2 / (2 * np.pi)) * (x / np.sqrt(1 + x * x)) * np.arctan(x / np.sqrt(1 + x * x))


def wall_factor(height: float, distance: float, half: float) -> float:
    """From a point to a perpendicular rectangle on its plane, ``2 * half`` wide, at a distance."""
    far = np.sqrt(distance**2 + height**2)
    corner = np.arctan(half / distance) - distance / far * np.arctan(half / far)
    return 2 * corner / (2 * np.pi)


def glow(launcher, chosen):
    """Flux of triangles ``chosen`` (a function of the device scene's triangle index) with radiosity B, the others 0."""

    def flux(device_scene, voxels):
        pieces = voxels.fragments
        order = pieces.order.numpy()[: pieces.count]
        triangle, size = pieces.triangle.numpy()[order], pieces.place.numpy()[order, 3]
        record = (
            np.searchsorted(pieces.record_start.numpy()[: voxels.level_records[0]], np.arange(pieces.count), "right")
            - 1
        )
        corners = device_scene.triangles_vs.astype(float)
        normal = lit.cross_of(corners)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        share = np.stack([np.maximum(0, s * normal[:, k]) for k in range(3) for s in (1, -1)], 1)
        out = np.zeros((voxels.level_records[0], 6, 2))
        for solution in (0, 1):
            mine = np.isin(triangle, chosen) & ((device_scene.role[triangle] == Role.REAL) | (solution == 1))
            np.add.at(out[:, :, solution], record[mine], (share[triangle[mine]] * size[mine, None]))
        return lit.launcher_vectors(launcher, out.reshape(-1, 1) * B)

    return flux


def side_of(device_scene, axis: int, sign: float) -> np.ndarray:
    """Triangles of the room's side at ``sign`` of an axis."""
    middle = device_scene.triangles_vs.mean(1) - 0.5
    room = (np.abs(middle) > 0.39).any(1) & (device_scene.role == Role.REAL)
    return np.flatnonzero(room & (sign * middle[:, axis] > 0.39))


FLOOR_POINT = np.array([[0.5, 0.1, 0.5]])


def repeated(launcher, count: int, position, normal, spread: float = 1e-3):
    """Points around one place, each with its own random numbers: their mean is the estimator's."""
    offset = np.random.default_rng(0).uniform(-spread, spread, (count, 3))
    return lit.points_at(launcher, np.asarray(position) + offset * (np.asarray(normal) == 0), normal)


@pytest.mark.parametrize("n", [64, 128])
@pytest.mark.parametrize(
    ("axis", "sign", "factor"),
    [(1, 1.0, parallel_square(0.8, 0.4)), (0, 1.0, wall_factor(0.8, 0.4, 0.4)), (2, -1.0, wall_factor(0.8, 0.4, 0.4))],
    ids=["ceiling", "wall +x", "wall -z"],
)
def test_irradiance_from_one_glowing_side(launcher, n, axis, sign, factor):
    """B times the form factor: rays within 1.5 %, 9 cones within 20 % (17 measured), 36 within 10 %."""
    scene = lit.scene_of(lit.mesh(lit.room(0.4)))
    chosen = side_of(lit.upload(launcher, scene), axis, sign)
    assert len(chosen) == 2
    world = lit.lit_world(launcher, scene, n, glow(launcher, chosen))
    points = repeated(launcher, 256, FLOOR_POINT, (0, 1, 0))
    for number, tolerance in ((0, 0.015), (9, 0.2), (36, 0.1)):
        gatherer = Gatherer(world.device_scene, world.world, 64, 0, number, cone() if number else None)
        before, after = gathered(launcher, points, 256, gatherer)
        np.testing.assert_allclose(after.mean(0), B * factor, rtol=tolerance, err_msg=f"{number} cones")
        np.testing.assert_allclose(before, after, rtol=1e-5, atol=1e-7)


def inserted_ball(launcher, n, *, glows: str):
    """A synthetic ball between floor and ceiling; what ``glows`` has radiosity B, the other is black."""
    ball = lit.mesh(lit.ball((0.5, 0.4, 0.5), 0.1, 48), Role.SYNTHETIC)
    scene = lit.scene_of(lit.mesh(lit.room(0.4)), ball)
    device_scene = lit.upload(launcher, scene)
    chosen = np.flatnonzero(device_scene.role == Role.SYNTHETIC)
    if glows == "ceiling":
        chosen = side_of(device_scene, 1, 1.0)
    return lit.lit_world(launcher, scene, n, glow(launcher, chosen))


def floor_points(launcher, count: int):
    """Random points on the floor, and from each the ball's form factor r^2 h / d^3: it is above their horizon."""
    places = np.random.default_rng(0).uniform(0.1, 0.9, (count, 3))
    places[:, 1] = 0.1
    distance = np.linalg.norm(places - [0.5, 0.4, 0.5], axis=-1)
    return lit.points_at(launcher, places, (0, 1, 0)), 0.1**2 * 0.3 / distance**3


# Mean of cones over truth. A voxel's faces sum max(0, n . e): along a direction d a round object counts
# |dx| + |dy| + |dz| times its silhouette, 1.5 on average, where it is a part of a cone's width. Measured 1.30 to 1.58.
ROUND = (1.0, 1.6)


def test_irradiance_from_an_inserted_ball(launcher):
    """All of it is delta. The mean over the floor is within 1 % by rays (512: 15 % RMS); cones see it too large."""
    world = inserted_ball(launcher, 128, glows="ball")
    count = 500
    points, factor = floor_points(launcher, count)
    before, after = gathered(launcher, points, count, Gatherer(world.device_scene, world.world, 512, 0))
    assert not before.any()
    np.testing.assert_allclose(after.mean(0), B * factor.mean(), rtol=0.01)
    assert np.sqrt(((after[:, 0] - factor) ** 2).mean()) < 0.15 * factor.mean()
    for number in (9, 16, 36):
        gatherer = Gatherer(world.device_scene, world.world, 64, 0, number, cone())
        before, after = gathered(launcher, points, count, gatherer)
        assert not before.any()
        ratio = after.mean(0) / (B * factor.mean())
        assert ROUND[0] < ratio.min()
        assert ratio.max() < ROUND[1]


def test_an_inserted_ball_blocks_indirect_light(launcher):
    """A black ball before a glowing ceiling. Above the floor's middle it hides its own form factor of ceiling."""
    world = inserted_ball(launcher, 128, glows="ceiling")
    middle = repeated(launcher, 512, FLOOR_POINT, (0, 1, 0))
    before, after = gathered(launcher, middle, 512, Gatherer(world.device_scene, world.world, 256, 0))
    np.testing.assert_allclose(before.mean(0), B * parallel_square(0.8, 0.4), rtol=0.015)
    np.testing.assert_allclose((before - after).mean(0), B * (0.1 / 0.3) ** 2, rtol=0.02)
    count = 500
    points, _ = floor_points(launcher, count)
    exact = gathered(launcher, points, count, Gatherer(world.device_scene, world.world, 1024, 0))
    for number in (9, 16, 36):
        gatherer = Gatherer(world.device_scene, world.world, 64, 0, number, cone())
        before, after = gathered(launcher, points, count, gatherer)
        assert (after <= before + 1e-5).all(), "a black object makes no light"
        assert before.mean() / exact[0].mean() == pytest.approx(1.0, abs=0.15)
        assert ROUND[0] < (before - after).mean() / (exact[0] - exact[1]).mean() < ROUND[1]


def open_room(launcher, n: int, inserted: bool) -> lit.Lit:
    """A black room without a ceiling under a constant dome of radiance B, with or without a black ball in it."""
    walls = lit.room(0.4)
    walls = walls[walls[..., 1].mean(-1) < 0.89]
    parts = [lit.mesh(walls)]
    if inserted:
        parts.append(lit.mesh(lit.ball((0.5, 0.4, 0.5), 0.1, 48), Role.SYNTHETIC))
    scene = lit.scene_of(*parts, lights=(Light(LightKind.DOME, tuple(B)),))
    return lit.lit_world(launcher, scene, n, lambda _, v: lit.uniform_flux(launcher, v, np.zeros(3)))


def test_sky_through_the_open_roof(launcher):
    """Escaped cones read the dome: pi L times the roof's form factor; the inserted ball darkens by its own."""
    count, sky = 256, B * np.pi * parallel_square(0.8, 0.4)
    points = repeated(launcher, count, FLOOR_POINT, (0, 1, 0))
    world, empty = open_room(launcher, 128, True), open_room(launcher, 128, False)
    for number, tolerance in ((0, 0.015), (9, 0.2), (36, 0.15)):
        gatherer = Gatherer(world.device_scene, world.world, 128, 0, number, cone() if number else None)
        before, after = gathered(launcher, points, count, gatherer)
        np.testing.assert_allclose(before.mean(0), sky, rtol=tolerance, err_msg=f"{number} cones")
        blocked = (before - after).mean(0) / (B * np.pi * (0.1 / 0.3) ** 2)
        if number:
            assert 0.7 < blocked.min() <= blocked.max() < 1.7
        else:
            np.testing.assert_allclose(blocked, 1.0, rtol=0.03)
        without = replace(gatherer, scene=empty.device_scene, world=empty.world)
        before, after = gathered(launcher, points, count, without)
        np.testing.assert_array_equal(before, after)
        if number:
            leaking = replace(gatherer, cone=cone("volume"))
            assert (gathered(launcher, points, count, leaking)[0].mean(0) > before.mean(0)).all()


def test_coarse_volume_takes_over_where_the_fine_one_ends(launcher):
    """The furnace with a fine volume around the middle alone, for points in it and outside of it."""
    scene = lit.scene_of(lit.mesh(lit.room(0.4)), lit.mesh(lit.ball((0.5, 0.5, 0.5), 0.12), Role.SYNTHETIC))
    boxes = [((0.3, 0.3, 0.3), 0.4, 96), ((0.0, 0.0, 0.0), 1.0, 48)]
    world = lit.lit_world(launcher, scene, 0, lambda _, v: lit.uniform_flux(launcher, v, B), boxes=boxes)
    points, _ = lit.points_on(launcher, world.device_scene, 600)
    for number, least in ((0, 0.999), (9, 0.999), (36, 0.999)):
        gatherer = Gatherer(world.device_scene, world.world, 64, 0, number, cone() if number else None)
        _, after = gathered(launcher, points, 600, gatherer)
        assert least < (after / B).min() <= (after / B).max() < 1.001
    gatherer = Gatherer(world.device_scene, world.world, 64, 0, 16, cone("volume"))
    assert 0.82 < (gathered(launcher, points, 600, gatherer)[1] / B).mean() < 1.001


def path_traced_room() -> Scene:
    """A closed grey room with coloured sides, a light near its ceiling and an inserted box and ball."""
    walls = lit.room(0.4)
    middle = walls.mean(1) - 0.5
    material = np.where(middle[:, 0] < -0.39, 1, np.where(middle[:, 0] > 0.39, 2, 0)).astype(np.int32)
    room = replace(lit.mesh(walls), materials=material)
    lamp = Light(
        LightKind.RECT,
        (9.0, 8.0, 7.0),
        position=(0.5, 0.88, 0.5),
        axis_x=(0.1, 0, 0),
        axis_y=(0, 0, 0.1),
        direction=(0, -1, 0),
    )
    materials = [
        Material(base_color=c, ior=1.0) for c in ((0.6, 0.6, 0.6), (0.7, 0.1, 0.1), (0.1, 0.6, 0.1), (0.8, 0.5, 0.2))
    ]
    box = lit.mesh(lit.cuboid((0.38, 0.25, 0.45), (0.09, 0.15, 0.09), 20.0), Role.SYNTHETIC, 3)
    ball = lit.mesh(lit.ball((0.62, 0.22, 0.58), 0.12), Role.SYNTHETIC, 3)
    return lit.scene_of(room, box, ball, lights=(lamp,), materials=materials)


@pytest.fixture(scope="module")
def traced_room(launcher):
    """The room lit by one RSM pair, points on all surfaces, and their one-bounce irradiance by path tracing."""
    scene = path_traced_room()

    def flux_of(device_scene, voxels):
        maps = render_rsm(launcher, device_scene, 0, 512, center=(0.5, 0.5, 0.5), radius=0.5 * np.sqrt(3.0), start=3.0)
        flux = empty_flux(launcher, voxels)
        inject(launcher, voxels, maps, flux)
        return flux

    world = lit.lit_world(launcher, scene, 128, flux_of)
    count = 400
    walls, _ = lit.points_on(launcher, world.device_scene, count, triangles=np.arange(12), inset=0.02)
    places, normals = walls.position.numpy()[:count], walls.normal.numpy()[:count]
    free = np.flatnonzero((places[:, 1] > 0.101) | (np.abs(places[:, [0, 2]] - 0.5).max(-1) > 0.25))
    truth = gather_irradiance_reference(launcher, world.device_scene, scene, places[free], normals[free], samples=512)
    return world, lit.points_at(launcher, places[free], normals[free]), [t.astype(float) for t in truth], len(free)


@pytest.mark.parametrize(("number", "mean", "rms"), [(0, 0.03, 0.12), (9, 0.1, 0.35), (16, 0.1, 0.3)])
def test_room_against_the_path_tracer(launcher, traced_room, number, mean, rms):
    """Mean one-bounce irradiance on the walls, before and after: asked for 10 %; rays are within 3 %."""
    world, points, truth, count = traced_room
    gatherer = Gatherer(world.device_scene, world.world, 256, 3, number, cone() if number else None)
    for got, expected in zip(gathered(launcher, points, count, gatherer), truth, strict=True):
        np.testing.assert_allclose(got.mean(0), expected.mean(0), rtol=mean)
        assert np.sqrt(((got - expected) ** 2).mean()) < rms * expected.mean()


def test_room_delta_against_the_path_tracer(launcher, traced_room):
    """The change alone, by rays: its mean within 10 % and its error below 8 % of the mean before."""
    world, points, truth, count = traced_room
    before, after = gathered(launcher, points, count, Gatherer(world.device_scene, world.world, 512, 3))
    delta, expected = after - before, truth[1] - truth[0]
    np.testing.assert_allclose(delta.mean(0), expected.mean(0), rtol=0.1)
    assert np.sqrt(((delta - expected) ** 2).mean()) < 0.08 * truth[0].mean()

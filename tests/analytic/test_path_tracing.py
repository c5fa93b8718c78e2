"""The path tracer against closed forms, and what its shared random numbers promise."""

from dataclasses import replace

import numpy as np
import pytest

from warp_dvct.device_scene import DeviceScene
from warp_dvct.errors import OptionError
from warp_dvct.launch import Launcher
from warp_dvct.methods.path_tracing import PathTracer, gather_irradiance_reference, path_trace
from warp_dvct.scene import Camera, Light, LightKind, LightRole, Material, Mesh, Role, Scene

GREY = Material(base_color=(0.5, 0.4, 0.3), ior=1.0)
WHITE = Material(base_color=(1.0, 1.0, 1.0), ior=1.0)
ALBEDO = np.array(GREY.base_color)
L = (2.0, 3.0, 4.0)


def rectangle(centre, half_x, half_y, material=0, role=Role.REAL) -> Mesh:
    """Two triangles whose front is half_x cross half_y."""
    c, x, y = (np.array(v, float) for v in (centre, half_x, half_y))
    points = np.array([c - x - y, c + x - y, c + x + y, c - x + y])
    return Mesh(points, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.full(2, material, np.int32), role)


def cube(centre, half, material=0, role=Role.REAL) -> list[Mesh]:
    """Six rectangles facing outwards."""
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            n, x = np.eye(3)[axis] * sign, np.eye(3)[(axis + 1) % 3]
            sides.append(rectangle(centre + n * half, x * half, np.cross(n, x) * half, material, role))
    return sides


def look(eye, forward, up, half=0.1) -> Camera:
    to_world = np.eye(4)
    to_world[:3] = np.stack([np.cross(forward, up), up, -np.array(forward, float), eye], 1)
    return Camera(to_world, -half, half, -half, half)


DOWN = look((0, 3, 0), (0, -1, 0), (0, 0, -1))  # sees the floor around the origin
FLOOR = rectangle((0, 0, 0), (4, 0, 0), (0, 0, -4))


def render(launcher, meshes, lights, *, camera=DOWN, materials=(GREY, WHITE), size=8, samples=16, bounces=0, **more):
    scene = Scene(tuple(meshes), tuple(materials), (), tuple(lights), camera)
    device_scene = DeviceScene.upload(launcher, scene, more.pop("origin", np.zeros(3)), more.pop("scale", 1.0))
    out = path_trace(launcher, device_scene, scene, size, size, samples=samples, bounces=bounces, **more)
    return {k: getattr(out, k).numpy() for k in vars(out) if k not in ("width", "height")}


def light(kind, **more) -> Light:
    return Light(kind, L, position=(0, 2, 0), direction=(0, -1, 0), **more)


IRRADIANCE = {
    "point": (light(LightKind.POINT), 1 / 4),
    "sphere": (light(LightKind.SPHERE, radius=0.5), np.pi * 0.25 / 4),
    "rect": (
        light(LightKind.RECT, axis_x=(0.5, 0, 0), axis_y=(0, 0, 0.5)),
        4 * 0.25 / np.sqrt(1 + 0.25**2) * np.arctan(0.25 / np.sqrt(1 + 0.25**2)),
    ),
    "disk": (light(LightKind.DISK, axis_x=(0.6, 0, 0), axis_y=(0, 0, 0.6)), np.pi * 0.36 / 4.36),
    "distant": (light(LightKind.DISTANT, angle=0.4), np.pi * np.sin(0.2) ** 2),
    "directional": (light(LightKind.DISTANT), 1.0),
    "dome": (light(LightKind.DOME), np.pi),
    "textured dome": (light(LightKind.DOME, texture=np.ones((4, 8, 3), np.float32)), np.pi),
}


@pytest.mark.parametrize("name", IRRADIANCE)
def test_direct_light_on_a_diffuse_floor(launcher, name):
    """Reflected radiance is albedo / pi times the closed form of the irradiance below the light."""
    source, form = IRRADIANCE[name]
    narrow = look((0, 3, 0), (0, -1, 0), (0, 0, -1), half=0.004)
    out = render(launcher, [FLOOR], [source], camera=narrow, samples=256)
    np.testing.assert_allclose(out["before"].mean(0), ALBEDO / np.pi * np.array(L) * form, rtol=3e-3)
    assert not out["delta"].any()
    assert not out["synthetic"].any()
    assert (out["mask_real"] == 1.0).all()


def test_white_furnace(launcher):
    """A convex white object under a uniform dome cannot be told from the dome, whatever its role."""
    dome = Light(LightKind.DOME, (1.0, 1.0, 1.0))
    for role in Role:
        out = render(
            launcher,
            cube(np.zeros(3), 1.0, material=1, role=role),
            [dome],
            camera=look((0, 0, 3), (0, 0, -1), (0, 1, 0), 1.0),
            size=16,
            bounces=3,
        )
        np.testing.assert_allclose(out["before"], 1.0, rtol=1e-5)
        coverage = out["synthetic"][:, 3:]
        assert (coverage.max() > 0) == (role == Role.SYNTHETIC)
        np.testing.assert_allclose(out["synthetic"][:, :3], np.broadcast_to(coverage, (256, 3)), rtol=1e-5)
        np.testing.assert_allclose(out["delta"], 0.0, atol=1e-6)


def test_closed_room_adds_up_the_geometric_series(launcher):
    """Inside a closed cube of one albedo with a light that fills each wall evenly, bounce n carries albedo**n."""
    room = [replace(m, triangles=m.triangles[:, ::-1].copy()) for m in cube(np.zeros(3), 1.0)]
    bulb = Light(LightKind.SPHERE, (1.0, 1.0, 1.0), radius=0.5)
    camera = look((0, 0, 0.9), (0, 0, -1), (0, 1, 0), 0.9)
    steps = [
        render(launcher, room, [bulb], camera=camera, size=16, samples=128, bounces=n)["before"].mean(0)
        for n in (0, 1, 2, 60)
    ]
    # Flux into the room: pi L A; the mean radiosity of all walls at bounce n is flux * albedo**(n + 1) / area.
    flux = np.pi * 4 * np.pi * 0.25
    first = flux / 24 * ALBEDO / np.pi
    added = [steps[0], steps[1] - steps[0], steps[2] - steps[1]]
    # The picture shows mostly one wall, which after two bounces is as bright as the mean.
    np.testing.assert_allclose(added[2] / added[1], ALBEDO, rtol=0.02)
    np.testing.assert_allclose(added[1], first * ALBEDO, rtol=0.05)
    np.testing.assert_allclose(steps[3] - steps[1], added[2] / (1 - ALBEDO), rtol=0.03)


def room_with_box(*lights: Light, role=Role.SYNTHETIC) -> tuple[list[Mesh], list[Light]]:
    wall = rectangle((0, 1, -2), (4, 0, 0), (0, 2, 0))
    return [FLOOR, wall, *cube(np.array([0.4, 0.5, 0.0]), 0.4, 0, role)], list(lights)


VIEW = look((0, 1.2, 4), (0, 0, -1), (0, 1, 0), 0.6)


def test_nothing_synthetic_gives_a_delta_of_exactly_zero(launcher):
    meshes, lights = room_with_box(*(source for source, _ in IRRADIANCE.values()))
    out = render(launcher, [m for m in meshes if m.role == Role.REAL], lights, camera=VIEW, bounces=5)
    assert not out["delta"].any()
    assert not out["synthetic"].any()
    assert out["before"].any()


def test_a_hidden_object_changes_nothing_bit_for_bit(launcher):
    """Below the floor no path reaches it: delta is exactly zero, before the same as without it."""
    below = cube(np.array([0.0, -3.0, 0.0]), 0.3, 1, Role.SYNTHETIC)
    lights = [light(LightKind.SPHERE, radius=0.3), light(LightKind.RECT, axis_x=(0.5, 0, 0), axis_y=(0, 0, 0.5))]
    with_it, without = (render(launcher, m, lights, bounces=2) for m in ([FLOOR, *below], [FLOOR]))
    assert not with_it["delta"].any()
    np.testing.assert_array_equal(with_it["before"], without["before"])


def test_before_does_not_know_the_object_and_after_is_the_scene_with_it(launcher):
    source = light(LightKind.SPHERE, radius=0.3)
    added = replace(source, position=(-1.0, 2.0, 1.0), radiance=(3.0, 1.0, 0.5), role=LightRole.ADDED)
    meshes, lights = room_with_box(source, added)
    options = {"camera": VIEW, "size": 24, "samples": 64, "bounces": 3}
    out = render(launcher, meshes, lights, **options)
    alone = render(launcher, [m for m in meshes if m.role == Role.REAL], [source], **options)
    after = render(
        launcher, room_with_box(role=Role.REAL)[0], [source, replace(added, role=LightRole.PLATE)], **options
    )
    coverage = out["synthetic"][:, 3]
    assert 0.02 < (coverage == 1).mean() < 0.6
    # Light samples are numbered by light, so 'before' has other random numbers than the scene without that light.
    np.testing.assert_allclose(out["before"].mean(0), alone["before"].mean(0), rtol=0.01)
    for part, ours in ((coverage == 0, out["before"] + out["delta"]), (coverage == 1, out["synthetic"][:, :3])):
        np.testing.assert_allclose(ours[part].mean(0), after["before"][part].mean(0), rtol=0.015)
    assert out["delta"].min() < -0.01  # the shadow
    assert out["delta"].max() > 0.01  # the added light


def test_an_added_light_is_all_delta(launcher):
    source = light(LightKind.SPHERE, radius=0.3)
    as_plate = render(launcher, [FLOOR], [source], bounces=1)
    as_added = render(launcher, [FLOOR], [replace(source, role=LightRole.ADDED)], bounces=1)
    assert not as_added["before"].any()
    np.testing.assert_array_equal(as_added["delta"], as_plate["before"])


def test_a_dome_behind_everything_is_in_both_pictures(launcher):
    dome = Light(LightKind.DOME, L)
    added = replace(dome, role=LightRole.ADDED)
    far_floor = rectangle((0, 0, -100), (4, 0, 0), (0, 0, -4))
    out = render(launcher, [far_floor], [dome, added])
    np.testing.assert_allclose(out["before"], np.tile(L, (64, 1)), rtol=1e-6)
    assert not out["delta"].any()
    assert not out["mask_real"].any()
    assert np.isinf(out["depth"]).all()


def test_coverage_and_first_surfaces(launcher):
    """A synthetic card over half of the view, one metre above the floor."""
    card = rectangle((1.0, 1.0, 0.0), (1.0, 0, 0), (0, 0, -3), 1, Role.SYNTHETIC)
    sun = Light(LightKind.DISTANT, L, direction=(0, -1, 0))
    camera = look((0.01, 3, 0), (0, -1, 0), (0, 0, -1), 0.4)
    out = render(
        launcher, [FLOOR, card], [sun], camera=camera, size=5, samples=1024, origin=np.array([3.0, 1, 2]), scale=0.5
    )
    edge = 2.5 - 0.01 / 2 / 0.8 * 5  # where x = 0 at height 1 falls in the picture
    covered = np.clip(np.arange(5) + 1 - edge, 0, 1)
    coverage = out["synthetic"][:, 3].reshape(5, 5)
    np.testing.assert_allclose(coverage, np.tile(covered, (5, 1)), atol=2e-3)
    np.testing.assert_allclose(out["mask_real"], 1 - out["synthetic"][:, 3], atol=1e-6)
    white = np.array(L) / np.pi
    np.testing.assert_allclose(out["synthetic"][:, :3], out["synthetic"][:, 3:] * white, rtol=1e-4)
    row = out["position"].reshape(5, 5, 3)[2]
    np.testing.assert_allclose(out["depth"].reshape(5, 5)[2], [3, 3, 2, 2, 2], rtol=1e-5)
    x = 0.01 + (np.arange(5) - 2) / 5 * 0.8 * np.array([3, 3, 2, 2, 2])
    np.testing.assert_allclose(row, np.stack([x, [0, 0, 1, 1, 1], np.zeros(5)], 1), atol=1e-5)
    np.testing.assert_allclose(out["normal"], np.tile((0, 1, 0), (25, 1)), atol=1e-6)
    np.testing.assert_allclose(out["albedo"].reshape(5, 5, 3)[2], [ALBEDO] * 2 + [[1, 1, 1]] * 3, rtol=1e-6)
    # In the card's shadow all of the light is lost, beside it none is: the sun stands at the zenith.
    delta = out["delta"].reshape(5, 5, 3)
    np.testing.assert_array_equal(delta[:, 0], 0.0)


def test_same_bytes_for_any_thread_count_and_any_batches(device):
    meshes, lights = room_with_box(light(LightKind.SPHERE, radius=0.3), Light(LightKind.DOME, (0.2, 0.3, 0.4)))
    scene = Scene(tuple(meshes), (GREY, WHITE), (), tuple(lights), VIEW)
    results = []
    for threads, batches in ((1, (7, 5)), (2, (12,)), (5, (1, 1, 10))):
        launcher = Launcher(device, threads=threads)
        uploaded = DeviceScene.upload(launcher, scene, np.zeros(3), 1.0)
        tracer = PathTracer(launcher, uploaded, scene, 40, 30, bounces=2, seed=4)
        for samples in batches:
            tracer.add(samples)
        out = tracer.resolve()
        results.append([out.before.numpy(), out.delta.numpy(), out.synthetic.numpy(), out.mask_real.numpy()])
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_seeds_differ_and_progress_is_told(launcher):
    calls = []
    first, second = (
        render(launcher, [FLOOR], [light(LightKind.SPHERE, radius=0.5)], seed=s, progress=lambda *a: calls.append(a))
        for s in (0, 1)
    )
    assert (first["before"] != second["before"]).any()
    assert calls[-1] == (16, 16)


def test_the_delta_of_a_shadow_has_little_noise_away_from_it(launcher):
    """Shared random numbers: where the object hides no light, direct light has a delta of exactly zero, not noise."""
    meshes, lights = room_with_box(light(LightKind.SPHERE, radius=0.3))
    out = render(launcher, meshes, lights, camera=VIEW, size=24, samples=8, bounces=0)
    real = out["synthetic"][:, 3] == 0
    unchanged = (out["delta"][real] == 0).all(1).mean()
    assert 0.4 < unchanged < 1.0
    noise = out["before"][real].std(0)
    assert (noise > 0).all()


def test_irradiance_reference_is_the_form_factor_of_a_lit_wall(launcher):
    """A square, lit head-on, shines onto a point on its axis; then a synthetic white card hides it."""
    wall = rectangle((0, 0, 0), (1, 0, 0), (0, 0, -1))  # faces up
    sun = Light(LightKind.DISTANT, L, direction=(0, -1, 0))

    def factor(a):
        """Of a square at distance d with half edge a d, seen from its axis."""
        b = a / np.sqrt(1 + a * a)
        return 4 * b * np.arctan(b) / np.pi

    scene_of = {}
    for name, extra in (
        ("open", []),
        ("blocked", [rectangle((0, 0.5, 0), (0.6, 0, 0), (0, 0, -0.6), 1, Role.SYNTHETIC)]),
    ):
        scene = Scene((wall, *extra), (GREY, WHITE), (), (sun,), DOWN)
        uploaded = DeviceScene.upload(launcher, scene, np.zeros(3), 1.0)
        scene_of[name] = gather_irradiance_reference(
            launcher, uploaded, scene, np.array([[0, 1.0, 0]]), np.array([[0, -1.0, 0]]), samples=1 << 14
        )
    radiosity = np.array(L) * ALBEDO
    before, after = scene_of["open"]
    np.testing.assert_allclose(before[0], radiosity * factor(1.0), rtol=5e-3)
    np.testing.assert_array_equal(before, after)
    before, after = scene_of["blocked"]
    np.testing.assert_allclose(before[0], radiosity * factor(1.0), rtol=5e-3)
    np.testing.assert_allclose(after[0], np.array(L) * factor(1.2), rtol=5e-3)


def test_volume_space_does_not_change_the_picture(launcher):
    meshes, lights = room_with_box(*(source for source, _ in IRRADIANCE.values()))
    small = render(launcher, meshes, lights, camera=VIEW, size=16, samples=64, bounces=2)
    large = render(
        launcher,
        meshes,
        lights,
        camera=VIEW,
        size=16,
        samples=64,
        bounces=2,
        origin=np.array([-40.0, 9, 3]),
        scale=0.01,
    )
    for name in ("before", "delta", "synthetic"):
        np.testing.assert_allclose(small[name].mean(0), large[name].mean(0), rtol=5e-3, atol=1e-4)


def test_bad_options_are_refused(launcher):
    for options, message in (
        ({"samples": 0}, "samples is 0"),
        ({"bounces": -1}, "bounces is -1"),
        ({"size": 0}, "0 x 0 pixels"),
    ):
        with pytest.raises(OptionError, match=message):
            render(launcher, [FLOOR], [], **options)
    scene = Scene((FLOOR,), (GREY,), (), (), DOWN)
    uploaded = DeviceScene.upload(launcher, scene, np.zeros(3), 1.0)
    with pytest.raises(OptionError, match="no samples"):
        PathTracer(launcher, uploaded, scene, 2, 2, bounces=0).resolve()
    with pytest.raises(OptionError, match="bounces is 0"):
        gather_irradiance_reference(
            launcher, uploaded, scene, np.zeros((1, 3)), np.array([[0.0, 1, 0]]), samples=1, bounces=0
        )

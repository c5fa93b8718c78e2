"""The path tracer against Mitsuba 3 (scalar_rgb): every light type, several bounces, and a GGX metal."""

import numpy as np
import pytest

from warp_dvct.device_scene import DeviceScene
from warp_dvct.launch import Launcher
from warp_dvct.methods.path_tracing import path_trace
from warp_dvct.scene import Camera, Light, LightKind, Material, Mesh, Role, Scene

WIDTH, HEIGHT = 42, 28
FOV_Y = 0.7  # radians
GREY = Material(base_color=(0.7, 0.6, 0.5), ior=1.0)
BLUE = Material(base_color=(0.2, 0.3, 0.8), ior=1.0)
RED = Material(base_color=(0.8, 0.2, 0.1), ior=1.0)
EYE, TARGET = (0.6, 1.6, 3.6), (0.0, 0.6, 0.0)
TOLERANCE = 0.01  # of the mean: what the reference promises


@pytest.fixture(scope="module")
def mi():
    """Mitsuba with its scalar RGB variant."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def quad(corners, material: int, role: Role = Role.REAL) -> Mesh:
    points = np.array(corners, np.float64)
    return Mesh(points, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.full(2, material, np.int32), role)


def box(centre, half, material: int, role: Role) -> Mesh:
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))], np.int32)
    return Mesh(signs * half + centre, triangles, np.full(len(triangles), material, np.int32), role)


def look_at(eye, target) -> Camera:
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, (0, 1, 0))
    right /= np.linalg.norm(right)
    to_world = np.eye(4)
    to_world[:3] = np.stack([right, np.cross(right, forward), -forward, eye], 1)
    y = np.tan(FOV_Y / 2)
    x = y * WIDTH / HEIGHT
    return Camera(to_world, -x, x, -y, y)


def stage(*lights: Light, material: Material = BLUE, half=(0.5, 0.6, 0.5)) -> Scene:
    """A floor and two walls, real, with a synthetic box between them."""
    meshes = (
        quad([[-2, 0, -1.5], [-2, 0, 2], [2, 0, 2], [2, 0, -1.5]], 0),
        quad([[-2, 0, -1.5], [2, 0, -1.5], [2, 2.5, -1.5], [-2, 2.5, -1.5]], 0),
        quad([[-2, 0, -1.5], [-2, 2.5, -1.5], [-2, 2.5, 2], [-2, 0, 2]], 1),
        box((0.1, half[1] + 0.1, 0.0), half, 2, Role.SYNTHETIC),
    )
    return Scene(meshes, (GREY, RED, material), (), lights, look_at(EYE, TARGET))


def smooth_dome(rotation=None) -> Light:
    """A dome with a broad bright spot off to one side and coloured gradients."""
    height, width = 128, 256
    theta, phi = np.meshgrid((np.arange(height) + 0.5) / height * np.pi, np.arange(width) / width * 2 * np.pi)
    spot = 5 * np.exp(4 * (np.sin(theta) * np.cos(phi - 2.2) - 1) + 2 * (np.cos(theta) - 0.4))
    texture = np.stack([0.3 + spot, 0.4 + 0.3 * np.cos(phi) * np.sin(theta) + spot, 0.6 + 0.5 * np.cos(theta)], -1)
    texture = np.transpose(texture, (1, 0, 2)).astype(np.float32)
    return Light(LightKind.DOME, (0.8, 1.0, 1.2), texture=texture, rotation=np.eye(3) if rotation is None else rotation)


POINT = Light(LightKind.POINT, (9.0, 8.0, 7.0), position=(0.9, 2.2, 1.0))
SPHERE = Light(LightKind.SPHERE, (30.0, 25.0, 20.0), position=(0.9, 2.4, 0.9), radius=0.25)
RECT = Light(
    LightKind.RECT, (9, 8, 7), position=(0.8, 2.6, 0.8), axis_x=(0.6, 0, 0), axis_y=(0, 0, -0.4), direction=(0, -1, 0)
)
DISK = Light(
    LightKind.DISK, (9, 8, 7), position=(0.8, 2.6, 0.8), axis_x=(0.5, 0, 0), axis_y=(0, 0, -0.5), direction=(0, -1, 0)
)
SUN = tuple(np.array([-0.5, -0.8, -0.45]) / np.linalg.norm([-0.5, -0.8, -0.45]))
DISTANT = Light(LightKind.DISTANT, (150.0, 140.0, 120.0), direction=SUN, angle=0.2)
DIRECTIONAL = Light(LightKind.DISTANT, (3.0, 2.5, 2.0), direction=SUN)
SPOT = Light(
    LightKind.POINT, (9, 8, 7), position=(0.9, 2.4, 1.0), direction=(-0.4472135955, -0.894427191, 0.0), cone_angle=0.5
)
DOME = Light(LightKind.DOME, (0.8, 1.0, 1.2))
TURN = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
TURNED_DOME = smooth_dome(TURN)


def mitsuba_light(mi, light: Light) -> dict:
    """The same light as a Mitsuba plugin description."""
    transform = mi.ScalarTransform4f
    rgb = {"type": "rgb", "value": [float(v) for v in light.radiance]}
    emitter = {"type": "area", "radiance": rgb}
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    position, direction = list(map(float, light.position)), np.array(light.direction, float)
    if light.kind == LightKind.POINT and light.cone_angle < np.pi:
        towards = list(map(float, np.array(position) + direction))
        degrees = float(np.degrees(light.cone_angle))
        look = transform().look_at(position, towards, [0, 0, 1])
        return {
            "type": "spot",
            "to_world": look,
            "intensity": rgb,
            "cutoff_angle": degrees,
            "beam_width": degrees - 0.01,
        }
    if light.kind == LightKind.POINT:
        return {"type": "point", "position": position, "intensity": rgb}
    if light.kind == LightKind.SPHERE:
        return {"type": "sphere", "center": position, "radius": light.radius, "emitter": emitter, "bsdf": black}
    if light.kind in (LightKind.RECT, LightKind.DISK):
        columns = np.eye(4)
        columns[:3] = np.stack([light.axis_x, light.axis_y, direction, light.position], 1)
        shape = "rectangle" if light.kind == LightKind.RECT else "disk"
        return {"type": shape, "to_world": transform(columns), "emitter": emitter, "bsdf": black}
    if light.kind == LightKind.DISTANT and light.angle == 0.0:
        return {"type": "directional", "direction": list(map(float, direction)), "irradiance": rgb}
    if light.kind == LightKind.DISTANT:
        far = 1.0e4
        centre = list(map(float, -direction * far))
        look = transform().look_at(centre, [0, 0, 0], [0, 0, 1]) @ transform().scale(
            float(far * np.tan(light.angle / 2))
        )
        return {"type": "disk", "to_world": look, "emitter": emitter, "bsdf": black}
    if light.texture is None:
        return {"type": "constant", "radiance": rgb}
    turn = np.eye(4)
    turn[:3, :3] = light.rotation
    pixels = mi.Bitmap(np.ascontiguousarray(light.texture * np.float32(light.radiance)))
    return {"type": "envmap", "bitmap": pixels, "to_world": transform(turn)}


def mitsuba_material(material: Material) -> dict:
    if material.metallic == 1.0:
        assert material.base_color == (1.0, 1.0, 1.0)  # Schlick with f0 = 1: no Fresnel on either side
        bsdf = {"type": "roughconductor", "material": "none", "alpha": material.roughness**2, "distribution": "ggx"}
    else:
        reflectance = {"type": "rgb", "value": list(material.base_color)}
        bsdf = {"type": "diffuse", "reflectance": reflectance}
    return {"type": "twosided", "bsdf": bsdf}


def mitsuba_render(mi, folder, scene: Scene, roles, bounces: int, samples: int) -> np.ndarray:
    """The picture of the meshes of some roles, shape [h, w, 3]; finite lights hidden from the camera."""
    dome = any(light.kind == LightKind.DOME for light in scene.lights)
    look = mi.ScalarTransform4f().look_at(list(EYE), list(TARGET), [0, 1, 0])
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    film |= {"pixel_format": "rgb", "component_format": "float32"}
    fov = float(np.degrees(FOV_Y))
    sensor = {"type": "perspective", "fov": fov, "fov_axis": "y", "to_world": look, "film": film}
    description = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": bounces + 2, "rr_depth": 100, "hide_emitters": not dome},
        "sensor": sensor | {"sampler": {"type": "independent", "sample_count": samples}},
    }
    for i, mesh in enumerate(scene.meshes):
        if mesh.role in roles:
            path = folder / f"mesh{i}.obj"
            lines = [f"v {p[0]} {p[1]} {p[2]}" for p in mesh.points]
            lines += [f"f {a} {b} {c}" for a, b, c in mesh.triangles + 1]
            path.write_text("\n".join(lines) + "\n")
            bsdf = mitsuba_material(scene.materials[mesh.materials[0]])
            description[f"mesh{i}"] = {"type": "obj", "filename": str(path), "face_normals": True, "bsdf": bsdf}
    for i, light in enumerate(scene.lights):
        description[f"light{i}"] = mitsuba_light(mi, light)
    return np.array(mi.render(mi.load_dict(description)))[..., :3]


def compare(mi, launcher: Launcher, folder, scene: Scene, bounces: int, samples: int = 400) -> None:
    """Before everywhere, after where the pixel is all object or all real surface: means within TOLERANCE."""
    # A moved and scaled volume space must not change a thing.
    device_scene = DeviceScene.upload(launcher, scene, np.array([-2.0, -0.5, -2.5]), 0.2)
    ours = path_trace(launcher, device_scene, scene, WIDTH, HEIGHT, samples=samples, bounces=bounces)
    before = ours.before.numpy().reshape(HEIGHT, WIDTH, 3)
    synthetic = ours.synthetic.numpy().reshape(HEIGHT, WIDTH, 4)
    coverage = synthetic[..., 3:]
    after = np.where(coverage == 1.0, synthetic[..., :3], before + ours.delta.numpy().reshape(HEIGHT, WIDTH, 3))
    whole = (coverage == 0.0) | (coverage == 1.0)
    assert 0.05 < (coverage == 1.0).mean() < 0.5
    truth_before = mitsuba_render(mi, folder, scene, [Role.REAL], bounces, samples)
    truth_after = mitsuba_render(mi, folder, scene, [Role.REAL, Role.SYNTHETIC], bounces, samples)
    object_pixels = np.broadcast_to(coverage == 1.0, after.shape)
    real_pixels = np.broadcast_to(coverage == 0.0, after.shape)
    np.testing.assert_allclose(before.mean((0, 1)), truth_before.mean((0, 1)), rtol=TOLERANCE)
    np.testing.assert_allclose(
        np.where(whole, after, 0).mean((0, 1)), np.where(whole, truth_after, 0).mean((0, 1)), rtol=TOLERANCE
    )
    for part in (object_pixels, real_pixels):
        assert after[part].mean() == pytest.approx(truth_after[part].mean(), rel=2 * TOLERANCE)


LIGHTS = {
    "point": POINT,
    "sphere": SPHERE,
    "rect": RECT,
    "disk": DISK,
    "distant": DISTANT,
    "directional": DIRECTIONAL,
    "spot": SPOT,
    "dome": DOME,
    "textured dome": TURNED_DOME,
}


@pytest.mark.parametrize("name", LIGHTS)
def test_each_light_with_one_bounce_agrees_with_mitsuba(name, mi, launcher, tmp_path):
    compare(mi, launcher, tmp_path, stage(LIGHTS[name]), bounces=1)


@pytest.mark.parametrize("bounces", [0, 3, 12])
def test_any_number_of_bounces_agrees_with_mitsuba(bounces, mi, launcher, tmp_path):
    compare(mi, launcher, tmp_path, stage(RECT), bounces)


def test_several_lights_add_up_as_in_mitsuba(mi, launcher, tmp_path):
    compare(mi, launcher, tmp_path, stage(POINT, DIRECTIONAL, TURNED_DOME), bounces=2)


@pytest.mark.parametrize("roughness", [0.2, 0.5])
@pytest.mark.parametrize("name", ["sphere", "textured dome"])
def test_a_rough_metal_agrees_with_mitsuba(roughness, name, mi, launcher, tmp_path):
    metal = Material(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=roughness)
    compare(mi, launcher, tmp_path, stage(LIGHTS[name], material=metal), bounces=1)  # more are mostly caustic noise

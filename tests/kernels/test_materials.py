"""Surfaces and BRDF: furnace, reciprocity, sampling densities, a NumPy twin, textures and normals."""

import numpy as np
import pytest
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels.geometry import FAR, Geometry, Hit, trace_all
from warp_dvct.kernels.materials import (
    Materials,
    Surface,
    brdf_cos,
    brdf_cos_diffuse,
    brdf_cos_specular,
    brdf_pdf,
    brdf_sample,
    hemispherical_albedo,
    hemispherical_albedo_diffuse,
    hemispherical_albedo_specular,
    surface_at,
    texture_at,
)
from warp_dvct.kernels.sampling import sobol1, sobol2
from warp_dvct.scene import Camera, Material, Mesh, Role, Scene, Texture, Wrap

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def _evaluate_brdf(
    first: int,
    geo: Geometry,
    mats: Materials,
    triangle_in: wp.array(dtype=int),
    wo_in: wp.array(dtype=wp.vec3),
    wi_in: wp.array(dtype=wp.vec3),
    diffuse_out: wp.array(dtype=wp.vec3),
    specular_out: wp.array(dtype=wp.vec3),
    pdf_out: wp.array(dtype=float),
    sampled_out: wp.array(dtype=wp.vec3),
    estimate_out: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    s = centre_surface(geo, mats, triangle_in[i], wo_in[i])
    diffuse_out[i] = brdf_cos_diffuse(s, wo_in[i], wi_in[i])
    specular_out[i] = brdf_cos_specular(s, wo_in[i], wi_in[i])
    pdf_out[i] = brdf_pdf(s, wo_in[i], wi_in[i])
    wi = brdf_sample(s, wo_in[i], sobol1(1, 0, i, 0), sobol2(1, 0, i, 1))
    sampled_out[i] = wi
    pdf = brdf_pdf(s, wo_in[i], wi)
    estimate_out[i] = wp.vec3(0.0, 0.0, 0.0)
    if pdf > 0.0:
        estimate_out[i] = brdf_cos(s, wo_in[i], wi) / pdf


@wp.kernel
def _reflect_uniform_light(
    first: int,
    geo: Geometry,
    mats: Materials,
    triangle_in: wp.array(dtype=int),
    diffuse_out: wp.array(dtype=wp.vec3),
    specular_out: wp.array(dtype=wp.vec3),
    both_out: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    s = centre_surface(geo, mats, triangle_in[i], wp.vec3(0.0, 0.0, 1.0))
    diffuse_out[i] = hemispherical_albedo_diffuse(s)
    specular_out[i] = hemispherical_albedo_specular(s)
    both_out[i] = hemispherical_albedo(s)


@wp.func
def centre_surface(geo: Geometry, mats: Materials, triangle: int, wo: wp.vec3) -> Surface:
    """The middle of a triangle seen along ``wo``."""
    hit = Hit()
    hit.found = 1
    hit.triangle = triangle
    hit.u = 1.0 / 3.0
    hit.v = 1.0 / 3.0
    return surface_at(geo, mats, hit, wo, -wo)


@wp.kernel
def _look_up_texture(
    first: int,
    mats: Materials,
    texture_in: wp.array(dtype=int),
    uv_in: wp.array(dtype=wp.vec2),
    value_out: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    value_out[i] = texture_at(mats, texture_in[i], uv_in[i])


@wp.kernel
def _see_surface(
    first: int,
    geo: Geometry,
    mats: Materials,
    origin_in: wp.array(dtype=wp.vec3),
    direction_in: wp.array(dtype=wp.vec3),
    vectors_out: wp.array2d(dtype=wp.vec3),
    scalars_out: wp.array2d(dtype=float),
):
    i = first + wp.tid()
    hit = trace_all(geo, origin_in[i], direction_in[i], FAR)
    s = surface_at(geo, mats, hit, origin_in[i], direction_in[i])
    vectors_out[i, 0] = s.position
    vectors_out[i, 1] = s.normal_g
    vectors_out[i, 2] = s.normal
    vectors_out[i, 3] = s.diffuse
    vectors_out[i, 4] = s.f0
    scalars_out[i, 0] = s.alpha
    scalars_out[i, 1] = s.f90
    scalars_out[i, 2] = float(s.front)
    scalars_out[i, 3] = float(s.synthetic)


MATERIALS = (
    Material(base_color=(0.8, 0.5, 0.2), ior=1.0),
    Material(base_color=(1.0, 1.0, 1.0), ior=1.5, roughness=0.0),
    Material(base_color=(1.0, 1.0, 1.0), ior=1.5, roughness=0.3),
    Material(base_color=(1.0, 1.0, 1.0), ior=1.5, roughness=1.0),
    Material(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=0.1),
    Material(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=0.6),
    Material(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=1.0),
    Material(base_color=(0.9, 0.6, 0.3), metallic=0.5, roughness=0.4, ior=1.8),
    Material(base_color=(1.0, 1.0, 1.0), specular_color=(0.3, 0.5, 0.9), roughness=0.5),
    Material(base_color=(0.5, 0.5, 0.5), specular_color=(0.004, 0.002, 0.0), roughness=0.7),
)
FLAT = np.array([[-1.0, -1.0, 0.0], [2.0, -1.0, 0.0], [-1.0, 2.0, 0.0]])  # its centre is the origin, its front +z


def upload(launcher, meshes, materials, textures=()):
    scene = Scene(tuple(meshes), tuple(materials), tuple(textures), (), Camera(np.eye(4), -1, 1, -1, 1))
    return DeviceScene.upload(launcher, scene, np.zeros(3), 1.0)


@pytest.fixture(scope="module")
def samples_scene(launcher):
    """One triangle per entry of MATERIALS."""
    count = len(MATERIALS)
    points = np.tile(FLAT, (count, 1))
    triangles = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    return upload(launcher, [Mesh(points, triangles, np.arange(count, dtype=np.int32), Role.REAL)], MATERIALS)


def evaluate(launcher, scene, material, wo, wi):
    n = max(len(np.atleast_2d(wo)), len(np.atleast_2d(wi)))
    out = [launcher.empty(n, t) for t in (wp.vec3, wp.vec3, wp.float32, wp.vec3, wp.vec3)]
    vectors = [launcher.array(np.broadcast_to(w, (n, 3)).astype(np.float32), wp.vec3) for w in (wo, wi)]
    index = launcher.array(np.full(n, material, np.int32), wp.int32)
    launcher.launch(_evaluate_brdf, n, [scene.geometry, scene.materials, index, *vectors], out)
    return [o.numpy().astype(np.float64) for o in out]


def towards(cos, phi=0.3):
    sin = np.sqrt(1 - np.square(cos))
    return np.stack(np.broadcast_arrays(sin * np.cos(phi), sin * np.sin(phi), cos), -1)


def hemisphere_grid(n=512):
    """Directions of equal solid angle over the upper hemisphere."""
    u = (np.arange(n) + 0.5) / n
    cos, phi = np.meshgrid(u, 2 * np.pi * u, indexing="ij")
    return towards(cos, phi).reshape(-1, 3)


def twin(material: Material, wo, wi):
    """scene.Material's BRDF times the cosine, both lobes, in float64 and written from its documentation."""
    base, n = np.array(material.base_color), np.array([0, 0, 1.0])
    if material.specular_color is not None:
        f0 = np.array(material.specular_color)
    else:
        dielectric = ((material.ior - 1) / (material.ior + 1)) ** 2
        f0 = dielectric * (1 - material.metallic) + base * material.metallic
    f90 = min(50 * f0.max(), 1.0)
    alpha = max(material.roughness**2, 1e-3)

    def schlick(cos):
        return f0 + (f90 - f0) * (1 - np.asarray(cos)[..., None]) ** 5

    ci, co = wi @ n, wo @ n
    diffuse = base * (1 - material.metallic) / np.pi * (1 - schlick(ci)) * (1 - schlick(co)) * ci[:, None]
    h = (wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    ch = h @ n
    d = alpha**2 / (np.pi * (ch**2 * (alpha**2 - 1) + 1) ** 2)

    def smith(cos):
        return (np.sqrt(1 + alpha**2 * (1 / cos**2 - 1)) - 1) / 2

    g = 1 / (1 + smith(ci) + smith(co))
    specular = schlick((h * wo).sum(-1)) * (d * g / (4 * ci * co) * ci)[:, None]
    return diffuse, specular


@pytest.mark.parametrize("material", range(len(MATERIALS)))
def test_the_brdf_is_the_documented_one(launcher, samples_scene, material):
    rng = np.random.default_rng(material)
    wo, wi = towards(rng.uniform(0.05, 1, 400), rng.uniform(0, 6, 400)), towards(rng.uniform(0.05, 1, 400), 3.0)
    diffuse, specular, _, _, _ = evaluate(launcher, samples_scene, material, wo, wi)
    expected = twin(MATERIALS[material], wo, wi)
    np.testing.assert_allclose(diffuse, expected[0], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(specular, expected[1], rtol=2e-3, atol=1e-6)
    if MATERIALS[material].ior == 1.0:
        assert not specular.any()


@pytest.mark.parametrize("material", range(len(MATERIALS)))
def test_white_furnace_no_surface_reflects_more_than_it_receives(launcher, samples_scene, material):
    for cos in (1.0, 0.7, 0.3, 0.1, 0.02):
        estimate = evaluate(launcher, samples_scene, material, np.tile(towards(cos), (65536, 1)), (0, 0, 1))[4]
        assert np.isfinite(estimate).all()
        assert estimate.min() >= 0.0
        assert estimate.mean(0).max() <= 1.0 + 1e-3
        rough = MATERIALS[material].roughness
        if rough > 0.35 or (rough > 0.2 and cos > 0.2):  # narrower lobes fall between the quadrature's directions
            wi = hemisphere_grid()
            diffuse, specular, pdf, _, _ = evaluate(launcher, samples_scene, material, towards(cos), wi)
            integral = (diffuse + specular).mean(0) * 2 * np.pi
            np.testing.assert_allclose(estimate.mean(0), integral, rtol=0.01, atol=2e-3)
            assert pdf.mean() * 2 * np.pi <= 1.0 + 5e-3


@pytest.mark.parametrize("material", range(len(MATERIALS)))
def test_the_brdf_is_reciprocal(launcher, samples_scene, material):
    rng = np.random.default_rng(1)
    a, b = (towards(rng.uniform(0.1, 1, 200), rng.uniform(0, 6, 200)) for _ in range(2))
    forth, back = (evaluate(launcher, samples_scene, material, *pair) for pair in ((a, b), (b, a)))
    f, g = forth[0] + forth[1], back[0] + back[1]
    np.testing.assert_allclose(f / b[:, 2:], g / a[:, 2:], rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("material", [0, 2, 3, 5, 7, 9])
@pytest.mark.parametrize("cos", [0.95, 0.4])
def test_directions_are_sampled_with_the_stated_density(launcher, samples_scene, material, cos):
    wi = hemisphere_grid()
    _, _, pdf, sampled, _ = evaluate(launcher, samples_scene, material, np.tile(towards(cos), (len(wi), 1)), wi)

    def cells(directions):
        z = np.clip((directions[:, 2] * 8).astype(int), 0, 7)
        phi = (np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) % 1 * 8).astype(int) % 8
        return z * 8 + phi

    above = sampled[:, 2] > 0
    counts = np.bincount(cells(sampled[above]), minlength=64)
    expected = np.bincount(cells(wi), weights=pdf, minlength=64) * 2 * np.pi
    assert expected.sum() == pytest.approx(above.sum(), rel=5e-3)  # the rest went below the surface
    # Sobol' points do better than Poisson noise; 4 of its standard deviations leave room for the quadrature's error.
    assert (np.abs(counts - expected) < 4 * np.sqrt(expected) + 0.01 * expected + 20).all()


def test_albedo_of_uniform_light_is_that_of_the_sampled_brdf(launcher, samples_scene):
    count = len(MATERIALS)
    out = [launcher.empty(count, wp.vec3) for _ in range(3)]
    index = launcher.array(np.arange(count, dtype=np.int32), wp.int32)
    launcher.launch(_reflect_uniform_light, count, [samples_scene.geometry, samples_scene.materials, index], out)
    diffuse, specular, both = (o.numpy() for o in out)
    np.testing.assert_allclose(both, diffuse + specular, rtol=1e-6)
    cosines, weights = np.polynomial.legendre.leggauss(16)
    for material in range(count):
        total = sum(
            w
            * 0.5
            * (c + 1)
            * evaluate(launcher, samples_scene, material, np.tile(towards(0.5 * (c + 1)), (32768, 1)), (0, 0, 1))[
                4
            ].mean(0)
            for c, w in zip(cosines, weights, strict=True)
        )
        np.testing.assert_allclose(both[material], total, atol=4e-3)
    np.testing.assert_allclose(diffuse[0], (0.8, 0.5, 0.2), rtol=1e-6)
    assert not specular[0].any()


@pytest.mark.parametrize("wrap", list(Wrap))
def test_textures_wrap_and_interpolate(launcher, wrap):
    rng = np.random.default_rng(8)
    other = Texture(rng.random((2, 3, 3), np.float32))
    texture = Texture(rng.random((5, 4, 3), np.float32), wrap_s=wrap, wrap_t=wrap)
    scene = upload(launcher, [], [Material()], [other, texture])
    uv = rng.uniform(-2.3, 3.3, (500, 2)).astype(np.float32)
    value = launcher.empty(500, wp.vec3)
    which = launcher.array(np.ones(500, np.int32), wp.int32)
    launcher.launch(_look_up_texture, 500, [scene.materials, which, launcher.array(uv, wp.vec2)], [value])
    mode = {Wrap.REPEAT: "wrap", Wrap.CLAMP: "edge", Wrap.MIRROR: "symmetric", Wrap.BLACK: "constant"}[wrap]
    padded = np.pad(texture.pixels, ((20, 20), (20, 20), (0, 0)), mode=mode)
    x, y = uv[:, 0] * 4 - 0.5 + 20, (1 - uv[:, 1].astype(np.float64)) * 5 - 0.5 + 20
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - i)[:, None], (y - j)[:, None]
    expected = (padded[j, i] * (1 - fx) + padded[j, i + 1] * fx) * (1 - fy)
    expected += (padded[j + 1, i] * (1 - fx) + padded[j + 1, i + 1] * fx) * fy
    np.testing.assert_allclose(value.numpy(), expected, atol=2e-5)


def see(launcher, scene, origins, directions):
    n = len(origins)
    vectors, scalars = launcher.empty((n, 5), wp.vec3), launcher.empty((n, 4), wp.float32)
    rays = [launcher.array(np.asarray(a, np.float32), wp.vec3) for a in (origins, directions)]
    launcher.launch(_see_surface, n, [scene.geometry, scene.materials, *rays], [vectors, scalars])
    return vectors.numpy(), scalars.numpy()


def test_a_textured_coloured_surface(launcher):
    """Row 0 of an image lies at v = 1, vertex colours multiply, textures replace constants."""
    pixels = np.zeros((2, 2, 3), np.float32)
    pixels[0, 0], pixels[0, 1], pixels[1, 0], pixels[1, 1] = (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)
    rough = Texture(np.full((1, 1, 3), 0.6, np.float32))
    material = Material(base_color=(9, 9, 9), roughness=0.1, ior=1.0, base_color_texture=0, roughness_texture=1)
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    mesh = Mesh(
        points,
        triangles,
        np.zeros(2, np.int32),
        Role.SYNTHETIC,
        corner_uvs=points[triangles][..., :2].astype(np.float32),
        corner_colors=np.full((2, 3, 3), (1.0, 0.5, 0.25), np.float32),
    )
    scene = upload(launcher, [mesh], [material], [Texture(pixels), rough])
    at = np.array([[0.25, 0.75], [0.75, 0.75], [0.25, 0.25], [0.75, 0.25]])
    vectors, scalars = see(launcher, scene, np.c_[at, np.ones(4)], np.tile([0, 0, -1.0], (4, 1)))
    expected = pixels.reshape(4, 3) * (1.0, 0.5, 0.25)
    np.testing.assert_allclose(vectors[:, 3], expected, atol=1e-5)
    np.testing.assert_allclose(vectors[:, 0], np.c_[at, np.zeros(4)], atol=1e-6)
    np.testing.assert_allclose(scalars, [[0.36, 0.0, 1.0, 1.0]] * 4, rtol=1e-5)


def test_normals_face_the_viewer_on_both_sides(launcher):
    tilt = np.array([0.6, 0.0, 0.8], np.float32)
    normals = np.broadcast_to(tilt, (1, 3, 3)).astype(np.float32)
    triangle = np.array([[0, 1, 2]], np.int32)
    smooth = Mesh(FLAT, triangle, np.zeros(1, np.int32), Role.REAL, corner_normals=normals)
    scene = upload(launcher, [smooth], [Material()])
    grazing = np.array([-0.9, 0, 0.1]) / np.linalg.norm([-0.9, 0, 0.1])
    eyes = np.array([[0, 0, 1.0], [0, 0, -1.0], grazing])
    vectors, scalars = see(launcher, scene, eyes, -eyes)
    np.testing.assert_allclose(vectors[:, 1], [[0, 0, 1], [0, 0, -1], [0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(vectors[:2, 2], [tilt, -tilt], atol=1e-6)
    assert scalars[:, 2].tolist() == [1.0, 0.0, 1.0]
    bent = vectors[2, 2]  # the interpolated normal faces away from this eye
    assert np.dot(tilt, grazing) < 0 < np.dot(bent, grazing)
    assert np.linalg.norm(bent) == pytest.approx(1.0, abs=1e-5)
    faceted = upload(launcher, [Mesh(FLAT, triangle, np.zeros(1, np.int32), Role.REAL)], [Material()])
    np.testing.assert_allclose(see(launcher, faceted, eyes, -eyes)[0][:, 2], vectors[:, 1], atol=1e-6)

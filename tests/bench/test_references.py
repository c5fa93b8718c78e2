"""Truths: traced once, found again, and never mixed up."""

from dataclasses import replace

import numpy as np
import pytest

from warp_dvct.bench import references
from warp_dvct.bench.references import ReferenceStore, combine, is_glossy, label_glossy, source_digest
from warp_dvct.errors import FileError, OptionError
from warp_dvct.scene import Camera, Light, LightKind, Material, Mesh, Role, Scene

SIZE = (16, 12)


def box(low, high, role, material, path):
    """A closed box of outward triangles."""
    corners = np.array(
        [[x, y, z] for z in (low[2], high[2]) for y in (low[1], high[1]) for x in (low[0], high[0])], float
    )
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    return Mesh(corners, triangles, np.full(12, material, np.int32), role, path=path)


@pytest.fixture
def scene():
    """A small box on a wide one, seen from above at an angle, under a distant light and a constant dome."""
    to_world = np.eye(4)
    to_world[:3, :3] = [[1, 0, 0], [0, 0.8, 0.6], [0, -0.6, 0.8]]
    to_world[:3, 3] = (0, 2.4, 3.2)
    return Scene(
        meshes=(
            box((-2, -0.2, -2), (2, 0, 2), Role.REAL, 0, "/floor"),
            box((-0.4, 0, -0.4), (0.4, 0.8, 0.4), Role.SYNTHETIC, 1, "/crate"),
        ),
        materials=(
            Material(base_color=(0.6, 0.6, 0.6), specular_color=(0, 0, 0), name="floor"),
            Material(base_color=(0.7, 0.2, 0.1), specular_color=(0, 0, 0), name="crate"),
        ),
        textures=(),
        lights=(
            Light(LightKind.DISTANT, (2.0, 2.0, 2.0), direction=(0.6, -0.8, 0.0)),
            Light(LightKind.DOME, (0.3, 0.3, 0.3)),
        ),
        camera=Camera(to_world, -0.6, 0.6, -0.45, 0.45),
    )


@pytest.fixture
def make_store(scene, launcher, tmp_path):
    def make(other=scene, **options):
        options = {"samples": 8, "seed": 1, "cache": tmp_path, "launcher": launcher, "quiet": True, **options}
        return ReferenceStore(other, *SIZE, **options)

    return make


def test_a_truth_is_traced_once_and_then_read(make_store, tmp_path, monkeypatch):
    first = make_store().get(1)
    assert [f.suffix for f in tmp_path.iterdir()] == [".npz"]
    monkeypatch.setattr(ReferenceStore, "_trace", lambda *_: pytest.fail("traced again"))
    again = make_store().get(1)
    for name in ("before", "delta", "synthetic"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert again.noise == first.noise > 0


def test_a_damaged_file_is_traced_again(make_store, tmp_path):
    first = make_store().get(0)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:200])
    np.testing.assert_array_equal(make_store().get(0).comp, first.comp)


def test_key_changes_with_all_that_changes_the_picture(make_store, scene, monkeypatch):
    key = make_store().key(1)
    moved = replace(scene.meshes[1], points=scene.meshes[1].points + 1e-6)
    dimmed = replace(scene.lights[0], radiance=(1.9, 2.0, 2.0))
    painted = replace(scene.materials[0], roughness=0.4)
    others = [
        make_store().key(2),
        make_store(seed=2).key(1),
        make_store(samples=10).key(1),
        make_store(replace(scene, meshes=(scene.meshes[0], moved))).key(1),
        make_store(replace(scene, meshes=(scene.meshes[0], replace(scene.meshes[1], role=Role.REAL)))).key(1),
        make_store(replace(scene, lights=(dimmed, scene.lights[1]))).key(1),
        make_store(replace(scene, materials=(painted, scene.materials[1]))).key(1),
        make_store(replace(scene, camera=replace(scene.camera, tan_left=-0.61))).key(1),
    ]
    monkeypatch.setattr(references, "source_digest", lambda *_: "other code")
    others.append(make_store().key(1))
    assert len({key, *others}) == 10
    renamed = replace(scene.materials[0], name="renamed")
    monkeypatch.undo()
    assert make_store(replace(scene, materials=(renamed, scene.materials[1]))).key(1) == key, "a label is no content"


def test_source_digest_covers_the_kernels_that_are_imported(monkeypatch):
    """The tracer's digest changes when a kernel file that only its imports import changes."""
    before = source_digest("warp_dvct.methods.path_tracing")
    original = references._source_file
    read = []

    def record(name):
        file = original(name)
        if file is not None:
            read.append(file.name)
        return file

    monkeypatch.setattr(references, "_source_file", record)
    assert source_digest("warp_dvct.methods.path_tracing") == before
    assert {"path_tracing.py", "lights.py", "materials.py", "geometry.py"} <= set(read)
    assert source_digest("warp_dvct.device_scene") != before


def test_truth_is_what_it_says(make_store):
    """Zero bounces: the lit floor's radiance, the box's coverage, and no light where there is no object."""
    truth = make_store(samples=64).get(0)
    corner = truth.before[-1, 0]  # floor, far from the crate, lit by sun and dome
    np.testing.assert_allclose(corner, 0.6 / np.pi * (2 * 0.8 + 0.3 * np.pi), rtol=0.08)
    assert 0.05 < truth.coverage.mean() < 0.4
    assert truth.delta.min() < -0.2, "the crate's shadow"
    assert truth.delta[truth.coverage == 1].max() == 0
    np.testing.assert_allclose(truth.comp[truth.coverage == 1], truth.synthetic[..., :3][truth.coverage == 1])


def test_delta_at_silhouettes_is_weighted_by_the_real_part(make_store):
    """No more light can be lost than the visible part of the floor had: else objects get a black rim."""
    truth = make_store(samples=256).get(0)
    lit = 0.6 / np.pi * (2 * 0.8 + 0.3 * np.pi)
    part = (1 - truth.coverage)[..., None]
    rim = (part > 0) & (part < 1)
    assert rim.sum() > 10
    assert (np.where(rim, truth.delta, 0) >= -1.02 * lit * part).all()
    assert (np.where(rim, truth.delta / np.maximum(part, 1e-6), 0) < -0.5 * lit).any(), (
        "a rim in the shadow is among them"
    )


def test_noise_falls_with_samples(make_store):
    assert make_store(samples=64).get(1).noise < 0.7 * make_store(samples=4).get(1).noise


def test_combine():
    synthetic = np.array([[[0.1, 0.2, 0.3, 0.25], [0, 0, 0, 0]]])
    plate = np.full((1, 2, 3), 0.4)
    delta = np.array([[[0.0, 0.0, 0.0], [-0.5, 0.1, -0.1]]])
    np.testing.assert_allclose(combine(plate, delta, synthetic)[0], [[0.4, 0.5, 0.6], [0, 0.5, 0.3]], atol=1e-6)


def test_glossy_mask_shows_real_glossy_surfaces_only(make_store, scene):
    assert not make_store().glossy_mask().any()
    shiny = tuple(replace(m, specular_color=None, metallic=0.5, roughness=0.2) for m in scene.materials)
    store = make_store(replace(scene, materials=shiny))
    mask = store.glossy_mask()
    truth = store.get(0)
    assert mask[-1, 0]
    assert not mask[truth.coverage == 1].any(), "the crate is shiny, but not real"


def test_a_material_shared_by_both_roles_is_labelled_for_each(scene):
    shared = (replace(scene.materials[0], specular_color=None, roughness=0.1),)
    meshes = tuple(replace(m, materials=np.zeros(12, np.int32)) for m in scene.meshes)
    labelled = label_glossy(replace(scene, meshes=meshes, materials=shared))
    colours = {m.role: labelled.materials[m.materials[0]].base_color[0] for m in labelled.meshes}
    assert colours == {Role.REAL: 1.0, Role.SYNTHETIC: 0.0}


@pytest.mark.parametrize(
    ("material", "glossy"),
    [
        (Material(specular_color=(0, 0, 0), roughness=0.1), False),
        (Material(specular_color=(0, 0.1, 0), roughness=0.1), True),
        (Material(roughness=0.6), False),
        (Material(roughness=0.2), True),
        (Material(ior=1.0, roughness=0.2), False),
        (Material(ior=1.0, metallic=0.3, roughness=0.2), True),
        (Material(roughness=0.6, roughness_texture=0), True),
    ],
)
def test_is_glossy(material, glossy):
    assert is_glossy(material) is glossy


def test_no_samples_are_refused(make_store):
    with pytest.raises(OptionError, match="--spp is 0"):
        make_store(samples=0)


def test_an_unwritable_cache_is_named(make_store, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(FileError, match=f"{blocked}.*--cache"):
        make_store(cache=blocked).get(0)

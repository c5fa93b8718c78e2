"""The bundled stages: what is committed is what the script makes, valid, tagged, and openable anywhere."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from pxr import Usd, UsdGeom, UsdLux, UsdRender, UsdShade, UsdUtils, UsdValidation

from warp_dvct import usd_scenes
from warp_dvct.errors import FileError, OptionError
from warp_dvct.usd_scenes import make

STAGES = ["bunny", "colour_bleeding", "double_shadow", "furnace", "ground_dome"]
STAGES += ["room_area", "room_glossy", "room_spot", "thin_wall"]


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def open_stage(name):
    return Usd.Stage.Open(str(usd_scenes.path(name)))


def test_names():
    assert usd_scenes.names() == STAGES
    assert set(make.stages()) == set(STAGES)


def test_committed_files_are_what_the_script_makes(tmp_path):
    written = make.write_all(tmp_path)
    assert {p.name for p in written} == {p.name for p in usd_scenes.FOLDER.iterdir() if p.suffix in (".usda", ".exr")}
    for made in written:
        committed = usd_scenes.FOLDER / made.name
        if made.suffix == ".usda":
            assert made.read_bytes() == committed.read_bytes(), f"run python -m warp_dvct.usd_scenes.make ({made.name})"
        else:  # the header's bytes belong to the EXR library's version
            pixels = [OpenEXR.File(str(p)).channels()["RGB"].pixels for p in (made, committed)]
            assert pixels[0].dtype == np.float16
            np.testing.assert_array_equal(*pixels)


@pytest.mark.parametrize("name", STAGES)
def test_stage_passes_usd_validation(name):
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(open_stage(name))
    assert [e.GetMessage() for e in errors] == []


@pytest.mark.parametrize("name", STAGES)
def test_stage_is_complete(name):
    stage = open_stage(name)
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    settings = UsdRender.Settings.GetStageRenderSettings(stage)
    assert tuple(settings.GetResolutionAttr().Get()) == (640, 360)
    assert settings.GetCameraRel().GetTargets() == ["/World/Camera"]
    assert [
        UsdRender.Product(stage.GetPrimAtPath(p)).GetProductNameAttr().Get()
        for p in settings.GetProductsRel().GetTargets()
    ] == [f"{name}.exr"]
    aspect = [
        stage.GetPrimAtPath("/World/Camera").GetAttribute(f"{a}Aperture").Get() for a in ("horizontal", "vertical")
    ]
    assert aspect[0] / aspect[1] == pytest.approx(16 / 9)
    assert any(p.HasAPI(UsdLux.LightAPI) for p in stage.Traverse())


@pytest.mark.parametrize("name", STAGES)
def test_every_shape_has_a_role_a_material_and_no_subdivision(name):
    stage = open_stage(name)
    shapes = [p for p in stage.Traverse() if p.IsA(UsdGeom.Gprim)]
    roles = {UsdGeom.PrimvarsAPI(p).FindPrimvarWithInheritance("dvct:reality").Get() for p in shapes}
    assert roles == {"real", "synthetic"}
    for shape in shapes:
        material, _ = UsdShade.MaterialBindingAPI(shape).ComputeBoundMaterial()
        assert material, shape.GetPath()
        source = material.ComputeSurfaceSource()[0]
        assert source.GetIdAttr().Get() == "UsdPreviewSurface"
        if shape.IsA(UsdGeom.Mesh):
            assert UsdGeom.Mesh(shape).GetSubdivisionSchemeAttr().Get() == "none"


@pytest.mark.parametrize("name", STAGES)
def test_dependencies_resolve(name):
    _, _, unresolved = UsdUtils.ComputeAllDependencies(str(usd_scenes.path(name)))
    assert list(unresolved) == []


@pytest.mark.parametrize("name", [n for n in STAGES if n.startswith("room") or n in ("bunny", "thin_wall")])
def test_walls_face_inwards(name):
    """Each wall's normal points to the room's centre: a one-sided wall seen from behind would be missing."""
    stage = open_stage(name)
    centre = np.array([0, make.TOP / 2, (make.FRONT + make.BACK) / 2])
    for wall in ("Floor", "Ceiling", "BackWall", "FrontWall", "LeftWall", "RightWall"):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/Real/{wall}"))
        points = np.array(mesh.GetPointsAttr().Get(), float)[list(mesh.GetFaceVertexIndicesAttr().Get())]
        normal = np.cross(points[1] - points[0], points[2] - points[0])
        assert normal @ (centre - points.mean(0)) > 0, wall


def test_objects_stand_on_something():
    """Lowest point of each synthetic prim: on the floor, on the table's top, or hanging as its stage says."""
    expected = {"bunny": 0.5, "double_shadow": 0.82}
    for name in STAGES:
        stage = open_stage(name)
        cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"])
        for prim in stage.GetPrimAtPath("/World/Synthetic").GetChildren():
            low = cache.ComputeWorldBound(prim).ComputeAlignedRange().GetMin()[1]
            assert low == pytest.approx(expected.get(name, 0.0), abs=1e-5), prim.GetPath()


def test_furnace_parts_touch_without_a_gap():
    stage = open_stage("furnace")
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"])

    def extent(path):
        box = cache.ComputeWorldBound(stage.GetPrimAtPath(path)).ComputeAlignedRange()
        return np.array(box.GetMin()), np.array(box.GetMax())

    left, middle, right = (extent(f"/World/{p}") for p in ("Synthetic/Left", "Real/Middle", "Synthetic/Right"))
    assert left[1][0] == pytest.approx(middle[0][0])
    assert middle[1][0] == pytest.approx(right[0][0])
    for part in (left, right):
        np.testing.assert_allclose(part[0][1:], middle[0][1:], atol=1e-6)
        np.testing.assert_allclose(part[1][1:], middle[1][1:], atol=1e-6)


def test_bunny_is_found_from_any_folder(tmp_path):
    """The composed stage opens in a process that knows nothing of this package."""
    file = usd_scenes.path("bunny")
    assert file == usd_scenes.path("bunny"), "a second call gives the same file"
    mesh = "/World/Synthetic/Bunny/bunny"
    code = (
        f"from pxr import Usd; stage = Usd.Stage.Open({str(file)!r});"
        f" print(len(stage.GetPrimAtPath({mesh!r}).GetAttribute('points').Get()))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert int(done.stdout) == 6102
    assert [p.name for p in file.parent.iterdir()] == ["bunny.usda"], "no temporary file is left"


def test_a_damaged_cached_stage_is_written_again():
    file = usd_scenes.path("bunny")
    text = file.read_text()
    file.write_text("#usda 1.0\n")
    assert usd_scenes.path("bunny").read_text() == text


def test_bunny_with_an_unwritable_cache(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    with pytest.raises(FileError, match=r"bunny.*XDG_CACHE_HOME"):
        usd_scenes.path("bunny")


def test_unknown_stage_suggests_the_nearest():
    with pytest.raises(
        OptionError, match=r"'room_aera'; did you mean 'room_area'\? bundled are bunny, colour_bleeding"
    ):
        usd_scenes.path("room_aera")
    with pytest.raises(OptionError, match=r"'zzz'; bundled are bunny"):
        usd_scenes.path("zzz")


def test_readme_has_a_section_per_stage():
    text = (usd_scenes.FOLDER / "README.md").read_text(encoding="utf-8")
    sections = [line[3:] for line in text.splitlines() if line.startswith("## ")]
    assert sorted(sections) == STAGES
    for section in text.split("\n## ")[1:]:
        assert "*Intent:*" in section
        assert "*Known:*" in section


def test_asking_for_a_stage_loads_no_usd():
    code = "import sys, warp_dvct.usd_scenes as s; s.path('room_area'); sys.exit('pxr' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path.home())

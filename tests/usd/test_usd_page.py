"""docs/usd.md names what the reader draws, and nothing that it does not."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pxr import Sdf, UsdLux, UsdShade

from warp_dvct.usd.collect import DRAWN
from warp_dvct.usd.lights import READERS, TUBE_FACES
from warp_dvct.usd.materials import NOT_MODELLED
from warp_dvct.usd.refine import COMPLEXITIES, MOST_FACES

PAGE = (Path(__file__).parents[2] / "docs" / "usd.md").read_text()


def test_every_prim_and_light_that_is_drawn_is_named():
    for name in (*DRAWN, *READERS):
        assert re.search(rf"\b{name.removesuffix('_1').removesuffix('Light')}\b", PAGE), name
    for name in (*NOT_MODELLED, *COMPLEXITIES):
        assert f"`{name}`" in PAGE or f"--complexity {name}" in PAGE, name


def test_numbers_are_those_of_the_code():
    assert "at most half a million faces" in PAGE
    assert MOST_FACES == 2**19
    assert f"prism of {'eight'} RectLights" in PAGE
    assert TUBE_FACES == 8


@pytest.mark.parametrize("kind", ["BasisCurves", "Volume", "TetMesh", "NurbsPatch"])
def test_prims_that_are_not_drawn_are_listed(build, kind):
    build.stage.DefinePrim("/World/Odd", kind)
    assert [n.path for n in build.read().notices] == ["/World/Odd"]


def test_inputs_that_are_left_out_are_listed(build):
    shader = build.material(bind=build.quad())
    other = {"normal": (0.0, 0.5, 0.5), "emissiveColor": (1.0, 0.0, 0.0)}
    for name in NOT_MODELLED:
        value = other.get(name, 0.5)
        kind = Sdf.ValueTypeNames.Float if isinstance(value, float) else Sdf.ValueTypeNames.Float3
        shader.CreateInput(name, kind).Set(value)
    told = " ".join(n.message for n in build.read().notices)
    for name in NOT_MODELLED:
        assert f"{name} is not modelled" in told


def test_lights_inputs_that_are_left_out_are_listed(build):
    light = UsdLux.SphereLight.Define(build.stage, "/World/Lamp")
    UsdLux.ShapingAPI.Apply(light.GetPrim()).CreateShapingFocusAttr(2.0)
    UsdLux.ShadowAPI.Apply(light.GetPrim()).CreateShadowEnableAttr(False)
    dome = UsdLux.DomeLight.Define(build.stage, "/World/Sky")
    dome.CreatePortalsRel().SetTargets(["/World/Lamp"])
    light.CreateFiltersRel().SetTargets(["/World/Sky"])
    told = " ".join(str(n) for n in build.read().notices)
    for words in ("shaping:focus", "inputs:shadow:enable", "portals", "light filters"):
        assert words in told


def test_a_material_of_another_renderer_alone_is_listed(build):
    mesh = build.quad()
    material = UsdShade.Material.Define(build.stage, "/World/Looks/Other")
    shader = UsdShade.Shader.Define(build.stage, "/World/Looks/Other/Surface")
    shader.CreateIdAttr("ND_standard_surface_surfaceshader")
    material.CreateSurfaceOutput("mtlx").ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    assert "has no UsdPreviewSurface" in str(build.read().notices[0])

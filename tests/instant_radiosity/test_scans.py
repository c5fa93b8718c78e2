"""UsdGeom.Points in a stage: a scan's points shade by imperfect shadow maps."""

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdLux

from warp_dvct.relighter import Relighter


def stage_with_a_scanned_disc(count, role="synthetic"):
    """A floor seen from above under an even sky; a disc of points of radius 0.5 m, 0.3 m above it."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.AddTranslateOp().Set((0, 4, 0))
    camera.AddRotateXOp().Set(-90)
    camera.CreateFocalLengthAttr(20.0)
    camera.CreateHorizontalApertureAttr(20.0)
    camera.CreateVerticalApertureAttr(20.0)
    camera.CreateClippingRangeAttr((3.8, 100.0))  # past the points, which are not to hide what they shade
    UsdLux.DomeLight.Define(stage, "/World/Sky")
    for path, kind, corners in (
        ("/World/Floor", "real", [(-2, 0, 2), (2, 0, 2), (2, 0, -2), (-2, 0, -2)]),
        ("/World/Far", "synthetic", [(1, 0.01, 1.9), (1.9, 0.01, 1.9), (1.9, 0.01, 1), (1, 0.01, 1)]),
    ):
        mesh = UsdGeom.Mesh.Define(stage, path)
        mesh.CreatePointsAttr(corners)
        mesh.CreateFaceVertexCountsAttr([4])
        mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
        mesh.CreateSubdivisionSchemeAttr("none")
        tag(mesh, kind)
    if count:
        index = np.arange(count) + 0.5  # Vogel's spiral: even, as a scanner's points are
        radius, angle = 0.5 * np.sqrt(index / count), index * np.pi * (1 + np.sqrt(5))
        points = np.stack([radius * np.cos(angle), np.full(count, 0.3), radius * np.sin(angle)], -1)
        cloud = UsdGeom.Points.Define(stage, "/World/Scan")
        cloud.CreatePointsAttr([tuple(map(float, p)) for p in points])
        cloud.CreateNormalsAttr([(0, 1, 0)])
        cloud.CreateWidthsAttr([float(2 * np.sqrt(0.25 / count))])
        tag(cloud, role)
    return stage


def tag(prim, value):
    UsdGeom.PrimvarsAPI(prim).CreatePrimvar("dvct:reality", Sdf.ValueTypeNames.Token).Set(value)


def openness(layers):
    """Share of the sky's light that is left at the floor below the middle of the disc."""
    size = len(layers.shadow)
    middle = slice(size // 2 - 1, size // 2 + 1)
    return float(layers.shadow[middle, middle].mean())


def render(stage, **settings):
    values = {"bounces": 0, "vpls.sky": 1024, "vpls.tiles": 1, **{k.replace("__", "."): v for k, v in settings.items()}}
    return Relighter(stage, method="instant-radiosity", width=33, height=33, settings=values).render()


def test_a_synthetic_scan_shades_the_ground_by_the_share_of_sky_that_it_covers():
    """A disc of radius R at height h takes R² / (R² + h²) of the light of an even sky."""
    left = openness(render(stage_with_a_scanned_disc(4000)))
    covered = 0.25 / (0.25 + 0.09)
    assert abs(left - (1 - covered)) < 0.02  # 0.276 of 0.265, give or take 0.005 by the seed; exact rays find 0.278
    assert openness(render(stage_with_a_scanned_disc(0))) > 0.99


def test_a_real_scan_shades_both_pictures():
    """What it takes is missing before as well: nothing changes, and the picture before is darker below it."""
    real, without = render(stage_with_a_scanned_disc(4000, "real")), render(stage_with_a_scanned_disc(0))
    assert openness(real) > 0.97
    middle = slice(15, 18)
    ratio = real.plate[middle, middle].mean() / without.plate[middle, middle].mean()
    assert abs(ratio - 0.09 / 0.34) < 0.04

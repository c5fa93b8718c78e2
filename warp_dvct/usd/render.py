"""What UsdRender says about the picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warp_dvct.scene import Camera
from warp_dvct.usd.context import Context
from warp_dvct.usd.stage import open_stage, quiet_diagnostics

if TYPE_CHECKING:
    from pxr import Usd


def product_resolution(source: str | Path | Usd.Stage, camera: str) -> tuple[int, int] | None:
    """Width and height in pixels that the stage's render settings author for a camera.

    The first product of the settings named by ``renderSettingsPrimPath`` that is of this camera, or of none, decides;
    without one the settings themselves do. The schema's fallback of 2048 x 1080 is not a decision.

    Args:
        source: File or open stage.
        camera: Prim path of the camera.
    Returns:
        None where nothing is authored, or a size is not positive.
    """
    stage = open_stage(source)
    with quiet_diagnostics():
        found = _deciding(stage, camera)
        if found is None:
            return None
        width, height = (int(n) for n in found.GetResolutionAttr().Get())
        return (width, height) if width > 0 and height > 0 else None


def _deciding(stage: Usd.Stage, camera: str) -> Any:
    """The product, or the settings, whose resolution counts for a camera; None where none is authored."""
    from pxr import UsdRender

    settings = UsdRender.Settings.GetStageRenderSettings(stage)
    if not settings:
        return None
    products = (UsdRender.Product(stage.GetPrimAtPath(p)) for p in settings.GetProductsRel().GetForwardedTargets())
    for candidate in (*(product for product in products if product), settings):
        cameras = [str(path) for path in candidate.GetCameraRel().GetForwardedTargets()]
        if candidate.GetResolutionAttr().HasAuthoredValue() and (not cameras or camera in cameras):
            return candidate
    return None


def conform(camera: Camera, ctx: Context) -> Camera:
    """The camera with the shape of the picture that the stage's render settings ask for.

    As ``aspectRatioConformPolicy`` says: the aperture is expanded (the default, so that nothing is cut off) or cropped
    about its middle, in width or in height.
    """
    from pxr import UsdRender

    size = product_resolution(ctx.stage, camera.path)
    if size is None or abs(size[0] / camera.aspect - size[1]) <= 1.0:
        return camera
    found = _deciding(ctx.stage, camera.path)
    policy = found.GetAspectRatioConformPolicyAttr()
    if not policy.HasAuthoredValue():
        policy = UsdRender.Settings.GetStageRenderSettings(ctx.stage).GetAspectRatioConformPolicyAttr()
    wider = size[0] / size[1] / camera.aspect  # than the camera
    name = str(policy.Get())
    if name == "adjustPixelAspectRatio":
        ctx.notices.add(found.GetPath(), f"{name} is not modelled: pixels are square and the height follows the camera")
        return camera
    in_width = {"adjustApertureWidth": True, "adjustApertureHeight": False, "cropAperture": wider < 1.0}
    if in_width.get(name, wider > 1.0):
        left, right = _scaled(camera.tan_left, camera.tan_right, wider)
        return replace(camera, tan_left=left, tan_right=right)
    bottom, top = _scaled(camera.tan_bottom, camera.tan_top, 1.0 / wider)
    return replace(camera, tan_bottom=bottom, tan_top=top)


def _scaled(low: float, high: float, factor: float) -> tuple[float, float]:
    """A range scaled about its middle."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low) * factor
    return middle - half, middle + half

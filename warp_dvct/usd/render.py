"""What UsdRender says about the picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

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
    from pxr import UsdRender

    stage = open_stage(source)
    with quiet_diagnostics():
        settings = UsdRender.Settings.GetStageRenderSettings(stage)
        if not settings:
            return None
        products = (UsdRender.Product(stage.GetPrimAtPath(p)) for p in settings.GetProductsRel().GetForwardedTargets())
        for candidate in (*(product for product in products if product), settings):
            cameras = [str(path) for path in candidate.GetCameraRel().GetForwardedTargets()]
            resolution = candidate.GetResolutionAttr()
            if resolution.HasAuthoredValue() and (not cameras or camera in cameras):
                width, height = (int(n) for n in resolution.Get())
                return (width, height) if width > 0 and height > 0 else None
    return None

"""Direct light at shading points."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from warp_dvct.device_scene import DeviceScene
from warp_dvct.kernels import shading as kernels
from warp_dvct.launch import Launcher
from warp_dvct.plan import Plan


def direct_settings(plan: Plan, *, glossy_rays: int, with_before: bool) -> Any:
    """``kernels.shading.Direct`` of a plan.

    Args:
        glossy_rays: With which the specular pass shares the highlights; 0 where it traces none.
    """
    settings = plan.settings
    direct = kernels.Direct()
    direct.samples = settings.shadows_samples
    direct.edge_samples = max(1, settings.antialias)
    direct.probes = min(settings.shadows_probes, settings.shadows_samples)
    direct.glossy = glossy_rays
    direct.alpha_max = plan.alpha_max
    direct.with_before = int(with_before)
    direct.seed = settings.seed
    return direct


@contextmanager
def shade_direct_beside(
    launcher: Launcher, scene: DeviceScene, points: Any, count: int, direct: Any, *, light: Any, before: Any
) -> Iterator[None]:
    """As :func:`shade_direct` by shadow rays, beside what is done inside (:meth:`Launcher.beside`)."""
    inputs = [points, scene.geometry, scene.lights, direct]
    with launcher.beside(kernels._shade_direct, count, inputs, [light, before]):
        yield


def shade_direct(
    launcher: Launcher,
    scene: DeviceScene,
    points: Any,
    count: int,
    direct: Any,
    *,
    light: Any,
    before: Any,
    world: Any = None,
    cone: Any = None,
) -> None:
    """Write the direct light of ``count`` points to ``light`` (and ``before``), both vec3 ``[count]``.

    Args:
        direct: ``kernels.shading.Direct``.
        world, cone: Volumes and settings for shadow cones; exact shadow rays where ``cone`` is None.

    Franke 2014, eqs. 5 and 7: after on synthetic points, after - before on real ones. Domes are left to the gather.
    """
    if cone is None:
        with shade_direct_beside(launcher, scene, points, count, direct, light=light, before=before):
            pass
    else:
        launcher.launch(
            kernels._shade_direct_cones,
            count,
            [points, world.fine, world.coarse, world.has_coarse, cone, scene.lights, direct],
            [light, before],
        )

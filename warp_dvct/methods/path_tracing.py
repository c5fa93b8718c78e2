"""The truth: unbiased path tracing before and after with shared random numbers.

What it costs: about ``samples * (bounces + 1) * (lights + 2)`` rays per pixel; the after picture is only traced apart
where a path meets something synthetic. Where it is wrong: nowhere in the mean. It is noisy, most so where light reaches
a point through mirror-like reflections of small lights (caustics).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from warp_dvct.device_scene import DeviceScene
from warp_dvct.errors import OptionError
from warp_dvct.kernels import path_tracing as kernels
from warp_dvct.launch import Launcher
from warp_dvct.layers import Radiance
from warp_dvct.scene import Light, LightKind, Scene

# Paths per launch: about a second on a CPU, and enough to fill a GPU.
PATHS_PER_LAUNCH = 1 << 18
PATHS_PER_LAUNCH_CUDA = 1 << 23

Progress = Callable[[int, int], None]


def path_trace(
    launcher: Launcher,
    device_scene: DeviceScene,
    scene: Scene,
    width: int,
    height: int,
    *,
    samples: int,
    bounces: int,
    seed: int = 0,
    progress: Progress | None = None,
) -> Radiance:
    """Render the real scene alone and the whole scene, and their difference.

    Args:
        samples: Camera samples per pixel, uniform over the pixel (a box filter of one pixel).
        bounces: Indirect bounces: 0 is direct light only, 1 adds light that bounced once, and so on. From the fourth
            on paths end by Russian roulette, so a large number costs little more than 8.
        seed: Another seed gives independent noise.
        progress: Called with (samples done, samples in all) after each batch.
    Returns:
        The means, as ``layers.Radiance`` documents them.
    Raises:
        OptionError: ``samples`` below 1, ``bounces`` below 0 or a size below 1.
    """
    if samples < 1:
        raise OptionError(f"samples is {samples}; give at least 1")
    tracer = PathTracer(launcher, device_scene, scene, width, height, bounces=bounces, seed=seed)
    batch = tracer.samples_per_launch
    while tracer.samples < samples:
        tracer.add(min(batch, samples - tracer.samples))
        if progress is not None:
            progress(tracer.samples, samples)
    return tracer.resolve()


class PathTracer:
    """Progressive rendering: :meth:`add` samples, :meth:`resolve` whenever a picture is wanted.

    Sums are kept in float64, so that 100 000 samples lose nothing. Samples are numbered on from call to call: the
    result does not depend on how they were cut into batches.
    """

    def __init__(
        self,
        launcher: Launcher,
        device_scene: DeviceScene,
        scene: Scene,
        width: int,
        height: int,
        *,
        bounces: int,
        seed: int = 0,
    ) -> None:
        if width < 1 or height < 1:
            raise OptionError(f"the picture is {width} x {height} pixels; give at least 1 x 1")
        self.launcher = launcher
        self.device_scene = device_scene
        self.width = width
        self.height = height
        self.samples = 0
        self._config = _path_config(scene, bounces, seed)
        count = width * height
        with launcher.scope("path tracing"):
            self._before = launcher.zeros(count, wp.vec3d)
            self._delta = launcher.zeros(count, wp.vec3d)
            self._synthetic = launcher.zeros(count, wp.vec4d)
            self._real = launcher.zeros(count, wp.int32)

    @property
    def samples_per_launch(self) -> int:
        """Samples per pixel that make a batch of sensible length."""
        paths = PATHS_PER_LAUNCH_CUDA if self.launcher.device.is_cuda else PATHS_PER_LAUNCH
        return max(1, paths // (self.width * self.height))

    def add(self, samples: int) -> None:
        """Trace ``samples`` more camera samples per pixel."""
        scene = self.device_scene
        with self.launcher.scope("path tracing"):
            self.launcher.launch(
                kernels._trace_pixels,
                self.width * self.height,
                [
                    *(scene.geometry, scene.materials, scene.lights, scene.camera, self._config),
                    *(self.width, self.height, self.samples, samples),
                ],
                [self._before, self._delta, self._synthetic, self._real],
            )
        self.samples += samples

    def resolve(self) -> Radiance:
        """The means of the samples so far, and the first surfaces at the pixels' centres.

        Raises:
            OptionError: Nothing has been traced yet.
        """
        if self.samples < 1:
            raise OptionError("no samples have been traced; call add() first")
        launcher, scene, count = self.launcher, self.device_scene, self.width * self.height
        with launcher.scope("path tracing"):
            before, delta = launcher.empty(count, wp.vec3), launcher.empty(count, wp.vec3)
            synthetic, mask_real = launcher.empty(count, wp.vec4), launcher.empty(count, wp.float32)
            launcher.launch(
                kernels._resolve_pixels,
                count,
                [self._before, self._delta, self._synthetic, self._real, self.samples],
                [before, delta, synthetic, mask_real],
            )
            albedo, normal, position = (launcher.empty(count, wp.vec3) for _ in range(3))
            depth = launcher.empty(count, wp.float32)
            launcher.launch(
                kernels._find_first_surfaces,
                count,
                [
                    *(scene.geometry, scene.materials, scene.camera, self.width, self.height),
                    *(wp.vec3(*scene.origin), 1.0 / scene.scale),
                ],
                [albedo, normal, position, depth],
            )
        return Radiance(
            width=self.width,
            height=self.height,
            before=before,
            delta=delta,
            synthetic=synthetic,
            albedo=albedo,
            normal=normal,
            position=position,
            depth=depth,
            mask_real=mask_real,
        )


def gather_irradiance_reference(
    launcher: Launcher,
    device_scene: DeviceScene,
    scene: Scene,
    positions_vs: np.ndarray,
    normals_vs: np.ndarray,
    *,
    samples: int,
    bounces: int = 1,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Indirect irradiance at surface points, for tests of other methods.

    Args:
        positions_vs, normals_vs: Points in volume space and unit normals, shape ``[n, 3]``.
        samples: Rays per point.
        bounces: 1 is light that bounced once on its way to the point; direct light, domes included, is left out.
    Returns:
        Irradiance [W m^-2] in the real scene alone and in the whole scene, float32 ``[n, 3]`` each.
    Raises:
        OptionError: ``bounces`` or ``samples`` below 1.
    """
    if bounces < 1 or samples < 1:
        raise OptionError(f"bounces is {bounces} and samples is {samples}; give at least 1 of each")
    count = len(positions_vs)
    before, after = launcher.empty(count, wp.vec3), launcher.empty(count, wp.vec3)
    launcher.launch(
        kernels._gather_irradiance,
        count,
        [
            *(device_scene.geometry, device_scene.materials, device_scene.lights),
            _path_config(scene, bounces - 1, seed),
            launcher.array(np.asarray(positions_vs, np.float32), wp.vec3),
            launcher.array(np.asarray(normals_vs, np.float32), wp.vec3),
            samples,
        ],
        [before, after],
    )
    return before.numpy(), after.numpy()


def _path_config(scene: Scene, bounces: int, seed: int):
    if bounces < 0:
        raise OptionError(f"bounces is {bounces}; give 0 for direct light only, or more")
    config = kernels.PathConfig()
    config.bounces = bounces
    config.seed = seed
    config.any_extended = int(any(_is_extended(light) for light in scene.lights))
    return config


def _is_extended(light: Light) -> bool:
    """Whether a ray can meet the light."""
    return light.kind != LightKind.POINT and not (light.kind == LightKind.DISTANT and light.angle == 0.0)

"""Relighter: opens a stage, plans, keeps device data between frames, renders frames."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from warp_dvct.device_scene import DeviceScene
from warp_dvct.enclosure import within_enclosure
from warp_dvct.errors import OptionError
from warp_dvct.kept import Kept, content_key
from warp_dvct.launch import Launcher
from warp_dvct.layers import Layers, Radiance
from warp_dvct.memory import require_countable, require_memory
from warp_dvct.methods import delta_cone_tracing, instant_radiosity, light_field, path_tracing
from warp_dvct.passes.composite import composite
from warp_dvct.passes.difference import tonemap_difference
from warp_dvct.passes.lens import LensView
from warp_dvct.plan import Plan, for_plate, make_plan
from warp_dvct.sample_pace import SamplePace
from warp_dvct.scene import Notice, Role, Scene
from warp_dvct.scene_check import check_scene
from warp_dvct.settings import make_settings
from warp_dvct.surfels import with_surfels

if TYPE_CHECKING:
    from warp_dvct.budget import Choice
    from warp_dvct.pace import Pace

METHODS = ("delta-cones", "instant-radiosity", "path-trace")
DEFAULT_WIDTH = 960

Progress = Callable[[str, float], None]
Lit = light_field.LightField | instant_radiosity.Shot  # what a method keeps while only the camera moves
LitKind = TypeVar("LitKind", light_field.LightField, instant_radiosity.Shot)


class Relighter:
    """Inserts a stage's synthetic objects into its real scene, frame after frame.

    Args:
        stage: Path of a USD stage, an open ``Usd.Stage``, or a ``Scene``.
        method: ``delta-cones``, ``instant-radiosity`` or ``path-trace`` (the truth).
        quality: ``draft``, ``balanced`` or ``high``.
        settings: Single knobs by dotted name (``warp_dvct.settings``), over the quality's preset.
        camera: Prim path of the camera; needed where the stage has several.
        width, height: Picture size in pixels; by default the stage's render settings or 960, and the camera's aspect.
        time: Time code; None for the default time.
        device: ``cpu``, ``cuda`` or ``cuda:N``. threads: CPU threads; None for all cores.
        real, synthetic: Prim paths whose role is set against what the stage says.
        strict: Treat anything in the stage that is not modelled as an error.
        purposes, complexity: What is drawn of the stage, and how finely subdivision surfaces; as in ``read_stage``.
        overlap: Let passes that do not need one another run at once. By the clock, ``stats`` then do not tell how long
            each takes: the direct light's is what was left of it after the volumes.
        check: Look at what every kernel wrote; a number that is not finite or out of its range is a CheckError that
            names pass, pixel and inputs. About twice as slow.
    Raises:
        StageError: The stage cannot be read. OptionError: An unknown or unsuitable argument.
        DeviceError: The device is absent or out of memory.
    """

    def __init__(
        self,
        stage: Any,
        *,
        method: str = "delta-cones",
        quality: str = "balanced",
        settings: Mapping[str, Any] | None = None,
        camera: str | None = None,
        width: int | None = None,
        height: int | None = None,
        time: float | None = None,
        device: str = "cpu",
        threads: int | None = None,
        real: Sequence[str] = (),
        synthetic: Sequence[str] = (),
        strict: bool = False,
        purposes: Sequence[str] = ("default", "render"),
        complexity: str = "high",
        overlap: bool = True,
        check: bool = False,
    ) -> None:
        if method not in METHODS:
            raise OptionError(f"method is '{method}'; choose one of {', '.join(METHODS)}")
        self.settings = make_settings(quality, settings, method)
        self._given = dict(settings or {})
        self._overlap = overlap
        self.method = method
        self._launcher = Launcher(device, threads, check=check)
        self._stage = stage
        self._reading = {
            "camera": camera,
            "real": real,
            "synthetic": synthetic,
            "strict": strict,
            "purposes": purposes,
            "complexity": complexity,
        }
        self._size = (width, height)
        self._uploaded: tuple[str, DeviceScene, Lit | None] | None = None
        self._kept = Kept()
        self._had_plate = False
        self._pace: Pace | SamplePace | None = None
        self._method_notices: tuple[Notice, ...] = ()
        self.stats: dict[str, Any] = {}
        self.load_seconds = 0.0
        self.set_time(time)

    def set_time(self, time: float | None) -> None:
        """Read the stage at another time code; what did not change stays on the device."""
        start = clock.perf_counter()
        if isinstance(self._stage, Scene):
            check_scene(self._stage)
            self.scene = self._stage
        else:
            from warp_dvct.usd.read import read_stage

            self.scene = read_stage(self._stage, time=time, **self._reading)
        self.load_seconds = clock.perf_counter() - start
        self.width, self.height = self._picture_size()
        if self._launcher.checker is not None:
            self._launcher.checker.width, self._launcher.checker.height = self.width, self.height
        # Point clouds are drawn as surfels, without what lies behind the walls of a closed room; behind a lens that
        # bends, a pinhole's picture of another size is drawn.
        self._lens = LensView.of(self.scene.camera, self.width, self.height)
        self._drawn = within_enclosure(with_surfels(self.scene))
        if self._lens is not None:
            self._drawn = replace(self._drawn, camera=self._lens.camera)
        self._plan(has_plate=self.scene.plate is not None or self._had_plate)

    def set_scene(self, scene: Scene) -> None:
        """Render another moment of the shot from now on; what did not change stays on the device.

        Real meshes, lights and the camera that equal the last frame's are not processed again: put what moves into
        meshes of role SYNTHETIC. Each frame equals what a new Relighter would make of its scene, bit for bit.

        Raises:
            OptionError: The Relighter was given a stage, which :meth:`set_time` moves.
        """
        if not isinstance(self._stage, Scene):
            raise OptionError("this Relighter reads a USD stage; move it by set_time, or give it a Scene to begin with")
        self._stage = scene
        self.set_time(None)

    def keep_budget(
        self, seconds: float | None = None, *, max_error: float | None = None, has_plate: bool = False
    ) -> Choice:
        """Choose the settings for a time, or for an error, from now on; those given by name stay as they are.

        Under a time the next frame settles how many rays are gathered, or paths traced, by the time that is left then;
        later frames keep the number, of rays the mean of its points.

        Args:
            seconds: For one frame from scratch on this machine, without loading and compiling.
            max_error: Mean LDR-FLIP of the picture against a truth of many bounces.
            has_plate: Whether :meth:`render` will be given a plate.
        Returns:
            What was chosen, and what it is predicted to take and to miss.
        Raises:
            OptionError: Neither or both are given, a budget below the floor, an error out of reach, or a method whose
                settings are not chosen this way.
        """
        from warp_dvct.planning import choose_settings

        choice = choose_settings(
            self._drawn,
            self.method,
            self._launcher,
            *self._drawn_size(),
            seconds=seconds,
            max_error=max_error,
            has_plate=has_plate,
            fixed=self._given,
        )
        self.settings, self._pace = choice.settings, choice.pace
        self._plan(has_plate=has_plate)
        return choice

    @property
    def plan(self) -> Plan:
        """What the next frame will do."""
        return self._current_plan

    def render(self, plate: np.ndarray | None = None, *, ldr: bool = False, progress: Progress | None = None) -> Layers:
        """Render the current frame.

        Args:
            plate: The photograph, linear float32 ``[height, width, 3]``; without one the rendered 'before' is it.
            ldr: The plate was decoded from a display's codes (``image.is_display_referred``): with ``difference=auto``
                instant radiosity then adds the difference of tone-mapped solutions.
            progress: Called with the pass's name and the share of the frame that is done.
        """
        if plate is not None and plate.shape != (self.height, self.width, 3):
            raise OptionError(f"the plate has shape {plate.shape}; the picture needs {(self.height, self.width, 3)}")
        report = progress or (lambda name, share: None)
        launcher = self._launcher
        launcher.reset_times()
        self._kept.begin_frame()
        compiled, compiled_cpu = launcher.compile_seconds, launcher.compile_cpu_seconds
        start, start_cpu = clock.perf_counter(), clock.process_time()
        if self._pace is not None:
            self._pace.begin(launcher)
        self._had_plate = plate is not None
        if self._planned_plate != self._had_plate:
            self._planned_plate = self._had_plate
            self._current_plan = for_plate(self._current_plan, self._drawn, self._had_plate)
        require_memory(self.plan, launcher.device)
        if self.method == "path-trace":
            radiance = self._path_trace(report)
        elif self.method == "instant-radiosity":
            radiance = self._instant_radiosity(plate, ldr, report)
        else:
            radiance = self._delta_cones(plate is None, report)
        report("composite", 0.95)
        with launcher.scope("composite"):
            layers = composite(launcher, radiance, plate)
        if self.scene.captured:
            unknown = np.clip(1.0 - layers.mask_real - layers.mask_synthetic, 0.0, 1.0)
            layers = replace(layers, holes=unknown)
        spent, spent_cpu = clock.perf_counter() - start, clock.process_time() - start_cpu
        report("done", 1.0)
        self.stats = {
            "load_seconds": self.load_seconds,
            "compile_seconds": launcher.compile_seconds,
            "render_seconds": spent - (launcher.compile_seconds - compiled),
            "cpu_seconds": spent_cpu - (launcher.compile_cpu_seconds - compiled_cpu),
            "passes": dict(launcher.pass_seconds),
            "cpu_passes": dict(launcher.pass_cpu_seconds),
            "peak_bytes": launcher.peak_bytes,
            "plan": self.plan.to_dict(),
            "kept": dict(self._kept.reused),
            "notices": [str(n) for n in (*self.scene.notices, *self._method_notices)],
        }
        return layers

    def _plan(self, *, has_plate: bool) -> None:
        self._planned_plate = has_plate
        self._current_plan = make_plan(
            self._drawn, self.settings, self.method, *self._drawn_size(), has_plate=has_plate
        )

    def _drawn_size(self) -> tuple[int, int]:
        """Of the picture that is drawn, before a lens bends it."""
        if self._lens is not None:
            return self._lens.drawn_width, self._lens.drawn_height
        return self.width, self.height

    def _through_lens(self, radiance: Radiance) -> Radiance:
        """What was drawn as the camera's lens shows it."""
        if self._lens is None:
            return radiance
        with self._launcher.scope("lens"):
            return self._lens.bend(self._launcher, radiance)

    def _picture_size(self) -> tuple[int, int]:
        width, height = self._size
        aspect = self.scene.camera.aspect
        if width is None:
            width = self._default_width() if height is None else max(1, round(height * aspect))
        if height is None:
            height = max(1, round(width / aspect))
        require_countable(width, height)
        return width, height

    def _default_width(self) -> int:
        if isinstance(self._stage, Scene):
            return DEFAULT_WIDTH
        from warp_dvct.usd.render import product_resolution

        authored = product_resolution(self._stage, self.scene.camera.path)
        return authored[0] if authored else DEFAULT_WIDTH

    def _device_scene(self) -> DeviceScene:
        """The scene on the device: the kept one, with the camera of this frame, where nothing else changed."""
        origin, scale = np.asarray(self.plan.origin), self.plan.scale
        self._kept.lights = tuple(content_key(light) for light in self._drawn.lights)
        real, objects, key = _content_keys(self._drawn, self.plan, self._kept.lights)
        if self._uploaded is None or self._uploaded[0] != key:
            with self._launcher.scope("upload"):
                self._uploaded = None  # free the old one first
                self._kept.set_scene(real, objects)
                uploaded = DeviceScene.upload(self._launcher, self._drawn, origin, scale, self._kept)
            self._uploaded = (key, uploaded, None)
        return self._uploaded[1].seen_by(self._launcher, self._drawn.camera)

    def _lit(self, kind: type[LitKind], make: Callable[[], LitKind]) -> LitKind:
        """What the method made of the light of the scene on the device, kept until something else than the camera
        changes."""
        assert self._uploaded is not None
        lit = self._uploaded[2]
        if not isinstance(lit, kind):
            lit = make()
            self._uploaded = (self._uploaded[0], self._uploaded[1], lit)
        return lit

    def _delta_cones(self, with_before: bool, report: Progress) -> Radiance:
        launcher, scene, plan = self._launcher, self._drawn, self.plan
        report("upload", 0.0)
        device_scene = self._device_scene()

        def lit() -> light_field.LightField:
            report("volumes", 0.2)
            make = partial(light_field.light_volumes, launcher, scene, device_scene, plan, self._kept)
            volumes = self._lit(light_field.LightField, make)
            report("shading", 0.5)
            return volumes

        turns, pace = None, None if isinstance(self._pace, SamplePace) else self._pace
        ready = lit() if pace is not None or not self._overlap else None
        if pace is not None and ready is not None:
            with launcher.scope("settle"):
                turns = pace.settle(launcher, scene, device_scene, ready, self.settings)
        light = lit if ready is None else lambda: ready
        radiance = delta_cone_tracing.render(
            launcher, scene, device_scene, light, plan, with_before=with_before, kept=self._kept, turns=turns
        )
        if pace is not None and turns is not None:
            self._pace, self.settings = None, pace.end(turns)
            self._plan(has_plate=not with_before)
        return self._through_lens(radiance)

    def _instant_radiosity(self, plate: np.ndarray | None, ldr: bool, report: Progress) -> Radiance:
        report("virtual point lights", 0.0)
        launcher, scene, plan = self._launcher, self._drawn, self.plan
        device_scene = self._device_scene()
        make = partial(instant_radiosity.Shot, launcher, scene, device_scene, plan)
        shot = self._lit(instant_radiosity.Shot, make)
        report("shading", 0.3)
        difference = plan.settings.difference
        wanted = difference == "tonemapped" or (difference == "auto" and ldr)
        tonemapped = plate is not None and wanted and plan.changes
        radiance = shot.render(launcher, scene, device_scene, plan, with_before=plate is None or tonemapped)
        radiance = self._through_lens(radiance)
        self._method_notices = shot.notices
        return tonemap_difference(launcher, radiance, plate) if plate is not None and tonemapped else radiance

    def _path_trace(self, report: Progress) -> Radiance:
        shared = self._launcher, self._device_scene(), self._drawn, self.plan.width, self.plan.height
        how = {"bounces": self.settings.bounces, "seed": self.settings.seed}

        def progress(done: int, total: int) -> None:
            report("path trace", 0.95 * done / total)

        with self._launcher.scope("path trace"):
            if isinstance(self._pace, SamplePace):
                tracer = path_tracing.PathTracer(*shared, **how)
                samples = self._pace.trace(self._launcher, tracer, progress)
                radiance = tracer.resolve()
                self._pace, self.settings = None, replace(self.settings, samples=samples)
                self._plan(has_plate=self._had_plate)
            else:
                samples = self.settings.samples
                radiance = path_tracing.path_trace(*shared, samples=samples, **how, progress=progress)
        return self._through_lens(radiance)


def _content_keys(scene: Scene, plan: Plan, lights: tuple[str, ...]) -> tuple[str, str, str]:
    """Hashes of the real scene in volume space, of the synthetic surfaces, and of all that uploaded data and lit
    volumes depend on: everything but camera, plate and picture size."""
    surfaces = scene.materials, scene.textures
    meshes = [tuple(m for m in scene.meshes if m.role == role) for role in Role]
    clouds = [tuple(c for c in scene.point_clouds if c.role == role) for role in Role]
    real = content_key(meshes[Role.REAL], clouds[Role.REAL], *surfaces, plan.origin, plan.scale)
    objects = content_key(meshes[Role.SYNTHETIC], clouds[Role.SYNTHETIC])
    passes = tuple(p.needed for p in plan.passes if p.name in ("voxelize", "pyramid", "bounces"))
    settings = replace(plan.settings, gather_rays=0, gather_object_rays=0)  # the camera's passes alone read these
    rest = (settings, plan.fine, plan.coarse, plan.start, plan.maps, passes)
    return real, objects, content_key(real, objects, lights, *rest)


def relight(stage: Any, *, plate: np.ndarray | None = None, ldr: bool = False, **options: Any) -> Layers:
    """Insert a stage's synthetic objects into its real scene and return the finished layers.

    Args:
        stage: Path of a USD stage, an open ``Usd.Stage``, or a ``Scene``.
        plate: The photograph, linear float32 ``[height, width, 3]``; by default the rendered real scene.
        ldr: As for :meth:`Relighter.render`.
        options: As for :class:`Relighter`.
    """
    return Relighter(stage, **options).render(plate, ldr=ldr)

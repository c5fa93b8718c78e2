"""Relighting straight from depth images, frame by frame: no mesh of the real scene is needed.

Each frame is filtered with what earlier ones saw (:mod:`warp_dvct.passes.depth_filter`); the result, as a triangle
grid, is the real scene: what G-buffers, RSMs, voxels and the points of imperfect shadow maps are made of.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.capture.grid import Grid, GridLimits, depth_grid, grid_mesh
from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.capture.registration import sample, undistorted_depth
from warp_dvct.capture.stage import Capture, CaptureRig, open_capture
from warp_dvct.errors import FileError, OptionError, StageError
from warp_dvct.image import read_plate, srgb_to_linear
from warp_dvct.launch import Launcher
from warp_dvct.passes.depth_filter import DepthFilter, FilteredDepth, FilterOptions, Guide
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Camera, Light, LightKind, LightRole, Material, Notice, Role, Scene, Texture, Wrap

if TYPE_CHECKING:
    from pxr import Usd

MOST_ALBEDO = 0.95  # nothing reflects more
DARKEST = 0.02  # mean of a photograph below which its surroundings are not taken to be
GREY = 0.5  # albedo where no photograph shows a surface; the mean one of all surfaces, where light is not known
GAIN_WIDTH = 96  # pixels of the picture that tells how bright the known lights make the real scene
MOST_GAIN = 4.0  # that photographs are made brighter or darker to have albedo
CLIPPED = 0.98  # of a photograph's white: what is brighter may have been anything
SRGB = srgb_to_linear(np.arange(256) / 255.0)

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class LiveOptions:
    """How live depth becomes the real scene.

    Attributes:
        tolerance: How far triangles may be off the filtered depth, in the filter's ``noise`` of inverse depth.
        surroundings: Whether what no depth image shows sends light: a dome of the photographs' mean colour, unless the
            stage has a dome. Without it, it is black.
        filter: Of the depth.
    """

    tolerance: float = 0.3
    surroundings: bool = True
    filter: FilterOptions = field(default_factory=FilterOptions)

    def __post_init__(self) -> None:
        if not self.tolerance > 0.0:
            raise OptionError(f"a tolerance of {self.tolerance}: give a positive share of the noise")


class LiveSource:
    """Makes the scene of each frame: the synthetic objects and lights of a stage in a capture's real scene.

    A frame's scene does not depend on where a shot begins: all earlier frames with a known pose are filtered too.

    Args:
        stage: With synthetic objects and lights, in the capture's world; its real prims are left out, and its camera.
        capture: The capture's stage.
        options: How depth becomes surfaces.
        launcher: Device.
        reading: Further keywords of ``read_stage``: real, synthetic, strict, purposes.
    Raises:
        StageError, FileError: One of both cannot be read.
    """

    def __init__(
        self,
        stage: str | Path | Usd.Stage,
        capture: str | Path | Capture,
        *,
        launcher: Launcher,
        options: LiveOptions | None = None,
        **reading: Any,
    ) -> None:
        self.capture = capture if isinstance(capture, Capture) else open_capture(capture)
        self._stage, self._reading = stage, reading
        self._launcher, self._options = launcher, options or LiveOptions()
        depth = self.capture.rig.depth
        lens = (depth.fx, depth.fy, depth.cx, depth.cy)
        self._filter = DepthFilter(launcher, lens, depth.size, self._options.filter)
        self._next = 0
        self._filtered: FilteredDepth | None = None
        self._mean: np.ndarray | None = None
        self._gain: float | None = None
        self.skipped: list[str] = []

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the photographs, or of the depth images where there are none."""
        rig = self.capture.rig
        return (rig.color or rig.depth).size

    def index(self, time: float | None) -> int:
        """The frame at a time code; the first one with a known pose for None.

        Raises:
            StageError: The capture has no frame at that time.
        """
        capture = self.capture
        if time is None:
            return next((k for k in capture if capture.pose(k) is not None), 0)
        if time not in capture.times:
            raise StageError(
                f"'{capture.path}' has no frame {time:g}; its frames are {capture.times[0]:g} to {capture.times[-1]:g}"
            )
        return capture.times.index(time)

    def scene(self, time: float | None = None, progress: Progress = lambda done, total: None) -> Scene:
        """The scene of a frame, with its photograph as the plate.

        Raises:
            StageError: There is no such frame, or its pose is not known.
            FileError: Its images cannot be read; earlier frames that cannot are left out and listed in ``skipped``.
        """
        index = self.index(time)
        pose = self.capture.pose(index)
        if pose is None:
            raise StageError(
                f"{self.capture.name(index)} has no known pose; find the poses with `warp-dvct reconstruct --track`"
            )
        return self._assemble(index, pose, self._advance(index, progress))

    def _assemble(self, index: int, pose: np.ndarray, filtered: FilteredDepth, *, fit: bool = True) -> Scene:
        """The scene of a frame with that depth; without ``fit`` photographs are albedo as they are, where light is
        known."""
        from warp_dvct.usd.read import read_stage

        color = self.capture.color(index)
        camera = _view(self.capture, index, pose, has_color=color is not None)
        scene = read_stage(
            self._stage,
            time=self.capture.times[index],
            view=camera,
            plate=self.capture.color_file(index),
            allow_empty_roles=True,
            allow_no_light=True,
            **self._reading,
        )
        kept = tuple(mesh for mesh in scene.meshes if mesh.role == Role.SYNTHETIC)
        clouds = tuple(cloud for cloud in scene.point_clouds if cloud.role == Role.SYNTHETIC)
        grid = self._grid(filtered)
        lights, gain, notices = self._lights(scene)
        if fit and color is not None and _plate_lights(scene.lights):
            gain = gain * self._fitted_gain()
        surface = Material(
            base_color=(GREY, GREY, GREY), roughness=1.0, ior=1.0, name=f"{self.capture.depth_path} (live)"
        )
        textures, uvs = scene.textures, None
        if color is not None:
            surface = replace(surface, base_color_texture=len(textures))
            textures = (*textures, _albedo_texture(color, gain, self.capture.color_file(index) or ""))
            uvs = _texture_coordinates(grid, self.capture.rig)
        mesh = grid_mesh(grid, pose, len(scene.materials), uvs, self.capture.depth_path)
        return replace(
            scene,
            meshes=(mesh, *kept),
            materials=(*scene.materials, surface),
            textures=textures,
            point_clouds=clouds,
            lights=lights,
            notices=(*scene.notices, *notices),
            captured=True,
        )

    def filtered(self, time: float | None = None) -> FilteredDepth:
        """The filtered depth of a frame, in the depth camera."""
        return self._advance(self.index(time))

    def _advance(self, index: int, progress: Progress = lambda done, total: None) -> FilteredDepth:
        """Filter frames up to ``index``; from the first one again where it lies behind."""
        if self._filtered is None or index < self._next - 1:
            self._filter.reset()
            self._next = 0
        first = self._next
        while self._next <= index:
            number, self._next = self._next, self._next + 1
            pose = self.capture.pose(number)
            if pose is None:
                continue
            try:
                depth, _ = undistorted_depth(self.capture.depth(number), self.capture.rig.depth)
            except FileError as error:
                if number == index:
                    raise
                if str(error) not in self.skipped:
                    self.skipped.append(str(error))
                continue
            # Earlier frames need no photograph: what it moves is not passed on to later ones.
            self._filtered = self._filter.update(depth, pose, self._guide(number) if number == index else None)
            progress(number + 1 - first, index + 1 - first)
        assert self._filtered is not None
        return self._filtered

    def _guide(self, index: int) -> Guide | None:
        """The photograph that depth jumps are moved to; None where there is none, or its lens bends."""
        lens = self.capture.rig.color
        color = None if lens is None or lens.is_distorted else self.capture.color(index)
        if lens is None or color is None:
            return None
        return Guide(color, (lens.fx, lens.fy, lens.cx, lens.cy), self.capture.rig.depth_to_color)

    def _lights(self, scene: Scene) -> tuple[tuple[Light, ...], np.ndarray, tuple[Notice, ...]]:
        """Lights, what to multiply photographs by to have albedo, and what to tell the user.

        Where the stage has no light of the photograph, the dome is so bright that the mean albedo is :data:`GREY`.
        Else photographs are albedo up to one factor.
        """
        plate_lights = _plate_lights(scene.lights)
        known = any(light.kind == LightKind.DOME for light in plate_lights)
        if known or (plate_lights and not self._options.surroundings):
            return scene.lights, np.ones(3), ()
        mean = self._mean
        if mean is None:
            first = self.capture.color(self._first_usable())
            mean = np.full(3, GREY) if first is None else np.maximum(SRGB[first].mean((0, 1)), DARKEST)
            self._mean = mean
        gain = np.ones(3) if plate_lights else GREY / mean
        radiance = mean / (1.0 if plate_lights else GREY)
        path = f"{self.capture.depth_path} (surroundings)"
        dome = Light(LightKind.DOME, (float(radiance[0]), float(radiance[1]), float(radiance[2])), path=path)
        said = "the stage has no dome light: what no depth image shows is taken as bright as the photographs' mean"
        return (*scene.lights, dome), gain, (Notice(self.capture.path, said),)

    def _first_usable(self) -> int:
        """The first frame with a known pose whose images can be read: light is judged by it for the whole capture.

        Raises:
            FileError: There is none.
        """
        said = f"'{self.capture.path}' has no frame with a known pose"
        for index in self.capture:
            if self.capture.pose(index) is not None:
                try:
                    self.capture.depth(index)
                    self.capture.color(index)
                    return index
                except FileError as error:
                    said = str(error)
        raise FileError(said)

    def _fitted_gain(self) -> float:
        """The factor from photographs to albedo: with it the first frame, rendered, is as bright as its photograph."""
        if self._gain is None:
            index = self._first_usable()
            pose = self.capture.pose(index)
            assert pose is not None
            depth, lens = undistorted_depth(self.capture.depth(index), self.capture.rig.depth)
            alone = DepthFilter(self._launcher, (lens.fx, lens.fy, lens.cx, lens.cy), lens.size, self._options.filter)
            scene = self._assemble(index, pose, alone.update(depth, pose), fit=False)
            self._gain = _brightness_ratio(scene, self._launcher)
        return self._gain

    def _grid(self, filtered: FilteredDepth) -> Grid:
        options = self._options.filter
        limits = GridLimits(options.edge * options.noise, options.edge_share, self._options.tolerance * options.noise)
        inverse = filtered.inverse.numpy().reshape(filtered.height, filtered.width)
        return depth_grid(inverse, filtered.normals(), self.capture.rig.depth, limits)


def _view(capture: Capture, index: int, pose: np.ndarray, *, has_color: bool) -> Camera:
    """The camera of the photograph, or the depth camera where there is none."""
    rig = capture.rig
    lens: Intrinsics = rig.color if has_color and rig.color is not None else rig.depth
    path = capture.color_path if has_color and capture.color_path else capture.depth_path
    return lens.scene_camera(pose @ np.linalg.inv(rig.depth_to_color) if has_color else pose, path)


def _plate_lights(lights: tuple[Light, ...]) -> tuple[Light, ...]:
    """Those that light the photograph."""
    return tuple(light for light in lights if light.role == LightRole.PLATE)


def _brightness_ratio(scene: Scene, launcher: Launcher) -> float:
    """How many times brighter the photograph is than the rendered real scene, on surfaces that are not clipped."""
    real = replace(scene, meshes=scene.meshes[:1], point_clouds=(), lights=_plate_lights(scene.lights))
    relighter = Relighter(
        real, width=GAIN_WIDTH, quality="draft", device=launcher.device.alias, threads=launcher.threads
    )
    layers = relighter.render()
    assert scene.plate is not None
    photo = read_plate(scene.plate)
    v, u = np.indices(layers.depth.shape) + 0.5
    scale = np.array([photo.shape[1] / layers.depth.shape[1], photo.shape[0] / layers.depth.shape[0]])
    seen, _ = sample(photo, np.stack([u, v], -1) * scale - 0.5)
    compared = (layers.mask_real == 1.0) & (seen.max(-1) < CLIPPED)
    rendered = float(layers.comp[compared].sum())
    if rendered <= 0.0:
        return 1.0
    return float(np.clip(seen[compared].sum() / rendered, 1.0 / MOST_GAIN, MOST_GAIN))


def _albedo_texture(color: np.ndarray, gain: np.ndarray, name: str) -> Texture:
    """The photograph's linear colours times ``gain``: a pixel's albedo goes by its own colour, so that it never loses
    more light than it had."""
    pixels = np.clip(SRGB[color] * gain, 0.0, MOST_ALBEDO).astype(np.float32)
    return Texture(pixels, Wrap.CLAMP, Wrap.CLAMP, f"{name} (albedo)")


def _texture_coordinates(grid: Grid, rig: CaptureRig) -> np.ndarray:
    """Where the photograph shows the vertices, ``[v, 2]``; v = 1 is its top."""
    assert rig.color is not None
    uv = rig.color.project(grid.points @ rig.depth_to_color[:3, :3].T + rig.depth_to_color[:3, 3])
    uv = np.nan_to_num((uv + 0.5) / np.array(rig.color.size), nan=0.5)
    return np.stack([uv[:, 0], 1.0 - uv[:, 1]], -1)

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

from warp_dvct.capture.enclosure import Enclosure, find_enclosure
from warp_dvct.capture.fusion import FusedMesh
from warp_dvct.capture.grid import Grid, GridLimits, depth_grid, grid_mesh
from warp_dvct.capture.intrinsics import Intrinsics
from warp_dvct.capture.live_albedo import MOST_GAIN, SRGB, albedo_texture, brightness_ratio, light_ratio, nearest
from warp_dvct.capture.registration import sample, undistorted_depth
from warp_dvct.capture.stage import Capture, CaptureRig, open_capture
from warp_dvct.errors import FileError, OptionError, StageError
from warp_dvct.launch import Launcher
from warp_dvct.passes.depth_filter import DepthFilter, FilteredDepth, FilterOptions, Guide
from warp_dvct.scene import Camera, Light, LightKind, LightRole, Material, Mesh, Notice, Role, Scene, Texture

if TYPE_CHECKING:
    from pxr import Usd

DARKEST = 0.02  # mean of a photograph below which its surroundings are not taken to be
GREY = 0.5  # albedo where no photograph shows a surface; the mean one of all surfaces, where light is not known
FIT_ROUNDS = 4
COARSE = 4  # pixels between those of the surface on which light is compared with the photograph
BEHIND = 0.025  # metres: about the noise of a depth camera, behind which the rest of a room lies

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class LiveOptions:
    """How live depth becomes the real scene.

    Attributes:
        tolerance: How far triangles may be off the filtered depth, in the filter's ``noise`` of inverse depth.
        surroundings: Whether what the depth image does not show sends light, unless the stage has a dome: the rest of
            the room where lamps are known and the picture looks like that of one, else a dome of the photographs' mean
            colour. Without it, it is black.
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
        self._factor: float | None = None
        self._straight: np.ndarray | None = None
        self._trial = 1.0
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
        if not kept and not clouds and all(light.role == LightRole.PLATE for light in scene.lights):
            raise StageError(
                f"'{self._stage}' has nothing synthetic to put into the capture; place an object with"
                " `warp-dvct capture place`, or tag prims as docs/usage.md says"
            )
        grid = self._grid(filtered)
        known = bool(_plate_lights(scene.lights))
        factor = self._fitted(known) if fit and color is not None else self._trial
        mesh = grid_mesh(grid, pose, len(scene.materials), None, self.capture.depth_path)
        box = self._room(scene.lights, mesh, pose)
        lights, balance, notices = (scene.lights, np.ones(3), ()) if box is not None else self._lights(scene, factor)
        if box is not None:
            notices = (Notice(self.capture.path, "unseen parts of the room are taken to be as what the picture shows"),)
        scene = replace(
            scene,
            meshes=kept,
            point_clouds=clouds,
            lights=lights,
            notices=(*scene.notices, *notices),
            captured=True,
        )
        if color is None:
            return self._with_real(scene, mesh, box)
        uvs = _texture_coordinates(grid, self.capture.rig)
        mesh = replace(mesh, corner_uvs=uvs.astype(np.float32)[grid.triangles])
        file, photo = self.capture.color_file(index) or "", SRGB[color]
        gain = balance * factor if known else balance
        if not fit:
            return self._with_real(scene, mesh, box, albedo_texture(photo, gain, file), uvs)
        coarse = self._grid(filtered, every=COARSE)
        uvs_small = _texture_coordinates(coarse, self.capture.rig)
        small = grid_mesh(coarse, pose, len(scene.materials), uvs_small, self.capture.depth_path)
        made = self._with_real(scene, small, box, albedo_texture(photo, gain, file), uvs_small, box_uvs=uvs)
        gain = gain * light_ratio(made, photo, self._launcher, 0.5 if known else 0.0)
        return self._with_real(scene, mesh, box, albedo_texture(photo, gain, file), uvs)

    def _with_real(
        self,
        scene: Scene,
        mesh: Mesh,
        box: Enclosure | None,
        texture: Texture | None = None,
        uvs: np.ndarray | None = None,
        box_uvs: np.ndarray | None = None,
    ) -> Scene:
        """``scene`` with the live surface, its material the next one, and the rest of the room around it.

        Args:
            uvs: Of the surface. box_uvs: Of the one that ``box`` was found for, where that is another.
        """
        surface = Material(
            base_color=(GREY, GREY, GREY),
            roughness=1.0,
            ior=1.0,
            base_color_texture=None if texture is None else len(scene.textures),
            name=f"{self.capture.depth_path} (live)",
        )
        meshes, materials, albedo = (mesh,), (surface,), np.full((len(mesh.points), 3), GREY)
        shown = uvs if box_uvs is None else box_uvs
        if texture is not None and shown is not None:
            albedo = nearest(texture.pixels, shown)
        if box is not None:
            path = f"{self.capture.depth_path} (surroundings)"
            white = Material(base_color=(1.0, 1.0, 1.0), roughness=1.0, ior=1.0, name=path)
            materials = (surface, white)
            meshes = (mesh, _box_mesh(box, albedo, len(scene.materials) + 1, path))
        return replace(
            scene,
            meshes=(*meshes, *scene.meshes),
            materials=(*scene.materials, *materials),
            textures=scene.textures if texture is None else (*scene.textures, texture),
        )

    def _room(self, lights: tuple[Light, ...], mesh: Mesh, pose: np.ndarray) -> Enclosure | None:
        """The rest of the room around a frame's surface; None where that is no room, or is not wanted."""
        if not self._options.surroundings:
            return None
        normals = np.zeros((len(mesh.points), 3), np.float32)
        assert mesh.corner_normals is not None
        normals[mesh.triangles] = mesh.corner_normals
        shown = FusedMesh(mesh.points, normals, None, mesh.triangles, {}, 1, 1, 0)
        return find_enclosure(shown, pose[:3, 3], _plate_lights(lights), voxel=BEHIND)

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
        """The photograph that depth jumps are moved to, as a lens that does not bend would show it; None where there is
        none."""
        lens = self.capture.rig.color
        color = None if lens is None else self.capture.color(index)
        if lens is None or color is None:
            return None
        if lens.is_distorted:
            if self._straight is None:
                plain = Intrinsics(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
                most = np.array(lens.size) - 1.0
                self._straight = np.clip(np.nan_to_num(lens.project(plain.rays()), nan=-1.0), 0.0, most)
            color = np.rint(sample(color.astype(np.float32), self._straight)[0]).astype(np.uint8)
        return Guide(color, (lens.fx, lens.fy, lens.cx, lens.cy), self.capture.rig.depth_to_color)

    def _lights(self, scene: Scene, level: float) -> tuple[tuple[Light, ...], np.ndarray, tuple[Notice, ...]]:
        """Lights, what to multiply photographs by to have albedo, and what to tell the user.

        Where the stage has no light of the photograph, the mean albedo is :data:`GREY` and ``level`` makes the dome so
        bright that the picture is as bright as its photograph. Else photographs are albedo up to one factor.
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
        radiance = mean if plate_lights else mean / GREY * level
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

    def _fitted(self, known: bool) -> float:
        """The factor with which the first frame, rendered, is as bright as its photograph: from photographs to albedo
        where lights are known, of the surroundings' brightness where they are not."""
        if self._factor is None:
            index = self._first_usable()
            pose = self.capture.pose(index)
            assert pose is not None
            depth, lens = undistorted_depth(self.capture.depth(index), self.capture.rig.depth)
            alone = DepthFilter(self._launcher, (lens.fx, lens.fy, lens.cx, lens.cy), lens.size, self._options.filter)
            first, color = alone.update(depth, pose), self.capture.color(index)
            assert color is not None
            for number in range(FIT_ROUNDS):
                made = self._assemble(index, pose, first, fit=False)
                ratio = brightness_ratio(made, SRGB[color], self._launcher)
                # Light that bounces follows the albedo, so that the factor would swing around the answer.
                self._trial *= np.sqrt(ratio) if known and number > 0 else ratio
            self._factor = float(np.clip(self._trial, 1.0 / MOST_GAIN, MOST_GAIN))
            self._trial = 1.0
        return self._factor

    def _grid(self, filtered: FilteredDepth, every: int = 1) -> Grid:
        """The surface; of every so many pixels both ways."""
        options, lens = self._options.filter, self.capture.rig.depth
        share = options.edge_share * every
        limits = GridLimits(options.edge * options.noise, share, self._options.tolerance * options.noise)
        inverse = filtered.inverse.numpy().reshape(filtered.height, filtered.width)[::every, ::every]
        height, width = inverse.shape
        lens = Intrinsics(width, height, lens.fx / every, lens.fy / every, lens.cx / every, lens.cy / every)
        return depth_grid(inverse, filtered.normals()[::every, ::every], lens, limits)


def _view(capture: Capture, index: int, pose: np.ndarray, *, has_color: bool) -> Camera:
    """The camera of the photograph, or the depth camera where there is none."""
    rig = capture.rig
    lens: Intrinsics = rig.color if has_color and rig.color is not None else rig.depth
    path = capture.color_path if has_color and capture.color_path else capture.depth_path
    return lens.scene_camera(pose @ np.linalg.inv(rig.depth_to_color) if has_color else pose, path)


def _plate_lights(lights: tuple[Light, ...]) -> tuple[Light, ...]:
    """Those that light the photograph."""
    return tuple(light for light in lights if light.role == LightRole.PLATE)


def _box_mesh(box: Enclosure, albedo: np.ndarray, material: int, path: str) -> Mesh:
    """The rest of a room as a real mesh; ``albedo`` is that of the vertices of what is seen."""
    return Mesh(
        points=box.points.astype(np.float64),
        triangles=box.triangles,
        materials=np.full(len(box.triangles), material, np.int32),
        role=Role.REAL,
        corner_colors=box.albedo(albedo).astype(np.float32)[box.triangles],
        path=path,
    )


def _texture_coordinates(grid: Grid, rig: CaptureRig) -> np.ndarray:
    """Where the photograph shows the vertices, ``[v, 2]``; v = 1 is its top."""
    assert rig.color is not None
    uv = rig.color.project(grid.points @ rig.depth_to_color[:3, :3].T + rig.depth_to_color[:3, 3])
    uv = np.nan_to_num((uv + 0.5) / np.array(rig.color.size), nan=0.5)
    return np.stack([uv[:, 0], 1.0 - uv[:, 1]], -1)

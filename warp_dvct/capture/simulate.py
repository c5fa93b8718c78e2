"""The opposite of a capture's import: what a depth camera would record of a stage, and the truth beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.capture import paths
from warp_dvct.capture.formats import KINECT_BASELINE
from warp_dvct.capture.intrinsics import FLIP, Intrinsics
from warp_dvct.capture.noise import KinectNoise
from warp_dvct.capture.stage import CaptureRig, FrameFiles, write_capture
from warp_dvct.device_scene import DeviceScene, camera_frame
from warp_dvct.errors import FileError, OptionError
from warp_dvct.image import replacing, write_depth_exr, write_png, write_text
from warp_dvct.launch import Launcher
from warp_dvct.passes.gbuffer import see_real
from warp_dvct.passes.tonemap import tonemap
from warp_dvct.relighter import Relighter
from warp_dvct.scene import Camera, Mesh, Role, Scene

PATHS = ("auto", "stage", "orbit", "handheld")
UNIT = 0.0002  # m: TUM's steps, too fine to add to the sensor's own
FOCAL_DEPTH, FOCAL_COLOR = 585.0, 525.0  # Kinect v1 at 640 pixels across
BOUNCES = 24  # a photograph holds all of them
DISTANCE = 1.0  # m to what the camera looks at, where it looks at nothing


@dataclass(frozen=True)
class Simulation:
    """How to simulate.

    Attributes:
        frames: How many.
        width, height: Of both images, in pixels.
        path: One of :data:`PATHS`; ``auto`` follows the stage's camera where it is animated, else it is ``handheld``.
        arc: Of an orbit [degrees].
        unregistered: Whether colour comes from a camera of its own, 25 mm to the right with another focal length;
            otherwise both images show the same view, as drivers with registration deliver them.
        noise: Effects and their sizes.
        seed: Of the noise and of the hand.
        exposure: Stops; photographs are clipped at 1.
        quality: Of the photographs' light.
    """

    frames: int = 60
    width: int = 640
    height: int = 480
    path: str = "auto"
    arc: float = 50.0
    unregistered: bool = False
    noise: KinectNoise = field(default_factory=KinectNoise)
    seed: int = 0
    exposure: float = 0.0
    quality: str = "draft"


@dataclass(frozen=True)
class Simulated:
    """What was written: the capture, the truth in the same layout, and the share of pixels that are clipped white."""

    capture: Path
    truth: Path
    clipped: float
    valid: float


def simulate(
    stage: str | Path,
    folder: str | Path,
    options: Simulation | None = None,
    *,
    camera: str | None = None,
    time: float | None = None,
    device: str = "cpu",
    threads: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Simulated:
    """Record the real part of a stage (all of it, where nothing is tagged real) with a simulated depth camera.

    Writes ``capture.usda`` with ``depth/`` and ``color/``; ``truth.usda``, the same with depth that is exact to the
    float at each pixel's centre and holds the scene's mesh ``/Capture/mesh``; and ``simulation.json``. The
    capture's world is the stage's. The same options give the same bytes.

    Args:
        stage: File. camera: Of the stage, for poses alone. time: Time code of what does not follow the camera.
        folder: Made where it is absent.
        device, threads: As for ``Relighter``.
        progress: Called with frames done and in all.
    Raises:
        StageError: The stage cannot be read. OptionError: Options do not fit. FileError: Nothing can be written.
    """
    options = options or Simulation()
    _check(options)
    target = Path(folder)
    scenes = _scenes(stage, camera, time, options)
    depth_lens = _lens(options, FOCAL_DEPTH)
    color_lens = _lens(options, FOCAL_COLOR) if options.unregistered else depth_lens
    extrinsic = np.eye(4)
    if options.unregistered:
        extrinsic[:3, 3] = KINECT_BASELINE
    rig = CaptureRig(depth_lens, color_lens, extrinsic, UNIT)
    truth_rig = CaptureRig(depth_lens, color_lens, extrinsic, 1.0)
    for name in ("depth", "color", "truth"):
        try:
            (target / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FileError(f"'{target / name}' cannot be made: {error.strerror}") from error
    launcher = Launcher(device, threads)
    eye = DepthEye(launcher, scenes[0], depth_lens)
    first = paths.level(scenes[0].camera.to_world @ FLIP)
    poses = _poses(options, scenes, first, eye)
    relighter = Relighter(
        scenes[0],
        width=options.width,
        height=options.height,
        quality=options.quality,
        settings={"bounces": BOUNCES},
        device=device,
        threads=threads,
    )
    files: list[FrameFiles] = []
    truths: list[FrameFiles] = []
    clipped, valid = 0.0, 0.0
    for number, pose in enumerate(poses):
        scene = scenes[min(number, len(scenes) - 1)]
        eye.set_scene(scene)
        true, normal = eye.look(pose)
        measured = options.noise.apply(true, normal, depth_lens, options.seed, number)
        relighter.set_scene(replace(scene, camera=color_lens.scene_camera(pose @ np.linalg.inv(extrinsic))))
        photo = relighter.render().comp
        clipped += float((photo * 2.0**options.exposure > 1.0).any(-1).mean())
        valid += float((measured > 0.0).mean())
        names = [target / n for n in (f"depth/{number:05d}.png", f"color/{number:05d}.png", f"truth/{number:05d}.exr")]
        write_png(names[0], _codes(measured))
        clear = np.minimum(photo * 2.0**options.exposure, 1.0)
        write_png(names[1], tonemap(launcher, clear))
        write_depth_exr(names[2], true)
        files.append(FrameFiles(str(names[0]), str(names[1]), pose))
        truths.append(FrameFiles(str(names[2]), str(names[1]), pose))
        progress(number + 1, len(poses))
    write_capture(target / "truth.usda", truth_rig, truths, world=np.eye(4))
    _add_mesh(target / "truth.usda", scenes[0])
    write_text(target / "simulation.json", json.dumps({"stage": str(stage), **asdict(options)}, indent=2) + "\n")
    write_capture(target / "capture.usda", rig, files, world=np.eye(4))
    count = len(poses)
    return Simulated(target / "capture.usda", target / "truth.usda", clipped / count, valid / count)


class DepthEye:
    """Exact depth and normals of a scene's real part, by rays through pixel centres.

    Args:
        launcher: Device.
        scene: Its real meshes are seen.
        lens: Without distortion.
    """

    def __init__(self, launcher: Launcher, scene: Scene, lens: Intrinsics) -> None:
        self._launcher, self._lens = launcher, lens
        self._scene: Scene | None = None
        self.set_scene(scene)

    def set_scene(self, scene: Scene) -> None:
        """See another scene from now on; its camera does not count."""
        if self._scene is not None and scene.meshes is self._scene.meshes:
            return
        self._scene = scene
        low, high = scene.bounds() or (np.zeros(3), np.ones(3))
        self._device_scene = DeviceScene.upload(self._launcher, scene, low, 1.0 / max(float((high - low).max()), 1e-9))

    def look(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth along the view axis [m], float32 ``[h, w]``, 0 where there is nothing, and unit normals that face
        the camera, in camera axes (OpenCV), float32 ``[h, w, 3]``."""
        uploaded, lens = self._device_scene, self._lens
        camera: Camera = lens.scene_camera(pose)
        placed = replace(uploaded, camera=camera_frame(camera, uploaded.origin, uploaded.scale))
        points = see_real(self._launcher, placed, *lens.size).points
        inverse = np.linalg.inv(pose)
        position = points.position.numpy().astype(np.float64) / uploaded.scale + uploaded.origin
        depth = position @ inverse[2, :3] + inverse[2, 3]
        depth = np.where(points.role.numpy() >= 0, depth, 0.0).astype(np.float32)
        normal = (points.normal_g.numpy() @ inverse[:3, :3].T).astype(np.float32)
        return depth.reshape(lens.height, lens.width), normal.reshape(lens.height, lens.width, 3)


def _check(options: Simulation) -> None:
    if options.frames < 1:
        raise OptionError(f"{options.frames} frames; give at least 1")
    if options.path not in PATHS:
        raise OptionError(f"there is no path '{options.path}'; choose one of {', '.join(PATHS)}")


def _lens(options: Simulation, focal: float) -> Intrinsics:
    """A centred pinhole with the sensor's field of view across."""
    f = focal * options.width / 640.0
    return Intrinsics(options.width, options.height, f, f, 0.5 * (options.width - 1), 0.5 * (options.height - 1))


def _scenes(stage: str | Path, camera: str | None, time: float | None, options: Simulation) -> list[Scene]:
    """The scene of each frame where the stage's own camera leads, else the one scene."""
    from warp_dvct.usd.read import read_stage
    from warp_dvct.usd.stage import frame_range, open_stage

    opened = open_stage(stage)
    span = frame_range(opened)
    reading: dict[str, Any] = {"camera": camera, "allow_empty_roles": True}
    first = _only_real(read_stage(opened, time=time, **reading))
    moves = False
    if span is not None and span[1] > span[0]:
        last = read_stage(opened, time=span[1], **reading)
        moves = not np.allclose(last.camera.to_world, read_stage(opened, time=span[0], **reading).camera.to_world)
    if options.path == "stage" and not moves:
        raise OptionError(f"{stage}: camera {first.camera.path} does not move; choose --path orbit or handheld")
    if not moves or options.path not in ("auto", "stage") or span is None:
        return [first]
    codes = paths.spread(span[:2], options.frames)
    return [_only_real(read_stage(opened, time=code, **reading)) for code in codes]


def _only_real(scene: Scene) -> Scene:
    """The scene without its synthetic part; where nothing is real, all of it is taken as real."""
    real = tuple(mesh for mesh in scene.meshes if mesh.role == Role.REAL)
    if not real:
        real = tuple(replace(mesh, role=Role.REAL) for mesh in scene.meshes)
    return replace(scene, meshes=real, plate=None)


def _poses(options: Simulation, scenes: Sequence[Scene], first: np.ndarray, eye: DepthEye) -> list[np.ndarray]:
    if len(scenes) > 1 or options.path == "stage":
        return [paths.level(scene.camera.to_world @ FLIP) for scene in scenes]
    seen, _ = eye.look(first)
    middle = seen[seen.shape[0] // 3 : -seen.shape[0] // 3, seen.shape[1] // 3 : -seen.shape[1] // 3]
    middle = middle[middle > 0.0]
    distance = float(np.median(middle)) if len(middle) else DISTANCE
    if options.path == "orbit":
        return paths.orbit(first, distance, options.frames, np.radians(options.arc))
    return paths.handheld(first, distance, options.frames, options.seed)


def _codes(depth: np.ndarray) -> np.ndarray:
    """Stored depth, uint16 ``[h, w, 1]``."""
    return np.clip(np.rint(depth / UNIT), 0, 65535).astype(np.uint16)[..., None]


def _add_mesh(path: Path, scene: Scene) -> None:
    """Author the scene's triangles at ``/Capture/mesh``, as one mesh in a crate file beside the stage."""
    from pxr import Usd

    crate = path.with_name(f"{path.stem}_mesh.usdc")
    write_mesh(crate, scene.meshes)
    with replacing(path) as temporary:
        stage = Usd.Stage.Open(str(path))
        stage.DefinePrim("/Capture/mesh").GetPayloads().AddPayload(f"./{crate.name}")
        stage.GetRootLayer().Export(str(temporary))


def write_mesh(path: Path, meshes: Sequence[Mesh]) -> None:
    """Write triangles as one real ``UsdGeom.Mesh``, the default prim of a layer of its own.

    Raises:
        FileError: The file cannot be written.
    """
    from pxr import Sdf, Tf, Usd, UsdGeom, Vt

    counts = np.cumsum([0, *(len(mesh.points) for mesh in meshes)])
    points = np.concatenate([mesh.points for mesh in meshes]).astype(np.float32)
    triangles = np.concatenate([mesh.triangles + first for mesh, first in zip(meshes, counts, strict=False)])
    with replacing(path) as temporary:
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        mesh = UsdGeom.Mesh.Define(stage, "/mesh")
        stage.SetDefaultPrim(mesh.GetPrim())
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(triangles.astype(np.int32).ravel()))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateExtentAttr([tuple(points.min(0).tolist()), tuple(points.max(0).tolist())])
        mesh.GetPrim().CreateAttribute("primvars:dvct:reality", Sdf.ValueTypeNames.Token).Set("real")
        try:
            stage.GetRootLayer().Save()
        except Tf.ErrorException as error:
            raise FileError(f"{path} cannot be written: {error}") from error

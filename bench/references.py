"""Path-traced truths, kept in a cache that is keyed by what was traced and by the code that traced it."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import os
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from tqdm import tqdm

from warp_dvct.device_scene import DeviceScene
from warp_dvct.errors import FileError, OptionError, StageError
from warp_dvct.launch import Launcher
from warp_dvct.layers import Radiance
from warp_dvct.methods.path_tracing import PathTracer
from warp_dvct.metrics import flip_ldr
from warp_dvct.scene import Material, Role, Scene

UNHASHED_IF_EMPTY = {"point_clouds"}  # a scene without them has the key that it always had
UNHASHED = {"name", "path", "notices", "plate"}  # labels; they do not change the picture
TRACERS = ("warp_dvct.methods.path_tracing", "warp_dvct.device_scene")
TRACED_WITH = ("warp_dvct.kernels.", "warp_dvct.methods.", "warp_dvct.passes.")


@dataclass(frozen=True)
class Reference:
    """The truth of one picture: linear float32 arrays, row 0 on top.

    Attributes:
        before: Real scene alone, ``[h, w, 3]``.
        delta: After minus before over the real part of each pixel, weighted by that part, ``[h, w, 3]``.
        synthetic: Premultiplied radiance of the synthetic objects and their coverage, ``[h, w, 4]``.
        noise: LDR-FLIP that the reference's own noise is worth: half of that between its two halves, traced with
            different random numbers.
    """

    before: np.ndarray
    delta: np.ndarray
    synthetic: np.ndarray
    noise: float

    @property
    def coverage(self) -> np.ndarray:
        """Coverage by synthetic objects, ``[h, w]`` in [0, 1]."""
        return self.synthetic[..., 3]

    @property
    def comp(self) -> np.ndarray:
        """The true picture with this reference's 'before' as the plate."""
        return combine(self.before, self.delta, self.synthetic)


def combine(plate: np.ndarray, delta: np.ndarray, synthetic: np.ndarray) -> np.ndarray:
    """Synthetic over plate + delta, with ``delta`` weighted by the pixel's real part; never negative."""
    return np.maximum(synthetic[..., :3] + (1 - synthetic[..., 3:]) * plate + delta, 0).astype(np.float32)


class TruthOptions(Protocol):
    """What a command's options say of its truth."""

    @property
    def width(self) -> int: ...

    @property
    def samples(self) -> int: ...

    @property
    def seed(self) -> int: ...

    @property
    def cache(self) -> Path: ...


class ReferenceStore:
    """Traces references of one scene and keeps them in ``cache``.

    Args:
        scene: What is traced.
        width, height: Pixels.
        samples: Per pixel; rounded up to two equal halves.
        seed: Of the random numbers.
        cache: Folder; made if missing.
        launcher: Where to trace.
        quiet: No progress bar.
    Raises:
        OptionError: ``samples`` below 1.
    """

    def __init__(
        self,
        scene: Scene,
        width: int,
        height: int,
        *,
        samples: int,
        seed: int,
        cache: Path,
        launcher: Launcher,
        quiet: bool = False,
    ) -> None:
        if samples < 1:
            raise OptionError(f"--spp is {samples}; give a number of at least 1")
        self.scene, self.width, self.height, self.seed = scene, width, height, seed
        self.samples = 2 * -(-samples // 2)
        self.cache, self.launcher, self.quiet = cache, launcher, quiet
        self._device_scene: DeviceScene | None = None

    @classmethod
    def of(cls, scene: Scene, options: TruthOptions, launcher: Launcher) -> ReferenceStore:
        """The store of a command's options, pictures as high as the camera asks for."""
        height = max(1, round(options.width / scene.camera.aspect))
        kept = {"samples": options.samples, "seed": options.seed, "cache": options.cache}
        return cls(scene, options.width, height, launcher=launcher, **kept)

    def get(self, bounces: int) -> Reference:
        """The truth with ``bounces`` indirect bounces (0 is direct light only), from the cache if it is there.

        Raises:
            FileError: The cache cannot be written.
        """
        file = self.cache / f"{self.key(bounces)}.npz"
        reference = _load(file)
        if reference is None:
            _make_folder(file.parent)  # found out before minutes of tracing
            reference = self._trace(bounces)
            _save(file, reference)
        return reference

    def key(self, bounces: int) -> str:
        """Hash of scene, picture size, samples, bounces, seed and the tracer's sources."""
        sha = hashlib.sha256()
        for part in _flatten(self.scene):
            sha.update(part)
        numbers = (self.width, self.height, self.samples, bounces, self.seed)
        sha.update(repr(numbers).encode() + source_digest(*TRACERS).encode())
        return sha.hexdigest()[:32]

    def glossy_mask(self) -> np.ndarray:
        """Pixels whose first surface at the centre is real and reflects visibly, bool ``[h, w]``.

        The scene is drawn once with white for glossy real surfaces and black for all others.
        """
        labelled = label_glossy(self.scene)
        tracer = self._tracer(self._upload(labelled), labelled, 0, self.seed)
        tracer.add(1)
        return tracer.resolve().albedo.numpy().reshape(self.height, self.width, 3)[..., 0] > 0.5

    def _trace(self, bounces: int) -> Reference:
        if self._device_scene is None:
            self._device_scene = self._upload(self.scene)
        halves = [self._tracer(self._device_scene, self.scene, bounces, seed) for seed in self._seeds()]
        title = f"truth {self.width}x{self.height}, {bounces} bounces"
        disable = True if self.quiet else None  # None: only on a terminal
        with tqdm(total=self.samples, desc=title, unit="spp", disable=disable, leave=False) as bar:
            for tracer in halves:
                while tracer.samples < self.samples // 2:
                    done = tracer.samples
                    tracer.add(min(tracer.samples_per_launch, self.samples // 2 - done))
                    bar.update(tracer.samples - done)
        (b1, d1, s1), (b2, d2, s2) = (self._pictures(tracer.resolve()) for tracer in halves)
        before, delta, synthetic = (b1 + b2) / 2, (d1 + d2) / 2, (s1 + s2) / 2
        # Both halves on the same plate: a 'before' that two compared pictures share is no noise between them.
        noise = flip_ldr(combine(before, d1, s1), combine(before, d2, s2))[0] / 2
        return Reference(before, delta, synthetic, noise)

    def _seeds(self) -> tuple[int, int]:
        return 2 * self.seed, 2 * self.seed + 1

    def _tracer(self, device_scene: DeviceScene, scene: Scene, bounces: int, seed: int) -> PathTracer:
        return PathTracer(self.launcher, device_scene, scene, self.width, self.height, bounces=bounces, seed=seed)

    def _pictures(self, radiance: Radiance) -> list[np.ndarray]:
        arrays = (radiance.before, radiance.delta, radiance.synthetic)
        return [a.numpy().reshape(self.height, self.width, -1).astype(np.float32) for a in arrays]

    def _upload(self, scene: Scene) -> DeviceScene:
        bounds = scene.bounds()
        if bounds is None:
            raise StageError("the stage has no triangles to trace; check purposes and visibility")
        low, high = bounds
        return DeviceScene.upload(self.launcher, scene, (low + high) / 2, 1 / float((high - low).max()))


def label_glossy(scene: Scene) -> Scene:
    """The scene with Lambert materials: white where a real surface has a lobe sharper than 0.5, black elsewhere."""
    labels = []
    for role in Role:
        for material in scene.materials:
            value = float(role == Role.REAL and is_glossy(material))
            labels.append(
                Material(base_color=(value, value, value), specular_color=(0.0, 0.0, 0.0), name=material.name)
            )
    count = len(scene.materials)
    meshes = tuple(
        replace(m, materials=(m.materials + count * int(m.role)).astype(np.int32), corner_colors=None)
        for m in scene.meshes
    )
    return replace(scene, meshes=meshes, materials=tuple(labels), textures=())


def is_glossy(material: Material) -> bool:
    """Whether a reflection in it is worth a region of its own: some specular reflection, roughness below 0.5."""
    if material.specular_color is not None:
        reflects = max(material.specular_color) > 0
    else:
        reflects = material.metallic > 0 or material.ior != 1
    return reflects and (material.roughness < 0.5 or material.roughness_texture is not None)


def source_digest(*modules: str) -> str:
    """Hash of the sources of ``modules`` and of the kernels, methods and passes that they import, to any depth."""
    seen: dict[str, bytes] = {}
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        file = _source_file(name)
        if file is None or name in seen:
            continue
        seen[name] = file.read_bytes()
        waiting += [imported for imported in _imports(seen[name]) if imported.startswith(TRACED_WITH)]
    sha = hashlib.sha256()
    for name in sorted(seen):
        sha.update(name.encode() + seen[name])
    return sha.hexdigest()


def _source_file(name: str) -> Path | None:
    """The file of a module; None where ``name`` is something inside of one."""
    try:
        spec = importlib.util.find_spec(name)
    except ModuleNotFoundError:
        return None
    return Path(spec.origin) if spec and spec.origin else None


def _imports(source: bytes) -> Iterator[str]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)  # some are modules


def _flatten(value: Any) -> Iterator[bytes]:
    """Bytes that differ where two scenes differ."""
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif is_dataclass(value):
        yield type(value).__name__.encode()
        for item in fields(value):
            empty = item.name in UNHASHED_IF_EMPTY and not getattr(value, item.name)
            if item.name not in UNHASHED and not empty:
                yield item.name.encode()
                yield from _flatten(getattr(value, item.name))
    elif isinstance(value, (tuple, list)):
        yield f"({len(value)}".encode()
        for item in value:
            yield from _flatten(item)
    else:
        yield repr(value).encode() + b";"


def _load(file: Path) -> Reference | None:
    """The stored reference; None where there is none, or one that a crash left unreadable."""
    try:
        with np.load(file) as data:
            return Reference(data["before"], data["delta"], data["synthetic"], float(data["noise"]))
    except (OSError, zipfile.BadZipFile, KeyError, ValueError, EOFError):
        return None


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"the cache {folder} cannot be made: {error}; choose a folder with --cache") from error


def _save(file: Path, reference: Reference) -> None:
    try:
        with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".tmp", delete=False) as out:
            np.savez_compressed(
                out,
                before=reference.before,
                delta=reference.delta,
                synthetic=reference.synthetic,
                noise=np.float64(reference.noise),
            )
        os.replace(out.name, file)
    except OSError as error:
        raise FileError(f"the reference cannot be written to {file}: {error}; choose a folder with --cache") from error

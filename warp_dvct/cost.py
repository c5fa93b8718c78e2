"""What a frame costs: counts of rays, voxels, texels and points known before it is rendered, times unit costs.

The counts follow from the settings and the scene's survey alone. The unit costs are fitted by ``warp-dvct calibrate``
to processor seconds of each pass of real frames, by least squares of the relative error with no negative cost. Beside
them stands the factor by which all threads together were faster than one.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.errors import FileError, OptionError
from warp_dvct.image import write_text
from warp_dvct.settings import Settings
from warp_dvct.survey import Survey

DEFAULT_FILE = Path(__file__).with_name("cost.json")
REST = "rest"  # of a frame's time, what is in no pass
SHORT = 2e-3  # seconds: in shorter passes the clock says little of threads
SMALLEST = 5e-4  # seconds: relative errors of shorter passes do not matter

Counts = dict[str, float]


def count_work(settings: Settings, survey: Survey, width: int, height: int) -> dict[str, Counts]:
    """Counts by pass of a delta-cones frame, each ``unit: how many`` in millions; ``frame`` is 1.

    A pass that the scene does not need has no entry.
    """
    pixels = width * height * 1e-6
    points = pixels + settings.antialias * survey.outline * width * 1e-6
    before = not survey.plate
    lit = survey.changes or before
    indirect = lit and settings.bounces > 0
    gathered = indirect or (lit and survey.dome)
    glossy = lit and survey.roughness is not None
    deep = math.log2(2.0 + survey.triangles)  # levels that a ray descends in a tree of triangles
    triangles = survey.triangles * 1e-6
    records = 2e-6 * (survey.area_fine * settings.volume_resolution**2 + survey.area_coarse * settings.volume_coarse**2)
    passes: dict[str, Counts] = {"upload": {"frame": 1, "triangles": triangles}}
    if indirect or glossy:
        passes["voxelize"] = {"frame": 1, "records": records, "triangles": triangles}
        passes["light faces"] = {"frame": 1, "records": records}
    if indirect:
        texels = 1e-6 * sum(_texels(need, settings) for need in survey.maps)
        passes["rsm"] = {"maps": len(survey.maps), "texels": texels, "texels deep": texels * deep}
        passes["inject"] = {"maps": len(survey.maps), "texels": texels, "records": records}
    if indirect and settings.bounces > 1:
        rays = settings.patches_count * settings.patches_rays * 1e-6
        passes["bounces"] = {
            "frame": 1,
            "rays": rays,
            "rays deep": rays * deep,
            "transfers": rays * (settings.bounces - 1),
            "records": records,
        }
    passes["gbuffer"] = {"frame": 1, "pixels": pixels, "points": points, "points deep": points * deep}
    if lit:
        passes["direct"] = _direct(settings, survey, points, deep, before)
    if gathered:
        passes["gather"] = _gather(settings, survey, pixels, points, deep, before)
    if glossy:
        traced = survey.glossy * points * settings.glossy_rays
        passes["specular"] = {
            "frame": 1,
            "rays": traced,
            "rays deep": traced * deep,
            "light rays": traced * survey.lights,
            "points": survey.glossy * points,
        }
    passes["resolve"] = {"frame": 1, "points": points}
    passes["composite"] = {"frame": 1, "pixels": pixels}
    passes[REST] = {"frame": 1, "pixels": pixels, "triangles": triangles}
    return passes


def _texels(need: Any, settings: Settings) -> float:
    """Of a light's maps: of the fine and the coarse volume, before and after."""
    sizes = (
        min(max(16, math.ceil(per_voxel * n * settings.rsm_density)), settings.rsm_texels) if per_voxel * n > 0.0 else 0
        for per_voxel, n in ((need.fine, settings.volume_resolution), (need.coarse, settings.volume_coarse))
    )
    return (2 if need.pair else 1) * sum(float(size) ** 2 for size in sizes)


def _direct(settings: Settings, survey: Survey, points: float, deep: float, before: bool) -> Counts:
    probes = min(settings.shadows_probes, settings.shadows_samples)
    near = survey.near * points * settings.shadows_samples
    on_objects = survey.object * points * survey.lights * settings.shadows_samples
    everywhere = points * survey.lights * settings.shadows_samples if before else 0.0
    return {
        "frame": 1,
        "probes": points * survey.lights * probes,
        "near": near,
        "object": on_objects,
        "before": everywhere * deep,
        "points": points,
    }


def _gather(settings: Settings, survey: Survey, pixels: float, points: float, deep: float, before: bool) -> Counts:
    real = survey.real * pixels / settings.gather_stride**2 * settings.gather_rays
    on_object = survey.object * pixels / settings.gather_object_stride**2 * settings.gather_object_rays
    # Without a plate the real surfaces behind the objects are gathered point by point, with a quarter of the rays.
    behind = survey.object * points * max(1, settings.gather_rays // 4) if before else 0.0
    blocks = pixels / settings.gather_stride**2 + pixels / settings.gather_object_stride**2
    return {
        "frame": 1,
        "real rays": real + behind,
        "real rays met": (real + behind) * survey.met,  # such a ray also reads voxels
        "object rays": on_object,
        "object rays met": on_object * survey.met,
        "rays deep": (real + behind + on_object) * deep,
        "points": points,
        "blocks": blocks,
    }


@dataclass(frozen=True)
class CostModel:
    """Unit costs of one device.

    Attributes:
        device: ``cpu`` or a CUDA device's name. threads: That were used. machine: In words.
        units: Processor seconds (of the clock on CUDA) by pass and unit.
        speedup: By pass: how many times faster than one thread the clock says that ``threads`` were.
        spread: Standard deviation of the logarithm of measured over predicted frame times.
        shipped: Whether this is the package's own and not of this machine.
    """

    device: str
    threads: int
    machine: str
    units: dict[str, Counts]
    speedup: dict[str, float]
    spread: float
    shipped: bool = False

    def seconds(self, work: Mapping[str, Counts], threads: int) -> float:
        """Seconds of the clock that a frame takes with a number of threads."""
        return sum(self.by_pass(work, threads).values())

    def cpu_seconds(self, work: Mapping[str, Counts]) -> float:
        """Processor seconds of a frame."""
        return sum(self._cost(name, counts) for name, counts in work.items())

    def by_pass(self, work: Mapping[str, Counts], threads: int) -> dict[str, float]:
        """Seconds of the clock by pass."""
        return {name: self._cost(name, counts) / self._gain(name, threads) for name, counts in work.items()}

    def _cost(self, name: str, counts: Counts) -> float:
        units = self.units.get(name, {})
        return sum(units.get(unit, 0.0) * count for unit, count in counts.items())

    def _gain(self, name: str, threads: int) -> float:
        """Amdahl: the part of a pass that runs on one thread follows from its measured gain."""
        measured = self.speedup.get(name, 1.0)
        if self.threads < 2 or measured <= 1.0 or threads < 2:
            return 1.0
        serial = (self.threads / min(measured, float(self.threads)) - 1.0) / (self.threads - 1.0)
        return 1.0 / (serial + (1.0 - serial) / threads)


@dataclass(frozen=True)
class Sample:
    """A measured frame: its counts, and seconds by pass of all threads (``cpu``) and of the clock."""

    work: dict[str, Counts]
    cpu: dict[str, float]
    wall: dict[str, float]
    label: str = field(default="")


def fit(samples: Sequence[Sample], *, device: str, threads: int, machine: str) -> CostModel:
    """Unit costs from measured frames.

    Raises:
        ValueError: No sample.
    """
    if not samples:
        raise ValueError("no frame was measured")
    names = dict.fromkeys(name for s in samples for name in s.work)
    units, speedup = {}, {}
    for name in names:
        have = [s for s in samples if name in s.work and name in s.cpu]
        if not have:
            continue
        keys = list(dict.fromkeys(key for s in have for key in s.work[name]))
        counts = np.array([[s.work[name].get(key, 0.0) for key in keys] for s in have])
        seconds = np.array([max(s.cpu[name], 1e-9) for s in have])
        found = non_negative(counts / np.maximum(seconds, SMALLEST)[:, None], seconds / np.maximum(seconds, SMALLEST))
        units[name] = {key: float(value) for key, value in zip(keys, found, strict=True) if value > 0.0}
        gains = [s.cpu[name] / s.wall[name] for s in have if s.wall[name] > SHORT]
        # Other work on the machine only lowers it: a high quantile is nearer to what an idle machine does.
        speedup[name] = float(np.clip(np.quantile(gains, 0.9), 1.0, threads)) if gains else 1.0
    model = CostModel(device, threads, machine, units, speedup, 0.0)
    ratios = [math.log(sum(s.cpu.values()) / max(model.cpu_seconds(s.work), 1e-9)) for s in samples]
    return CostModel(device, threads, machine, units, speedup, float(np.std(ratios)))


def non_negative(matrix: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Least squares without negative unknowns (Lawson and Hanson 1974, "Solving Least Squares Problems", chapter 23).

    Args:
        matrix: ``[m, n]``. values: ``[m]``.
    """
    scale = np.linalg.norm(matrix, axis=0)
    scale[scale == 0.0] = 1.0
    a, n = matrix / scale, matrix.shape[1]
    x, active = np.zeros(n), np.zeros(n, bool)
    for _ in range(3 * n):
        gradient = a.T @ (values - a @ x)
        gradient[active] = -np.inf
        if active.all() or gradient.max() <= 1e-10 * np.linalg.norm(values):
            break
        active[int(np.argmax(gradient))] = True
        while True:
            trial = np.zeros(n)
            trial[active] = np.linalg.lstsq(a[:, active], values, rcond=None)[0]
            below = active & (trial <= 0.0)
            if not below.any():
                break
            step = np.min(x[below] / np.maximum(x[below] - trial[below], 1e-300))
            x = x + step * (trial - x)
            active &= x > 1e-14
        x = trial
    return x / scale


def machine_key(device: str) -> str:
    """Names the machine and device that a model belongs to."""
    text = f"{platform.node()} {platform.machine()} {processor()} {os.cpu_count()} {device}"
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def processor() -> str:
    """The processor's name."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor()


def model_file(device: str) -> Path:
    """Where this machine's model is kept: ``warp_dvct`` in the user's configuration (``XDG_CONFIG_HOME``)."""
    base = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    return base / "warp_dvct" / f"cost-{machine_key(device)}.json"


def load_model(device: str) -> CostModel:
    """This machine's model, or the shipped one for its processor where it was never calibrated.

    Raises:
        OptionError: A GPU was never calibrated: GPUs differ too much for a shipped model.
        FileError: The file is there and is no model; the message says how to make a new one.
    """
    file = model_file(device)
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        if device != "cpu":
            raise OptionError(
                f"what a frame costs on {device} is not known; run `warp-dvct calibrate --device {device}` once"
            ) from error
        return _parse(DEFAULT_FILE.read_text(encoding="utf-8"), DEFAULT_FILE, shipped=True)
    except OSError as error:
        raise FileError(f"{file} cannot be read: {error.strerror or error}") from error
    return _parse(text, file, shipped=False)


def save_model(model: CostModel, file: Path) -> None:
    """Write a model as JSON.

    Raises:
        FileError: The file cannot be written.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"{file.parent} cannot be made: {error.strerror or error}") from error
    content = {key: value for key, value in asdict(model).items() if key != "shipped"}
    write_text(file, json.dumps(content, indent=1) + "\n")


def _parse(text: str, file: Path, *, shipped: bool) -> CostModel:
    try:
        data = json.loads(text)
        model = CostModel(
            str(data["device"]),
            int(data["threads"]),
            str(data["machine"]),
            {p: {u: float(v) for u, v in units.items()} for p, units in data["units"].items()},
            {p: float(v) for p, v in data["speedup"].items()},
            float(data["spread"]),
            shipped,
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FileError(f"{file} is no cost model ({error!r}); remove it or run `warp-dvct calibrate`") from error
    if not model.units:
        raise FileError(f"{file} holds no unit costs; remove it or run `warp-dvct calibrate`")
    return model

"""What a unit of work costs on a device: seconds by pass and unit, fitted by ``warp-dvct calibrate``, kept per machine.

The fit is to processor seconds of each pass of real frames, by least squares of the relative error with no negative
cost. Beside them stands the factor by which all threads together were faster than one.
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

import numpy as np

from warp_dvct.errors import FileError, OptionError
from warp_dvct.image import write_text

DEFAULT_FILE = Path(__file__).with_name("cost.json")
SERIAL = frozenset(("frame", "maps", "lights"))  # launches and their preparation: one thread's work
SHORT = 2e-3  # seconds: in shorter passes the clock says little of threads
QUIET = 0.75  # quantile of measured gains: other work on the machine only lowers them
SMALLEST = 5e-4  # seconds: relative errors of shorter passes do not matter

Counts = dict[str, float]


@dataclass(frozen=True)
class CostModel:
    """Unit costs of one device.

    Attributes:
        device: ``cpu`` or a CUDA device's name. threads: That were used. machine: In words.
        units: Processor seconds (of the clock on CUDA) by pass and unit.
        speedup: By pass, of what is not ``SERIAL``: by the clock, how much faster than one thread all were.
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
        return price(work, self.clock_units(threads))

    def cpu_seconds(self, work: Mapping[str, Counts]) -> float:
        """Processor seconds of a frame."""
        return price(work, self.units)

    def by_pass(self, work: Mapping[str, Counts], threads: int) -> dict[str, float]:
        """Seconds of the clock by pass."""
        units = self.clock_units(threads)
        return {name: price({name: counts}, units) for name, counts in work.items()}

    def clock_units(self, threads: int) -> dict[str, Counts]:
        """As ``units``, by the clock with a number of threads."""
        return {
            name: {unit: cost if unit in SERIAL else cost / self._gain(name, threads) for unit, cost in units.items()}
            for name, units in self.units.items()
        }

    def _gain(self, name: str, threads: int) -> float:
        """Of what is not ``SERIAL``. Amdahl: the part that runs on one thread follows from the measured gain."""
        measured = self.speedup.get(name, 1.0)
        if self.threads < 2 or measured <= 1.0 or threads < 2:
            return 1.0
        serial = (self.threads / min(measured, float(self.threads)) - 1.0) / (self.threads - 1.0)
        return 1.0 / (serial + (1.0 - serial) / threads)


def price(work: Mapping[str, Counts], units: Mapping[str, Counts]) -> float:
    """Seconds of all passes' counts, given those of a unit by pass."""
    total = 0.0
    for name, counts in work.items():
        costs = units.get(name)
        if costs:
            for unit, cost in costs.items():
                total += cost * counts.get(unit, 0.0)
    return total


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
        speedup[name] = _speedup(name, units[name], have, threads)
    model = CostModel(device, threads, machine, units, speedup, 0.0)
    ratios = [math.log(sum(s.cpu.values()) / max(model.cpu_seconds(s.work), 1e-9)) for s in samples]
    return CostModel(device, threads, machine, units, speedup, float(np.std(ratios)))


def _speedup(name: str, units: Counts, samples: Sequence[Sample], threads: int) -> float:
    """How much faster all threads were, of frames in which the pass is no short one."""
    gains = []
    for s in samples:
        alone = sum(units.get(unit, 0.0) * n for unit, n in s.work[name].items() if unit in SERIAL)
        if s.wall[name] - alone > SHORT:
            gains.append((s.cpu[name] - alone) / (s.wall[name] - alone))
    return float(np.clip(np.quantile(gains, QUIET), 1.0, threads)) if gains else 1.0


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
        return shipped_model()
    except OSError as error:
        raise FileError(f"{file} cannot be read: {error.strerror or error}") from error
    return _parse(text, file, shipped=False)


def shipped_model() -> CostModel:
    """The package's own, of another machine's processor.

    Raises:
        FileError: It is broken.
    """
    return _parse(DEFAULT_FILE.read_text(encoding="utf-8"), DEFAULT_FILE, shipped=True)


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

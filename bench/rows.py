"""Rows of measurements: a file of JSON lines, each of which says on which machine, with what and when it was taken."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from warp_dvct.errors import FileError

PACKAGES = ("warp-dvct", "warp-lang", "numpy", "usd-core", "mitsuba", "flip-evaluator")


def provenance() -> dict[str, Any]:
    """``machine``, ``versions``, ``commit`` (None outside of a repository, ``+`` after it where files differ from it)
    and ``time``, JSON-ready."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return {
        "machine": describe_machine(),
        "versions": versions,
        "commit": commit(),
        "time": now(),
    }


def now() -> str:
    """The time of a row, UTC."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def describe_machine() -> dict[str, Any]:
    """Processor, cores that this process may use, GiB of memory, CUDA devices."""
    import warp as wp

    info = Path("/proc/cpuinfo")
    names = [s.split(":", 1)[1].strip() for s in _lines(info) if s.startswith("model name")]
    memory = [int(s.split()[1]) for s in _lines(Path("/proc/meminfo")) if s.startswith("MemTotal")]
    return {
        "processor": names[0] if names else platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(memory[0] / 2**20, 1) if memory else None,
        "cuda": [d.name for d in wp.get_cuda_devices()],
    }


def machine_line(machine: dict[str, Any]) -> str:
    """A machine in one line."""
    cuda = ", ".join(machine["cuda"]) or "no CUDA device"
    return f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gib']} GiB, {cuda}"


def commit() -> str | None:
    """The sources' commit, with a ``+`` where tracked files differ from it; None where there is no repository."""
    folder = Path(__file__).resolve().parent

    def git(*words: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(folder), *words], capture_output=True, text=True)
        except OSError:
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    name = git("rev-parse", "--short=12", "HEAD")
    return name and name + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")


def read_rows(file: Path, kind: str | None = None) -> list[dict[str, Any]]:
    """The rows of a file, in order; of one ``kind`` where that is given. A file that is not there has none.

    Raises:
        FileError: A line that is not a row; the message names it. Nothing is written in that case.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"rows cannot be read from {file}: {error}") from error
    rows = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except json.JSONDecodeError as error:
            raise _broken(file, number, f"{error.msg} at column {error.colno}") from error
        if not isinstance(row, dict) or not isinstance(row.get("kind"), str):
            raise _broken(file, number, 'an object with a "kind" is expected')
        rows.append(row)
    return [row for row in rows if kind is None or row["kind"] == kind]


def append_row(file: Path, row: dict[str, Any]) -> None:
    """Add one row at the end by a single write, so that a run that is stopped leaves whole lines.

    Raises:
        FileError: The file cannot be written, or what is there is no file of rows.
    """
    line = json.dumps(plain(row), allow_nan=False) + "\n"
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        try:
            end = os.lseek(descriptor, 0, os.SEEK_END)
            unfinished = end > 0 and os.pread(descriptor, 1, end - 1) != b"\n"
            os.write(descriptor, (("\n" if unfinished else "") + line).encode())
        finally:
            os.close(descriptor)
    except OSError as error:
        raise FileError(f"rows cannot be written to {file}: {error.strerror or error}") from error


def plain(value: Any) -> Any:
    """JSON-ready: NaN and infinities become null, paths and NumPy numbers their plain forms."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _broken(file: Path, number: int, why: str) -> FileError:
    return FileError(
        f"{file}:{number} is not a row of measurements ({why}); mend or remove that line, nothing was written"
    )


def _lines(file: Path) -> list[str]:
    try:
        return file.read_text().splitlines()
    except OSError:
        return []

"""What each kernel needs of a GPU, found without one: registers, spills, stack and shared memory per architecture.

Warp's own NVRTC compiles a module to PTX for the oldest architecture, which every later GPU takes, and NVIDIA's
``ptxas`` (package ``nvidia-cuda-nvcc``) assembles that for each architecture and says what it needed.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import re
import shutil
import subprocess
import sysconfig
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from warp_dvct.bench.doc_tables import read_table
from warp_dvct.errors import DeviceError, FileError

ARCHITECTURES = (75, 86, 90, 120)
GROWTH = 1.25  # a spill that was there may grow by this factor: other versions of ptxas choose otherwise

ENTRY = re.compile(r"Compiling entry function '(\w+)'")
FUNCTION = re.compile(r"Function properties for (\w+)")
FRAME = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads")
USED = re.compile(r"Used (\d+) registers")
SHARED = re.compile(r"(\d+) bytes smem")


@dataclass(frozen=True)
class Usage:
    """Of one kernel on one architecture.

    Attributes:
        registers: A thread. spills: Bytes a thread stores and loads because registers ran out. stack: Bytes a thread,
            spills included. shared: Bytes a block.
    """

    registers: int
    spills: int
    stack: int
    shared: int


def find_ptxas() -> str | None:
    """``ptxas`` of the package nvidia-cuda-nvcc, else the one on the path; None where none is as new as Warp's PTX."""
    wanted = wp.get_cuda_toolkit_version() or (0, 0)
    packages = sorted(Path(sysconfig.get_paths()["purelib"]).glob("nvidia/cu*/bin/ptxas"))
    for candidate in [*map(str, packages), shutil.which("ptxas")]:
        if candidate is not None and _release(candidate) >= wanted:
            return candidate
    return None


def ptxas_version(ptxas: str) -> str:
    """Release, as "13.5"."""
    return ".".join(map(str, _release(ptxas)))


def _release(ptxas: str) -> tuple[int, ...]:
    text = subprocess.run([ptxas, "--version"], capture_output=True, text=True, check=False).stdout
    found = re.search(r"release (\d+)\.(\d+)", text)
    return tuple(map(int, found.groups())) if found else (0, 0)


def build_module(name: str, folder: str, ptxas: str | None) -> dict[int, dict[str, Usage]]:
    """Build a module of kernels for all architectures; per architecture, usage by kernel.

    Without ``ptxas`` NVRTC builds binaries for the oldest and the newest, and their usage is not known (empty).

    Raises:
        DeviceError: A kernel does not build; the message is the compiler's.
    """
    importlib.import_module(name)
    module = wp.get_module(name)
    keys = [kernel.key for kernel in module.kernels.values()]
    wp.config.log_level = wp.LOG_WARNING
    if ptxas is None:
        ends = (ARCHITECTURES[0], ARCHITECTURES[-1])
        files = wp.compile_aot_module(module, arch=ends, module_dir=folder, use_ptx=False)
        for file in files:
            _check_kernels(name, keys, Path(file).read_bytes().decode("latin-1"))
        return {arch: {} for arch in ends}
    source = Path(wp.compile_aot_module(module, arch=ARCHITECTURES[0], module_dir=folder, use_ptx=True)[0])
    # Warp writes the string's closing zero as well, which ptxas does not read over.
    text = source.read_bytes().rstrip(b"\0")
    source.write_bytes(text)
    _check_kernels(name, keys, text.decode())
    found = {}
    for arch in ARCHITECTURES:
        command = [ptxas, "-v", f"-arch=sm_{arch}", str(source), "-o", f"{source}.{arch}.cubin"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise DeviceError(f"{name} does not assemble for sm_{arch}: {done.stderr.strip()[:500]}")
        found[arch] = parse_usage(done.stderr)
    return found


def _check_kernels(name: str, keys: Iterable[str], text: str) -> None:
    absent = [key for key in keys if key not in text]
    if absent:
        raise DeviceError(f"{name}: its CUDA build lacks {', '.join(absent)}")


def parse_usage(report: str) -> dict[str, Usage]:
    """What ``ptxas -v`` says of each kernel; functions that are not inlined count with the kernel before them."""
    found: dict[str, list[int]] = {}
    key = ""
    for line in report.splitlines():
        if match := ENTRY.search(line):
            key = re.sub(r"_[0-9a-f]{8}_cuda_kernel_(forward|backward)$", "", match.group(1))
            found[key] = [0, 0, 0, 0]
        elif match := FUNCTION.search(line):
            continue
        elif (match := FRAME.search(line)) and key:
            frame, stores, loads = map(int, match.groups())
            found[key][1] += stores + loads
            found[key][2] += frame
        elif key and (match := USED.search(line)):
            shared = SHARED.search(line)
            found[key][0] = int(match.group(1))
            found[key][3] = int(shared.group(1)) if shared else 0
    return {name: Usage(*values) for name, values in found.items()}


@contextmanager
def building(names: Iterable[str], folder: Path, ptxas: str | None) -> Iterator[dict[str, Future]]:
    """All builds, under way on every core, the largest source first."""
    import warp_dvct.kernels as package

    sources = Path(package.__path__[0])
    ordered = sorted(names, key=lambda name: -(sources / f"{name.rpartition('.')[2]}.py").stat().st_size)
    with ProcessPoolExecutor(os.cpu_count(), multiprocessing.get_context("spawn")) as pool:
        futures = {}
        for name in ordered:
            target = folder / name
            target.mkdir(parents=True, exist_ok=True)
            futures[name] = pool.submit(build_module, name, str(target), ptxas)
        yield futures


def format_usage(usage: dict[str, dict[int, dict[str, Usage]]]) -> str:
    """A Markdown table: a row per kernel, and for each architecture registers / spills / stack."""
    head = " | ".join(f"sm_{arch}" for arch in ARCHITECTURES)
    lines = [f"| file | kernel | shared | {head} |", "|" + "---|" * (3 + len(ARCHITECTURES))]
    for name in sorted(usage):
        for key in sorted(usage[name][ARCHITECTURES[0]]):
            each = [usage[name][arch][key] for arch in ARCHITECTURES]
            cells = " | ".join(f"{u.registers} / {u.spills} / {u.stack}" for u in each)
            lines.append(f"| {name.rpartition('.')[2]} | `{key}` | {max(u.shared for u in each)} | {cells} |")
    return "\n".join(lines)


def usage_table(page: Path) -> str:
    """The table that ``bench cuda --write`` left in a page, without the line of the assembler's version.

    Raises:
        FileError: The page cannot be read, or has no place for a table.
    """
    lines = read_table(page, "usage").splitlines()
    return "\n".join(line for line in lines if line.startswith("|"))


def parse_table(table: str) -> dict[tuple[str, str], dict[int, int]]:
    """Spills by (file, kernel) and architecture of a table that :func:`format_usage` wrote.

    Raises:
        FileError: A row is not of that form; the message has its number.
    """
    lines = [line.strip() for line in table.splitlines() if line.strip()]
    heads = [cell.strip() for cell in lines[0].strip("|").split("|")] if lines else []
    archs = [int(head.removeprefix("sm_")) for head in heads[3:]]
    found = {}
    for number, line in enumerate(lines[2:], 3):
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        try:
            spills = {arch: int(cell.split("/")[1]) for arch, cell in zip(archs, cells[3:], strict=True)}
            found[cells[0], cells[1].strip("`")] = spills
        except (IndexError, ValueError) as error:
            raise FileError(f"row {number} of the table of CUDA usage is broken: {line}") from error
    return found


def new_spills(usage: dict[str, dict[int, dict[str, Usage]]], table: str) -> list[str]:
    """What spills now and did not when ``table`` was written, or spills a quarter more: one line each."""
    known = parse_table(table)
    found = []
    for name, by_arch in sorted(usage.items()):
        file = name.rpartition(".")[2]
        for arch, kernels in sorted(by_arch.items()):
            for key, used in sorted(kernels.items()):
                before = known.get((file, key), {}).get(arch, 0)
                if used.spills > before * GROWTH:
                    found.append(
                        f"{file}.{key} spills {used.spills} bytes a thread on sm_{arch};"
                        f" when docs/cuda.md was written it was {before}"
                    )
    return found

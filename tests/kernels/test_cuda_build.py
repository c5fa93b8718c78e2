"""Every kernel builds for CUDA without a GPU, spills no more than documented, and keeps the launcher's rules."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path

import pytest
import warp as wp

import warp_dvct.kernels as package
from warp_dvct.bench.cuda_usage import (
    ARCHITECTURES,
    Usage,
    build_module,
    building,
    find_ptxas,
    format_usage,
    new_spills,
    parse_table,
    parse_usage,
    usage_table,
)
from warp_dvct.cli.warmup import kernel_modules
from warp_dvct.errors import DeviceError, FileError

FILES = sorted(p for p in Path(package.__path__[0]).glob("*.py") if p.name != "__init__.py")
MODULES = kernel_modules()
PTXAS = find_ptxas()
DIFFERENTIATED = {"light_fit"}  # a tape runs backwards through these
PAGE = Path(__file__).parents[2] / "docs" / "cuda.md"


def test_the_modules_are_found():
    assert {"warp_dvct.kernels.composite", "warp_dvct.kernels.tonemap"} <= set(MODULES)
    assert {name.rpartition(".")[2] for name in MODULES} <= {file.stem for file in FILES}


@pytest.fixture(scope="module")
def builds(tmp_path_factory) -> Iterator[dict[str, Future]]:
    """All builds, in processes of their own: this is the suite's longest work."""
    with building(MODULES, tmp_path_factory.mktemp("cuda"), PTXAS) as futures:
        yield futures


@pytest.mark.parametrize("name", MODULES)
def test_module_builds_for_cuda_and_spills_nothing_new(name, builds):
    """``build_module`` raises where a kernel is missing or does not assemble."""
    usage = builds[name].result()
    if PTXAS is None:
        assert set(usage) == {ARCHITECTURES[0], ARCHITECTURES[-1]}
        return
    assert set(usage) == set(ARCHITECTURES)
    kernels = {kernel.key for kernel in wp.get_module(name).kernels.values()}
    for used in usage.values():
        assert kernels <= set(used)
        assert all(1 <= used[key].registers <= 255 for key in kernels)
    assert new_spills({name: usage}, usage_table(PAGE)) == []


REPORT = """
ptxas info    : Compiling entry function '_splat_0a1b2c3d_cuda_kernel_forward' for 'sm_90'
ptxas info    : Function properties for _splat_0a1b2c3d_cuda_kernel_forward
    {stack} bytes stack frame, {spill} bytes spill stores, {spill} bytes spill loads
ptxas info    : Used 96 registers, used 0 barriers, 1024 bytes smem
"""


def usage_of(spill: int) -> dict[str, dict[int, dict[str, Usage]]]:
    report = REPORT.format(stack=spill, spill=spill)
    return {"warp_dvct.kernels.ism": {arch: parse_usage(report) for arch in ARCHITECTURES}}


def test_a_spill_that_was_not_there_before_is_named():
    assert usage_of(0)["warp_dvct.kernels.ism"][75]["_splat"] == Usage(96, 0, 0, 1024)
    table, spilled = format_usage(usage_of(0)), usage_of(8)
    found = new_spills(spilled, table)
    assert len(found) == len(ARCHITECTURES)
    assert found[0].startswith("ism._splat spills 16 bytes a thread on sm_75")
    assert new_spills(spilled, format_usage(spilled)) == []
    assert new_spills(usage_of(9), format_usage(spilled)) == []  # an eighth more: another version of ptxas
    assert len(new_spills(usage_of(12), format_usage(spilled))) == len(ARCHITECTURES)
    assert len(new_spills(spilled, "")) == len(ARCHITECTURES)  # not in the table: taken to spill nothing


def test_functions_that_are_not_inlined_count_with_their_kernel():
    """ptxas lists them after the kernel that calls them, with their spills but no registers of their own."""
    function = """
ptxas info    : Function properties for _ZN1_a44_trace_pair_0E17Geometry
    16 bytes stack frame, 100 bytes spill stores, 50 bytes spill loads
"""
    assert parse_usage(REPORT.format(stack=4, spill=1) + function)["_splat"] == Usage(96, 152, 20, 1024)


def test_a_broken_table_is_an_error():
    lines = format_usage(usage_of(8)).splitlines()
    with pytest.raises(FileError, match="row 3"):
        parse_table("\n".join([*lines[:2], lines[2].replace("/", "-")]))


def test_a_module_that_does_not_assemble_is_named(tmp_path):
    broken = tmp_path / "ptxas"
    broken.write_text("#!/bin/sh\necho 'no such register' >&2\nexit 1\n")
    broken.chmod(0o755)
    with pytest.raises(DeviceError, match="tonemap does not assemble for sm_75: no such register"):
        build_module("warp_dvct.kernels.tonemap", str(tmp_path), str(broken))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_file_sets_module_options_before_anything_else(file):
    body = [node for node in ast.parse(file.read_text()).body if not isinstance(node, ast.Import | ast.ImportFrom)]
    if ast.get_docstring(ast.parse(file.read_text())) is not None:
        body = body[1:]
    options = f"'enable_backward': {file.stem in DIFFERENTIATED}, 'fuse_fp': False"
    flags = ", 'cpu_compiler_flags': CPU_FLAGS" if "CPU_FLAGS" in file.read_text() else ""
    assert ast.unparse(body[0]) == f"wp.set_module_options({{{options}{flags}}})"


@pytest.mark.parametrize("name", MODULES)
def test_kernels_take_their_slabs_start_first(name):
    importlib.import_module(name)
    for kernel in wp.get_module(name).kernels.values():
        first = kernel.adj.args[0]
        assert (first.label, first.type) in (("first", int), ("first", wp.int32)), f"{kernel.key}: {first.label}"
        assert kernel.key.startswith("_"), f"{kernel.key}: kernels are private names"


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_only_the_launcher_starts_kernels(file):
    assert "wp.launch" not in file.read_text()

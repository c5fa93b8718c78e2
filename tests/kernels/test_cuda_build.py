"""Every kernel builds for CUDA without a GPU, and keeps the rules that the launcher relies on."""

from __future__ import annotations

import ast
import importlib
import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path

import pytest
import warp as wp

import warp_dvct.kernels as package
from warp_dvct.cli.warmup import kernel_modules

ARCHITECTURES = [75, 90]
FILES = sorted(p for p in Path(package.__path__[0]).glob("*.py") if p.name != "__init__.py")
SIZES = {file.stem: file.stat().st_size for file in FILES}
MODULES = kernel_modules()


def test_the_modules_are_found():
    assert {"warp_dvct.kernels.composite", "warp_dvct.kernels.tonemap"} <= set(MODULES)
    assert {name.rpartition(".")[2] for name in MODULES} <= {file.stem for file in FILES}


def build(name: str, folder: str) -> dict[int, bytes]:
    """Compile a module; the binary per architecture. Runs in a process of its own: this is the suite's longest work."""
    importlib.import_module(name)
    files = [Path(f) for f in wp.compile_aot_module(wp.get_module(name), arch=ARCHITECTURES, module_dir=folder)]
    return {arch: next(f for f in files if f"sm{arch}" in f.name).read_bytes() for arch in ARCHITECTURES}


@pytest.fixture(scope="module")
def builds(tmp_path_factory) -> Iterator[dict[str, Future[dict[int, bytes]]]]:
    """All builds, under way on every core, the largest first."""
    largest_first = sorted(MODULES, key=lambda name: -SIZES[name.rpartition(".")[2]])
    with ProcessPoolExecutor(os.cpu_count(), multiprocessing.get_context("spawn")) as pool:
        yield {name: pool.submit(build, name, str(tmp_path_factory.mktemp("cuda"))) for name in largest_first}


@pytest.mark.parametrize("name", MODULES)
def test_module_builds_for_cuda(name, builds):
    binaries = builds[name].result()
    for kernel in wp.get_module(name).kernels.values():
        for arch, binary in binaries.items():
            assert kernel.key.encode() in binary, f"{kernel.key} is missing for sm_{arch}"


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_file_sets_module_options_before_anything_else(file):
    body = [node for node in ast.parse(file.read_text()).body if not isinstance(node, ast.Import | ast.ImportFrom)]
    if ast.get_docstring(ast.parse(file.read_text())) is not None:
        body = body[1:]
    assert ast.unparse(body[0]) == "wp.set_module_options({'enable_backward': False})"


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

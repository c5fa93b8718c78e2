"""The package's public face: few names, nothing heavy loaded, typed, every folder installed."""

from __future__ import annotations

import importlib
import pkgutil
import subprocess
import sys
from importlib.metadata import entry_points, version
from pathlib import Path

import pytest

import warp_dvct

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pytest brings it

ROOT = Path(__file__).parent.parent
HEAVY = ("pxr", "open3d", "warp", "OpenEXR", "OpenImageIO", "mitsuba")


def loaded_after(statement: str) -> set[str]:
    """Top-level modules that a fresh interpreter holds after ``statement``."""
    code = f"import sys\n{statement}\nprint(*{{name.partition('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_import_loads_nothing_heavy():
    assert not loaded_after("import warp_dvct") & set(HEAVY)


def test_relighter_and_command_load_usd_only_to_read_a_stage():
    assert not loaded_after("from warp_dvct import Relighter, relight; import warp_dvct.cli") & {"pxr", "open3d"}


def test_public_names_are_those_that_are_listed():
    assert dir(warp_dvct) == sorted(warp_dvct.__all__)
    for name in warp_dvct.__all__:
        assert getattr(warp_dvct, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'Relightr'"):
        _ = warp_dvct.Relightr


def test_version_is_the_installed_one_and_in_the_changelog():
    assert warp_dvct.__version__ == version("warp-dvct")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == warp_dvct.__version__
    assert f"## [{warp_dvct.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_package_is_marked_as_typed():
    assert (Path(warp_dvct.__file__).parent / "py.typed").is_file()


def test_command_is_installed():
    (script,) = entry_points(group="console_scripts", name="warp-dvct")
    assert callable(script.load())


def test_every_folder_with_code_is_in_the_installed_package():
    declared = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    folders = {"warp_dvct"} | {
        "warp_dvct." + ".".join(file.parent.relative_to(ROOT / "warp_dvct").parts)
        for file in (ROOT / "warp_dvct").rglob("*/__init__.py")
    }
    mapped = {
        "warp_dvct." + ".".join(file.parent.relative_to(ROOT).parts)
        for folder in ("kernels", "usd_scenes", "bench")
        for file in (ROOT / folder).rglob("__init__.py")
    }
    assert declared == folders | mapped
    for name in declared:
        importlib.import_module(name)


def test_every_module_can_be_imported():
    for folder in (ROOT / "warp_dvct", ROOT / "kernels"):
        prefix = "warp_dvct." if folder.name == "warp_dvct" else "warp_dvct.kernels."
        for module in pkgutil.walk_packages([str(folder)], prefix):
            importlib.import_module(module.name)

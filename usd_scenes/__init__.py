"""The bundled stages: :func:`names` lists them, :func:`path` gives a file that any USD tool opens.

``README.md`` in this folder says what each is for and which answer is known. ``make.py`` writes them.
"""

from __future__ import annotations

import difflib
import hashlib
import importlib.util
import os
import tempfile
from pathlib import Path

from warp_dvct.errors import FileError, OptionError, StageError

FOLDER = Path(__file__).parent
BUNNY_ASSET = "warp/examples/assets/bunny.usd"


def names() -> list[str]:
    """The bundled stages' names, sorted."""
    return sorted(file.stem for file in FOLDER.glob("*.usda"))


def path(name: str) -> Path:
    """The file of a bundled stage.

    ``bunny`` references a model of the installed warp-lang package: a copy of the stage with that model's absolute
    path is written into the user's cache (``XDG_CACHE_HOME``, or ``~/.cache``) and its path is returned.

    Raises:
        OptionError: No stage of that name.
        StageError: The warp-lang package has no bunny.
        FileError: The cache cannot be written.
    """
    if name not in names():
        near = difflib.get_close_matches(name, names(), n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise OptionError(f"there is no bundled stage '{name}'; {hint}bundled are {', '.join(names())}")
    file = FOLDER / f"{name}.usda"
    text = file.read_text(encoding="utf-8")
    if BUNNY_ASSET not in text:
        return file
    return _write_once(cache_folder() / "stages", name, text.replace(f"@{BUNNY_ASSET}@", f"@{bunny_model()}@"))


def cache_folder() -> Path:
    """``warp_dvct`` in the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "warp_dvct"


def bunny_model() -> str:
    """The Stanford bunny that the warp-lang package brings, a USD file.

    Raises:
        StageError: It is not there.
    """
    spec = importlib.util.find_spec("warp")
    for folder in (spec and spec.submodule_search_locations) or []:
        file = Path(folder).parent / BUNNY_ASSET
        if file.is_file():
            return file.as_posix()
    raise StageError(
        f"stage 'bunny' needs {BUNNY_ASSET} of the warp-lang package, which is not installed; reinstall warp-lang"
    )


def _write_once(folder: Path, name: str, text: str) -> Path:
    """Write ``text`` where its content decides the folder, by renaming, so that parallel runs cannot disturb it."""
    target = folder / hashlib.sha256(text.encode()).hexdigest()[:12] / f"{name}.usda"
    try:
        if target.is_file() and target.read_text(encoding="utf-8") == text:
            return target
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=target.parent, suffix=".tmp", delete=False, encoding="utf-8") as out:
            out.write(text)
        os.replace(out.name, target)
    except OSError as error:
        raise FileError(f"stage '{name}' cannot be written to {target}: {error}; set XDG_CACHE_HOME") from error
    return target

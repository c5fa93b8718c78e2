"""Stages over stages: what is made of a capture is a layer of its own, and the capture stays as it is."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warp_dvct.errors import FileError, OptionError
from warp_dvct.image import replacing
from warp_dvct.usd.stage import open_stage, quiet_diagnostics

if TYPE_CHECKING:
    from pxr import Usd


@contextmanager
def overlay(source: str | Path, output: str | Path) -> Iterator[Usd.Stage]:
    """A new stage with ``source`` as its sublayer, to be edited; it becomes ``output`` at the end.

    Raises:
        OptionError: ``output`` is ``source``. StageError: ``source`` cannot be read.
        FileError: ``output`` cannot be written; what was there stays.
    """
    from pxr import Usd

    target = Path(os.path.abspath(output))
    if target == Path(os.path.abspath(source)):
        raise OptionError(f"'{output}' is the stage that it is made of; give another name")
    with quiet_diagnostics(), replacing(target) as temporary:
        below = open_stage(source)
        stage = Usd.Stage.CreateNew(str(temporary))
        stage.GetRootLayer().subLayerPaths.append(relative(source, target.parent))
        _copy_metadata(below, stage)
        yield stage
        save(stage.GetRootLayer(), target)


def relative(file: str | Path, folder: Path) -> str:
    """A file as an asset path relative to a folder."""
    path = os.path.relpath(os.path.abspath(file), folder)
    return path if path.startswith("..") else f"./{path}"


def save(layer: Any, target: Path) -> None:
    """Save a layer.

    Raises:
        FileError: It cannot be written; the message names ``target``, not the layer's temporary name.
    """
    from pxr import Tf

    try:
        layer.Save()
    except Tf.ErrorException as error:
        raise FileError(f"{target} cannot be written: {error}; is the disk full?") from error


def _copy_metadata(below: Usd.Stage, stage: Usd.Stage) -> None:
    """What a root layer has to repeat of its sublayer's: default prim, axes, units, frames, render settings."""
    from pxr import UsdGeom

    stage.GetRootLayer().defaultPrim = below.GetRootLayer().defaultPrim
    UsdGeom.SetStageUpAxis(stage, UsdGeom.GetStageUpAxis(below))
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.GetStageMetersPerUnit(below))
    stage.SetFramesPerSecond(below.GetFramesPerSecond())
    stage.SetTimeCodesPerSecond(below.GetTimeCodesPerSecond())
    if below.HasAuthoredTimeCodeRange():
        stage.SetStartTimeCode(below.GetStartTimeCode())
        stage.SetEndTimeCode(below.GetEndTimeCode())
    settings = below.GetMetadata("renderSettingsPrimPath")
    if settings:
        stage.SetMetadata("renderSettingsPrimPath", settings)

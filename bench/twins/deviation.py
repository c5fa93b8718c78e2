"""How far a kernel's float32 output is from its twin's float64 one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

OTHERWISE = 1e-3  # of the largest value: beyond it rounding changed a decision (a ray slips past an edge), not a digit


@dataclass(frozen=True)
class Deviation:
    """One output of one kernel against its twin.

    Attributes:
        family: The kernel's file. kernel, output: Its name and the array's.
        elements: How many values were compared.
        largest: Largest difference over the largest value of the twin, of the elements that were decided alike.
        otherwise: Share of the elements that were decided otherwise: those that differ by more than ``OTHERWISE``.
    """

    family: str
    kernel: str
    output: str
    elements: int
    largest: float
    otherwise: float


def compare(kernel: Any, output: str, got: np.ndarray, twin: np.ndarray) -> Deviation:
    """Compare arrays of one shape, element by element (an element is a row)."""
    got, twin = np.asarray(got, np.float64), np.asarray(twin, np.float64)
    if got.shape != twin.shape:
        raise ValueError(f"{kernel.key}, {output}: shapes {got.shape} and {twin.shape} differ")
    size = np.abs(twin).max() if twin.size else 0.0
    apart = np.abs(got - twin).reshape(len(got), -1).max(-1) / (size or 1.0)
    alike = apart <= OTHERWISE
    largest = float(apart[alike].max()) if alike.any() else 0.0
    family = kernel.module.name.rpartition(".")[2]
    return Deviation(family, kernel.key, output, got.size, largest, float(1.0 - alike.mean()))


def measure_all(launcher: Any) -> list[Deviation]:
    """Every twin, in the order of the passes."""
    from warp_dvct.bench.twins import direct, frames, glossy, indirect, pictures, surfaces, volumes, vpls

    found: list[Deviation] = []
    measures: list[Callable[[Any], Any]] = [
        *(surfaces.measure_gbuffer, direct.measure_rsm, direct.measure_direct),
        *(direct.measure_path_tracing, volumes.measure_voxels, volumes.measure_injection, volumes.measure_pyramid),
        *(indirect.measure_cones, indirect.measure_rays, glossy.measure_glossy_rays),
        *(indirect.measure_specular, glossy.measure_lobe_smoothing, indirect.measure_bounces),
        *(volumes.measure_albedos, surfaces.measure_indirect_shading),
        indirect.measure_reconstruction,
        *(vpls.measure_warping, vpls.measure_vpls, vpls.measure_vpl_bounces, frames.measure_history),
        *(frames.measure_lens, frames.measure_light_fit, frames.measure_light_fit_jacobian),
        *(pictures.measure_resolve, pictures.measure_pictures),
    ]
    for measure in measures:
        found += measure(launcher)
    return found


def format_deviations(rows: list[Deviation]) -> str:
    """A Markdown table."""
    lines = ["| file | kernel | output | values | largest deviation | decided otherwise |", "|---|---|---|---|---|---|"]
    for row in rows:
        share = f"{row.otherwise:.2%}" if row.otherwise else "none"
        lines.append(f"| {row.family} | `{row.kernel}` | {row.output} | {row.elements} | {row.largest:.1e} | {share} |")
    return "\n".join(lines)

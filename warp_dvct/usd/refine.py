"""Which meshes are refined as subdivision surfaces, how often, and what of them is not modelled."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from warp_dvct.errors import OptionError, StageError
from warp_dvct.usd.context import Context
from warp_dvct.usd.subdivision import SCHEMES, Creases, Level, Refinement

if TYPE_CHECKING:
    from pxr import UsdGeom

COMPLEXITIES = ("low", "medium", "high", "veryhigh")  # usdrecord's names for none, one, two and three refinements
MOST_FACES = 2**19  # of a refined mesh: beyond, its faces are smaller than any voxel or pixel that they could show in


def refinement_levels(complexity: str) -> int:
    """How often a complexity refines.

    Raises:
        OptionError: It is not among ``COMPLEXITIES``.
    """
    if complexity not in COMPLEXITIES:
        raise OptionError(f"complexity is '{complexity}'; choose one of {', '.join(COMPLEXITIES)}")
    return COMPLEXITIES.index(complexity)


def refine(
    mesh: UsdGeom.Mesh, points: np.ndarray, counts: np.ndarray, indices: np.ndarray, ctx: Context
) -> Refinement | None:
    """The subdivision surface of a mesh; None where its polygons are what is drawn.

    Args:
        points, counts, indices: Of the mesh, checked.
    Raises:
        StageError: Creases or corners do not fit the mesh.
    """
    path, scheme = str(mesh.GetPath()), str(mesh.GetSubdivisionSchemeAttr().Get(ctx.time))
    if scheme == "none":
        return None
    if ctx.levels == 0 or scheme not in SCHEMES:
        ctx.notices.add(path, f"subdivisionScheme is {scheme}: drawn as its control mesh")
        return None
    if (counts < 3).any() or (scheme == "loop" and (counts != 3).any()):
        what = "faces of fewer than three corners" if (counts < 3).any() else "faces that are no triangles"
        ctx.notices.add(path, f"subdivisionScheme is {scheme}, but it has {what}: drawn as its control mesh")
        return None
    first = 4 * len(counts) if scheme == "loop" else len(indices)  # faces after one refinement; then four times more
    levels = sum(first * 4**level <= MOST_FACES for level in range(ctx.levels))
    if levels < ctx.levels:
        drawn = f"refined {levels} of {ctx.levels} times" if levels else "drawn as its control mesh"
        ctx.notices.add(path, f"a subdivision mesh of {len(counts)} faces: {drawn}")
    if levels == 0:
        return None
    return Refinement(Level(len(points), counts, indices, scheme, _creases(mesh, len(points), path, ctx)), levels)


def _creases(mesh: UsdGeom.Mesh, count: int, path: str, ctx: Context) -> Creases:
    """Creases and corners, with one sharpness for each crease or for each of its edges."""

    def numbers(attribute: Any, kind: Any) -> np.ndarray:
        return np.array(attribute.Get(ctx.time) or (), dtype=kind)

    def refuse(name: str, problem: str) -> None:
        raise StageError(f"{path}: {name} {problem}; repair the creases or set subdivisionScheme to none")

    along, lengths = numbers(mesh.GetCreaseIndicesAttr(), np.int64), numbers(mesh.GetCreaseLengthsAttr(), np.int64)
    sharp = numbers(mesh.GetCreaseSharpnessesAttr(), np.float64)
    corners, corner_sharp = (
        numbers(mesh.GetCornerIndicesAttr(), np.int64),
        numbers(mesh.GetCornerSharpnessesAttr(), np.float64),
    )
    for name, values in (("creaseIndices", along), ("cornerIndices", corners)):
        if len(values) and (values.min() < 0 or values.max() >= count):
            bad = values[(values < 0) | (values >= count)][0]
            refuse(name, f"has the index {bad}, but there are {count} points")
    if (lengths < 2).any() or lengths.sum() != len(along):
        refuse("creaseLengths", f"add up to {lengths.sum()}, but there are {len(along)} creaseIndices")
    if len(sharp) == len(lengths):
        sharp = np.repeat(sharp, lengths - 1)
    if len(sharp) != (lengths - 1).sum():
        refuse("creaseSharpnesses", f"has {len(sharp)} values for {len(lengths)} creases")
    if len(corner_sharp) != len(corners):
        refuse("cornerSharpnesses", f"has {len(corner_sharp)} values for {len(corners)} corners")
    if not (np.isfinite(sharp).all() and np.isfinite(corner_sharp).all()):
        refuse("creaseSharpnesses or cornerSharpnesses", "has NaN or infinite values")
    starts = np.ones(len(along), bool)
    starts[np.cumsum(lengths) - 1] = False  # the last vertex of a crease starts no edge
    first = np.flatnonzero(starts)
    rule = str(mesh.GetInterpolateBoundaryAttr().Get(ctx.time))
    if rule == "none":
        ctx.notices.add(path, "interpolateBoundary none is not modelled: its border faces are drawn")
    edges = np.stack([along[first], along[first + 1]], 1) if len(first) else np.zeros((0, 2), np.int64)
    return Creases(edges, np.maximum(sharp, 0.0), corners, np.maximum(corner_sharp, 0.0), rule == "edgeAndCorner")

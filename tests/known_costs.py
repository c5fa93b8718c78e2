"""A made machine whose frames cost what is written here, for tests of budgets."""

from __future__ import annotations

from warp_dvct.budget import Choice, choose
from warp_dvct.cost_model import CostModel


def made_model(threads: int = 2) -> CostModel:
    """Unit costs of one's own, in about the proportions of a real machine."""
    units = {
        "survey": {"frame": 0.05},
        "voxelize": {"frame": 0.02, "records": 0.4},
        "rsm": {"texels": 0.17},
        "bounces": {"frame": 0.01, "met": 0.3, "records": 0.2},
        "direct": {"frame": 0.005, "probes": 0.05, "near deep": 0.005},
        "gather": {"frame": 0.005, "rays": 0.3, "synthetic deep": 0.03, "points": 0.2, "steps": 0.1},
        "pyramid": {"records above": 0.7},
        "specular": {"sharp": 1.0, "cones": 0.3},
        "gbuffer": {"pixels": 0.3},
        "ism": {"maps": 1e-6, "splats": 0.1, "texels": 0.09},
        "vpl shading": {"points": 0.5, "pairs": 0.1},
        "vpl bounces": {"points": 1.0},
    }
    return CostModel("cpu", threads, "made", units, {"gather": 2.0, "rsm": 1.5}, 0.1)


def chosen(surveys, stage: str = "room_area", **request) -> Choice:
    """A choice on the made machine at 320 x 180."""
    return choose(surveys[stage], made_model(), width=320, height=180, threads=2, **request)

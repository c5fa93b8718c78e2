"""Float64 NumPy twins of the kernels: the same formulas, written once more to be read, and how far float32 is off.

Each ``measure_*`` function runs kernels on small inputs, runs their twins on the same numbers in double, and returns a
:class:`Deviation` per output. ``python -m warp_dvct.bench numerics`` prints them all.
"""

from warp_dvct.bench.twins.deviation import Deviation, format_deviations, measure_all

__all__ = ["Deviation", "format_deviations", "measure_all"]

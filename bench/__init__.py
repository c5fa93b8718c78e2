"""Measurements: ``python -m warp_dvct.bench error`` and ``table1``; ``docs/benchmarks.md`` says how to read them."""

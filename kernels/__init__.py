"""Warp kernels: imports, constants, structs, funcs and kernels only. Host code is in ``warp_dvct.passes``."""

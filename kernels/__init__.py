"""Warp kernels: imports, constants, structs, funcs and kernels only. Host code is in ``warp_dvct.passes``.

Every file turns off the fusing of products and sums (``fuse_fp``): a GPU's compiler fuses differently in each kernel
that a function is inlined into, so that one kernel would write more than another has counted room for.
"""

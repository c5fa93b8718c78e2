"""Warp kernels: imports, constants, structs, funcs and kernels only. Host code is in ``warp_dvct.passes``.

Every file turns off the fusing of products and sums (``fuse_fp``): a GPU's compiler fuses differently in each kernel
that a function is inlined into, so that one kernel would write more than another has counted room for.

Functions take structs of arrays by value, a kilobyte or more. Compiled into their kernels that costs nothing; the calls
that Warp's own flags leave on a CPU copy them for each ray. Files whose kernels are large set ``CPU_FLAGS``: Warp's own
but for the size up to which functions are compiled in. Of 9000 (Warp's), 15000, 25000, 40000 and 100000, measured in
``room_area`` and ``room_glossy``, 25000 is the least that gathered rays gain from; from 40000 on glossy ones lose.
"""

CPU_FLAGS = (
    "-march=native -mllvm=-inline-threshold=25000 -mllvm=-inline-cold-callsite-threshold=3000"
    " -mllvm=-slp-recursion-max-depth=4"
)

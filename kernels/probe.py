"""Work of a known amount, to see how fast the machine is just now."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def _work(first: int, steps: int, value_out: wp.array(dtype=wp.float32)):
    """Steps of arithmetic that depend on each other; memory is hardly touched."""
    i = first + wp.tid()
    x = 1.0 / float(i + 1)
    for _ in range(steps):
        x = wp.sqrt(x * x + 0.5) * 0.75
    value_out[i] = x

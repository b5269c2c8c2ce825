"""Kernels on Vulkan, in a process of its own: ``python -m tests.vulkan_run WHAT OUT``. What Taichi makes of
that device is no device of ours; this shows what it can and cannot do.

WHAT: 'zeros' (leading zeros of four numbers), 'wide' (of one of 64 bits), 'loops' (turns of a loop with a
loop in it, and of a long one), 'clearance' (of eight maps). Exit code 3: no Vulkan here.
"""

import sys

import numpy as np
import taichi as ti

NO_VULKAN = 3
NUMBERS = (1, -1, -(1 << 31), 0x7FFFFFFF)
TURNS, MANY = 6, 200_000


@ti.kernel
def count_zeros(numbers: ti.template(), out: ti.template()):  # type: ignore[valid-type]
    """Leading zeros."""
    for i in numbers:
        out[i] = ti.cast(ti.math.clz(numbers[i]), ti.i32)


@ti.kernel
def draw_each(out: ti.template()):  # type: ignore[valid-type]
    """out[row] = (turns of a loop that draws until a draw is good, as ``draw_moving_bodies`` does; draws)."""
    for row in range(out.shape[0]):
        for k in range(TURNS):
            found, draw = 0, 0
            while found == 0 and draw < 64:
                if draw >= k + row:
                    found = 1
                draw += 1
            out[row, 0] += 1
            out[row, 1] += draw


@ti.kernel
def count_up(out: ti.template(), many: ti.i32):  # type: ignore[valid-type]
    """out[row] = turns of a long loop."""
    for row in out:
        for _ in range(many):
            out[row] += 1


def zeros(numbers: np.ndarray, dtype) -> np.ndarray:
    """Leading zeros of each."""
    given, out = ti.field(dtype, len(numbers)), ti.field(ti.i32, len(numbers))
    given.from_numpy(numbers)
    count_zeros(given, out)
    return out.to_numpy()


def clearance() -> np.ndarray:
    """(3, n_env, n_row, n_col): clearance, row and column of its site, of the maps of the tests."""
    from tests import test_clearance

    return np.stack(test_clearance.Stage(n_slot=test_clearance.N_ENV).compute(test_clearance.maps_of(3)))


def main() -> None:
    """See the module."""
    what, out = sys.argv[1:]
    ti.init(arch=ti.vulkan, offline_cache=False, cfg_optimization=False, log_level=ti.ERROR)
    if ti.cfg.arch != ti.vulkan:
        sys.exit(NO_VULKAN)
    if what == "zeros":
        result = zeros(np.array(NUMBERS, np.int32), ti.i32)
    elif what == "wide":
        result = zeros(np.array([1], np.int64), ti.i64)
    elif what == "loops":
        nested, long = ti.field(ti.i32, (8, 2)), ti.field(ti.i32, 8)
        draw_each(nested)
        count_up(long, MANY)
        result = np.stack([nested.to_numpy()[:, 0], long.to_numpy()])
    else:
        result = clearance()
    np.save(out, result)


if __name__ == "__main__":
    main()

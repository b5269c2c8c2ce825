"""Copy chosen rows of a field into a host buffer: recording must not copy every env to look at one."""

import taichi as ti

from uuvtai.kernels.core.signature import AnyTensor, In, IntVector, Out


@ti.kernel
def copy_rows(field: In[ti.Field], envs: IntVector, out: AnyTensor):
    """out[i] = field[envs[i]] for a field of rank 1, 2 or 3 (vectors add a last axis)."""
    for i in range(envs.shape[0]):
        env = envs[i]
        if ti.static(len(field.shape) == 1):
            _copy_cell(field, out, ti.Vector([env]), ti.Vector([i]))
        elif ti.static(len(field.shape) == 2):
            for j in range(ti.static(field.shape[1])):
                _copy_cell(field, out, ti.Vector([env, j]), ti.Vector([i, j]))
        else:
            for j, k in ti.ndrange(ti.static(field.shape[1]), ti.static(field.shape[2])):
                _copy_cell(field, out, ti.Vector([env, j, k]), ti.Vector([i, j, k]))


@ti.func
def _copy_cell(field: In[ti.Field], out: Out[ti.Field], source, target):
    if ti.static(hasattr(field, "n")):
        for c in ti.static(range(field.n)):
            out[target, c] = field[source][c]
    else:
        out[target] = field[source]

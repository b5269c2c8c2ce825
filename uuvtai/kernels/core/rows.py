"""Copy chosen rows of a field into a host buffer: recording must not copy every env to look at one."""

import taichi as ti

from uuvtai.kernels.core.signature import AnyTensor, In, IntVector, Out


@ti.kernel
def copy_rows(field: In[ti.Field], envs: IntVector, out: AnyTensor):
    """out[i] = field[envs[i]] for a field of rank 1, 2 or 3 (vectors add a last axis)."""
    for i in range(envs.shape[0]):
        env = envs[i]
        if ti.static(len(field.shape) == 1):
            _copy_cell(field, out, env, i)
        elif ti.static(len(field.shape) == 2):
            for j in range(ti.static(field.shape[1])):
                _copy_cell_2(field, out, env, i, j)
        else:
            for j, k in ti.ndrange(ti.static(field.shape[1]), ti.static(field.shape[2])):
                _copy_cell_3(field, out, env, i, j, k)


@ti.func
def _copy_cell(field: In[ti.Field], out: Out[ti.Field], env, i):
    if ti.static(hasattr(field, "n")):
        for c in ti.static(range(field.n)):
            out[i, c] = field[env][c]
    else:
        out[i] = field[env]


@ti.func
def _copy_cell_2(field: In[ti.Field], out: Out[ti.Field], env, i, j):
    if ti.static(hasattr(field, "n")):
        for c in ti.static(range(field.n)):
            out[i, j, c] = field[env, j][c]
    else:
        out[i, j] = field[env, j]


@ti.func
def _copy_cell_3(field: In[ti.Field], out: Out[ti.Field], env, i, j, k):
    if ti.static(hasattr(field, "n")):
        for c in ti.static(range(field.n)):
            out[i, j, k, c] = field[env, j, k][c]
    else:
        out[i, j, k] = field[env, j, k]

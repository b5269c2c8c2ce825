"""Machine code of the kernels' own: kept on disk, launched without Taichi's launcher (``docs/native.md``)."""

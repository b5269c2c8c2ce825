"""CUDA without a GPU: Taichi compiles for a driver that only writes down what it is given, ``ptxas``
assembles that, and what it says is counted. Nothing of it ever runs."""

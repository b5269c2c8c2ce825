"""Taichi: its start, its kernels' machine code, and all that works around it (``taichi_frontend``)."""

"""Taichi kernels, one file per stage. Stages never import each other; all of them may import the floor."""

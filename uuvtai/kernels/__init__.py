"""Taichi kernels, one file per stage. Stages never import each other; all of them may import the floor."""

from uuvtai.taichi_patches.front_end import remember_sources

remember_sources()

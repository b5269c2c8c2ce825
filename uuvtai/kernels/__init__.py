"""Taichi kernels, one file per stage. Stages never import each other; all of them may import the floor."""

from uuvtai.compile.taichi_frontend import remember_sources

remember_sources()

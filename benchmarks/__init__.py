"""Speed beside peers from PyPI: ``python benchmarks/run.py``. Every module with a function ``measure`` is a
benchmark."""

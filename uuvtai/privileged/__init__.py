"""The oracle, which knows the truth: how well could anybody do. Plain NumPy on scenarios, apart from the
stack.

``measure`` may import this package; nothing that senses, plans or drives may (an import contract says so).
"""

"""Yardsticks that know the truth: how well could anybody do, and how hard is a condition. Plain NumPy on
scenarios, apart from the stack.

``measure`` may import this package; nothing that senses, plans or drives may (an import contract says so).
"""

"""The stack as a folder of machine code and NumPy."""

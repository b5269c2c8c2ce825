"""A trained policy as a folder: ONNX graph, card, runner in NumPy."""

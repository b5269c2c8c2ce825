"""Floor: what kernels of several rooms share. Nothing here knows a stage."""

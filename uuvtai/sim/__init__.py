"""The simulator of one step: which stage comes after which."""

"""Episodes: their clock, how they end, what a step is worth."""

"""Episodes while they run: paced by the clock, served to viewers."""

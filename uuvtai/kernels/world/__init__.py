"""What stands and moves in the water."""

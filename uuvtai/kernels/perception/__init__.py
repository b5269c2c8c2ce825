"""Bodies that move, where they will be, and the map."""

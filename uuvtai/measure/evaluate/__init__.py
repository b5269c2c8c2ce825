"""``uuv eval``: methods side by side on the same episodes, the ceilings above them, what is kept of it."""

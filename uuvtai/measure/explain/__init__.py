"""``uuv eval --explain``: failed episodes played again, and why each failed."""

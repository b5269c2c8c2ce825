"""What the command line shows: tables that fit the terminal, progress, and results in words. Nothing here
computes a result."""

"""What every room may use: errors and exits, files, signals, processes, statistics, codes."""

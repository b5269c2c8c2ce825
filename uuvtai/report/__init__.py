"""The report of a run: one self-contained HTML page. Reads run folders only."""

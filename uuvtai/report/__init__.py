"""The report of a run: one self-contained HTML page with its tables, figures, pictures and videos. Reads run
folders only."""

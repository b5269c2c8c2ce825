"""A benchmark that others can enter: fixed scenes, an entry as a file, and the check of an entry by replay."""

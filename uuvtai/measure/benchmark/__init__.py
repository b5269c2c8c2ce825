"""A benchmark that others can enter: fixed scenes, an entry as a file, its check by replay."""

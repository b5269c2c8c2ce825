"""What is shown as a table: built here once from a command's document, rendered by ``show`` (terminal),
``report`` (HTML) and ``markdown`` (pages). A floor: rows and words, nothing that computes a result."""

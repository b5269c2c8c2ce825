"""Local planners of the literature, as rows to compare with. Launched only where the tree has their leaf."""

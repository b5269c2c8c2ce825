"""The batch as an environment: torch tensors, Gymnasium, other trainers."""

"""Yardsticks: what perception would know if it knew the truth. The only kernels that read the truth and write
what the stack reads."""

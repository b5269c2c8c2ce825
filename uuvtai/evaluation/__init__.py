"""Agents on the same episodes: rates, causes of failure, sweeps, the paper."""

"""Clearance, routes, and what of all that the policy reads."""

"""Episode logs: MCAP files that an outsider can check every claim with, and the tools around them."""

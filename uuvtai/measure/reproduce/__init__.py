"""The whole paper by one command: train what is missing, evaluate, sweep, profile, and say of every claim
whether it holds."""

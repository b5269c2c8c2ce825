"""uuvtai: train, measure and inspect observation-only navigation for underwater vehicles."""

__version__ = "0.1.0"

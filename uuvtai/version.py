"""The version, apart from the package's front door, which knows the simulator."""

__version__ = "0.1.0"

"""Our water for ArduSub: the simulator behind its JSON interface, in lockstep (docs/sitl.md)."""

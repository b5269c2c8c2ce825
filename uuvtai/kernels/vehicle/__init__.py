"""From an action to thrust, and from thrust to motion."""

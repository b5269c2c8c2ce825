"""The stack on a vehicle that speaks MAVLink: what it hears, decides and says (docs/safety.md)."""

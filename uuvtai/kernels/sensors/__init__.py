"""What the vehicle senses."""

"""A kinematic simulator in which policies train faster."""

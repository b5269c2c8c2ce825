"""A kinematic twin of the simulator: the same scenarios, bodies and referee, the vehicle's velocity loops
axis by axis, and a model of what the tracker delivers in place of sensing. Decisions at 10 Hz."""

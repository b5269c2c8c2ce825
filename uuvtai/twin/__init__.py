"""The kinematic twin: the same scenarios, motion and referee, a vehicle by fitted lags, tracks by a model of
the tracker. Policies learn here at 10 Hz, many times faster than in the simulator, and drive there unchanged."""

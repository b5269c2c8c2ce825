"""The kinematic twin: the simulator's scenarios, motion and referee, a vehicle by lags, tracks by a model of
the tracker, ten decisions a second. A floor for learning: nothing trains in it yet."""

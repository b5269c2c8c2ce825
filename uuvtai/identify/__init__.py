"""From a log of a drive to the numbers of the vehicle: damping, added mass, buoyancy, thrust."""

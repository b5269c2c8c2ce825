"""A policy over a set of bodies in numbers: widths of what it is told, and of the rule that lays its wish on
the hull. Read by kernels, by what learns, and by what is exported without them."""

N_BODY = 9
"""moving bodies that the policy sees, the nearest ones"""
BODY_WIDTH = 22
"""columns of a body"""
OWN_WIDTH = 17
"""columns of the vehicle and its goal"""
N_RAY = 24
"""rays of free distance around the vehicle"""
EGO_COLUMNS = OWN_WIDTH + N_RAY
"""columns of the vehicle's own, rays included"""

TURN_GAIN = 2.5
"""[1/s] yaw rate by the angle that is still to turn"""
LEAST_SPEED_M_S = 0.1
"""below it the vehicle keeps its heading"""

"""What a learned forecast is told and what it says, in numbers: read by its kernels and by what learns."""

PACKET = 16
"""columns and units come in whole packets (``kernels.core.lanes.LANES``)"""

N_PAST, PAST_S = 10, 0.3
"""places remembered of each track, and the time between them"""
N_BEND = 4
"""turns remembered of each track"""
LENGTH_M, FAR = 4.0, 2.0
AHEAD_STEPS = (5, 10, 15, 20, 25)
"""samples of the forecast that are told"""
N_FRAME = 5
N_MOTION, N_AHEAD = 12, 9
COLUMNS = N_MOTION + N_AHEAD + 2 * len(AHEAD_STEPS) + 3 * N_BEND + 2 * N_PAST + 1
N_COLUMN = PACKET * -(-COLUMNS // PACKET)
"""with padding, which is 0"""
SIDE_COLUMNS = (
    1,
    N_MOTION + 6,
    *(N_MOTION + N_AHEAD + 2 * i + 1 for i in range(len(AHEAD_STEPS))),
    *(N_MOTION + N_AHEAD + 2 * len(AHEAD_STEPS) + 3 * i + 1 for i in range(N_BEND)),
    *(COLUMNS - 2 - 2 * i for i in range(N_PAST)),
)
"""columns that change their sign in a mirror along the course"""
FAR_COLUMNS = ((N_MOTION + 2, N_MOTION + 3),)
"""pairs of columns that change their places in it: the walls to the left and to the right"""


N_MODE, ANCHORS, ANCHOR_S = 6, 5, 0.5
N_HIDDEN = 64
N_TOLD = N_MODE * (1 + 2 * ANCHORS)
N_SAID = PACKET * -(-N_TOLD // PACKET)
"""with padding"""
N_SPREAD = 2 * ANCHORS * N_MODE
"""the trained network says spreads too, which the kernel leaves out"""
MIDDLE = (1 + N_COLUMN) * N_HIDDEN
LAST = MIDDLE + (1 + N_HIDDEN) * N_HIDDEN
N_WEIGHT = LAST + (1 + N_HIDDEN) * N_SAID
"""numbers of the three layers, each its biases, then a row for each input"""

"""A* on the clearance grid, by the built-in planner's rule: ``uuv eval --planner examples/own_astar.py``."""

import heapq

import numpy as np

STEPS = [(r, c, (r * r + c * c) ** 0.5) for r in (-1, 0, 1) for c in (-1, 0, 1) if r or c]


def plan(clearance, cell_m, start, goal, forecast):
    near = 1 / np.clip(clearance, 0.1, 2.0)  # below 0.35 m only to get out of there
    weight = np.select([clearance > 0.349, clearance > 0], [near, 100.0], np.inf)
    first, last = [tuple((place[::-1] // cell_m).astype(int).tolist()) for place in (start, goal)]
    rows, heap, cost, after = weight.tolist(), [(0.0, 0.0, last)], {last: 0.0}, {last: last}
    while heap and (top := heapq.heappop(heap))[2] != first:  # from the goal back to the start
        for r, c, length in STEPS if top[1] <= cost[top[2]] else ():
            row, col = cell = top[2][0] + r, top[2][1] + c
            offer = top[1] + 0.5 * length * (rows[row - r][col - c] + rows[row][col])
            if offer < cost.get(cell, np.inf):
                cost[cell], after[cell] = offer, top[2]
                left = 0.51 * ((row - first[0]) ** 2 + (col - first[1]) ** 2) ** 0.5
                heapq.heappush(heap, (offer + left, offer, cell))
    way = [first] if first in cost else []
    while way and way[-1] != last:  # on to the farthest cell that a straight line reaches as cheaply
        here, cell, far = way[-1], way[-1], after[way[-1]]
        for cell in [cell := after[cell] for _ in range(100)]:
            line = weight[tuple(np.linspace(here, cell, 200).round().astype(int).T)]
            far = cell if line.mean() * np.hypot(*np.subtract(cell, here)) <= cost[here] - cost[cell] else far
        way.append(far)
    return (np.array(way)[:, ::-1] + 0.5) * cell_m if way else None

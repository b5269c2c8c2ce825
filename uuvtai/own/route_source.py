"""A planner of the user's in the place of the simulator's own (``rrt.RoutePlanner``)."""

from __future__ import annotations

import inspect

import numpy as np
import torch

from uuvtai.own import answers
from uuvtai.own.own_driver import OwnCode
from uuvtai.own.protocol import Forecast
from uuvtai.rrt import PlanRequest


class RouteSource:
    """Calls ``plan(clearance, cell_m, start, goal, forecast)`` for one env after the other; ``row=`` too
    where it has that parameter."""

    def __init__(self, code: OwnCode, cell_m: float, forecast_dt_s: float) -> None:
        self.code, self._cell_m, self._dt_s = code, cell_m, forecast_dt_s
        self._wants_row = "row" in inspect.signature(code.act).parameters

    def reset(self, mask: torch.Tensor) -> None:
        """New episodes begin in the rows (n_env,) where this is not 0."""
        self.code.forget(mask)

    def plan(self, asked: PlanRequest) -> np.ndarray | None:
        """Corners (n >= 2, 2) [m] from start to goal; None = no way. PieceError for any other answer."""
        forecast = Forecast(asked.body, asked.radius_m, self._dt_s)
        more = {"row": asked.env} if self._wants_row else {}

        def called(_given: None) -> object:
            return self.code.act(
                asked.clearance_m, self._cell_m, asked.start.copy(), asked.goal.copy(), forecast, **more
            )

        found = self.code.called(called, None, 1)
        if found is None:
            return None
        n_row, n_col = asked.clearance_m.shape
        size_m = n_col * self._cell_m, n_row * self._cell_m
        return answers.waypoints(found, (asked.start, asked.goal), size_m, self.code.place)

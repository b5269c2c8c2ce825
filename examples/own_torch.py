"""All vehicles at once, named columns in torch: ``uuv eval --agent bt,examples/own_torch.py:Pilot``."""

import torch

from uuvtai import View, plugin


@plugin(arrays="torch")
class Pilot:
    """Follows the route, slower where something is near ahead, and backs off from what closes in fast."""

    def __init__(self, about):
        self.limits = torch.as_tensor(about.limits, device=about.device)
        self.calm = torch.zeros(about.num_envs, device=about.device)  # [s] without danger, one number an env

    def reset(self, rows):
        self.calm[rows] = 0.0

    def act(self, view: View):
        sine, cosine = view["heading_error"].unbind(1)
        ahead = [-1, 0, 1]  # sectors, counter-clockwise from ahead
        room, left_s = view["sector_range"][:, ahead].amin(1), view["sector_ttc"].amin(1)
        calm = torch.where(left_s < 1.5, 0.0, self.calm[view.rows] + view.dt_s)
        self.calm[view.rows] = calm
        surge = cosine.clamp(0, 1) * ((room - 0.5) / 0.7).clamp(-0.5, 1) * (0.3 + calm).clamp(max=1.0)
        heave = (view["lookahead"][:, 2] / 0.4).clamp(-1, 1)
        turn = (1.5 * torch.atan2(sine, cosine)).clamp(-1, 1)
        return torch.stack([surge, torch.zeros_like(surge), heave, turn], 1) * self.limits

"""Running uncertainty of the world model and the scale it gives the distillation (paper, Sec. "Latent World
Model")."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from uuvtai.config.learning import UncertaintyConfig


class Uncertainty(nn.Module):
    """Exponential moving average of the batch's uncertainty proxy and the distillation scale s_t.

    sigma_bar <- (1 - rho) sigma_bar + rho sigma_t, s_t = clip(1 + alpha sigma_bar, 1, s_max). sigma_bar
    begins at the first value that is seen, not at zero, which would take some 1 / rho iterations to wear off.
    """

    mean: Tensor
    seen: Tensor

    def __init__(self, config: UncertaintyConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.zeros((), dtype=torch.float64))
        self.register_buffer("seen", torch.zeros((), dtype=torch.bool))

    @torch.no_grad()
    def update(self, sigma: Tensor) -> None:
        """Take in the uncertainty of a batch, any shape; values that are not finite are left out, a batch of
        none changes nothing."""
        finite = torch.isfinite(sigma)
        if not bool(finite.any()):
            return
        newest = sigma[finite].double().mean()
        rho = self.config.ema
        self.mean.copy_(torch.where(self.seen, (1.0 - rho) * self.mean + rho * newest, newest))
        self.seen.fill_(True)

    @property
    def scale(self) -> float:
        """s_t: factor of the distillation weight, in [1, max_scale]."""
        return min(max(1.0 + self.config.gain * float(self.mean), 1.0), self.config.max_scale)

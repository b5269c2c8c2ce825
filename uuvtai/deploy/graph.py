"""One decision without memory as a torch module and as an ONNX graph; whoever calls it remembers the last
decision."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import warnings
from collections.abc import Iterator

import torch
from torch import Tensor, nn

from uuvtai.deploy.onnx_session import without_telemetry
from uuvtai.learn.pilot import Pilot
from uuvtai.learn.policy import NUM_ACTIONS
from uuvtai.learn.world_model import N_FEATURES

INPUTS = {
    "obs": "(N, n_obs) float32: the newest observation, raw SI units; what is not finite counts as the "
    "training's mean",
    "last_obs": "(N, n_obs) float32: the observation of the last decision; anything where has_last is false",
    "last_action": "(N, 4) float32: the action of the step in which the last decision was made",
    "has_last": "(N,) bool: there was a decision before in this mission",
}
OUTPUTS = {
    "mean_action": "(N, 4) float32: mean action, not yet cut off to [-1, 1]",
    "value": "(N,) float32: expected return",
    "features": "(N, 2) float32: residual and uncertainty of the world model's last prediction",
}
PACKAGES = ("onnx", "onnxscript")
"""what torch's exporter needs"""
OPSET = 20


class ExportedModule(nn.Module):
    """What is exported as a graph: inputs and outputs by name."""

    inputs: dict[str, str]
    """what each one is, in the order of ``forward``"""

    @property
    def outputs(self) -> list[str]:
        """Names of what ``forward`` returns."""
        raise NotImplementedError

    def example(self) -> tuple[tuple[Tensor, ...], dict[str, dict[int, torch.export.Dim]]]:
        """Inputs of two rows, and which of their axes may have any size."""
        raise NotImplementedError


class OneDecision(ExportedModule):
    """``Pilot`` for one decision: outputs by the names of OUTPUTS."""

    inputs = INPUTS
    fill: Tensor
    """(n_obs,) what counts where a value is not finite"""

    def __init__(self, pilot: Pilot) -> None:
        super().__init__()
        self.policy, self.world_model = pilot.policy, pilot.world_model
        self.register_buffer(
            "fill", pilot.policy.observation_norm.mean[: pilot.policy.n_in - N_FEATURES].float()
        )

    @property
    def outputs(self) -> list[str]:
        """Names of what ``forward`` returns."""
        return list(OUTPUTS)

    def example(self) -> tuple[tuple[Tensor, ...], dict[str, dict[int, torch.export.Dim]]]:
        """As in ``ExportedModule``."""
        n_obs, rows = self.policy.n_in - N_FEATURES, torch.export.Dim("rows", min=1)
        some = torch.zeros(2, n_obs), torch.zeros(2, n_obs), torch.zeros(2, NUM_ACTIONS)
        return (*some, torch.tensor([True, False])), {name: {0: rows} for name in INPUTS}

    def forward(
        self, obs: Tensor, last_obs: Tensor, last_action: Tensor, has_last: Tensor
    ) -> tuple[Tensor, ...]:
        """Shapes as INPUTS says."""
        obs, last_obs = (torch.where(torch.isfinite(seen), seen, self.fill) for seen in (obs, last_obs))
        features = obs.new_zeros(obs.shape[0], N_FEATURES)
        if self.world_model is not None:
            features = torch.where(
                has_last[:, None], self.world_model.features(last_obs, last_action, obs), features
            )
        x = torch.cat([obs, features], dim=1)
        mean, _ = self.policy.distribution(x)
        return mean, self.policy.value(x), features


def missing_packages() -> list[str]:
    """What has to be installed before an ONNX graph can be written; empty = nothing."""
    return [name for name in PACKAGES if importlib.util.find_spec(name) is None]


def onnx_bytes(decision: ExportedModule) -> bytes:
    """The ONNX graph with its weights inside, any number of rows at once. Needs PACKAGES."""
    without_telemetry()
    example, sizes = decision.example()
    with _quiet():
        program = torch.onnx.export(
            decision.eval(),
            example,
            input_names=list(decision.inputs),
            output_names=decision.outputs,
            dynamic_shapes=sizes,
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    return program.model_proto.SerializeToString()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """The exporter talks about itself on every channel there is; what it cannot do it raises."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        before = logging.root.manager.disable
        logging.disable(logging.WARNING)
        try:
            yield
        finally:
            logging.disable(before)

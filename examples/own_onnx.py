"""Writes a policy as ONNX: ``python examples/own_onnx.py``, then ``uuv eval --agent model.onnx``."""

import onnx
import torch

import uuvtai


class Policy(torch.nn.Module):
    """Observations (n, M) in SI units -> actions (n, 4) in [-1, 1]. Yours would have learnt weights."""

    def __init__(self, columns):
        super().__init__()
        self.at = {name: place.start for name, place in columns.items()}

    def forward(self, obs):
        sine, cosine = obs[:, self.at["heading_error"]], obs[:, self.at["heading_error"] + 1]
        room = torch.stack([obs[:, self.at["sector_range"] + i] for i in (0, 1, 11)]).amin(0)  # nearest ahead
        surge = cosine.clamp(0.0, 1.0) * ((room - 0.5) / 0.7).clamp(-0.5, 1.0)
        heave = obs[:, self.at["lookahead"] + 2] / 0.4
        return torch.stack([surge, 0 * surge, heave, 1.5 * sine], 1).clamp(-1.0, 1.0)


if __name__ == "__main__":
    env = uuvtai.make("pool", num_envs=1)
    any_n = {"input_names": ["obs"], "dynamic_axes": {"obs": {0: "rows"}}, "dynamo": False}
    torch.onnx.export(Policy(env.columns).eval(), (torch.zeros(2, env.num_obs),), "model.onnx", **any_n)
    model = onnx.load("model.onnx")
    model.metadata_props.add(key="hold_steps", value="10")  # of 0.02 s each
    onnx.save(model, "model.onnx")

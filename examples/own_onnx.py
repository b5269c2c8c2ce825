"""Writes a policy as ONNX: ``python examples/own_onnx.py``, then ``uuv eval --policy model.onnx``."""

import torch

import uuvtai


class Policy(torch.nn.Module):
    """Observations (n, M) in SI units -> actions (n, 4) in [-1, 1]. Yours would have learnt weights."""

    def __init__(self, columns):
        super().__init__()
        self.at = {name: place.start for name, place in columns.items()}

    def forward(self, obs):
        sine, cosine = obs[:, self.at["heading_error"]], obs[:, self.at["heading_error"] + 1]
        sector = self.at["sector_range"]  # counter-clockwise from ahead
        room = torch.minimum(obs[:, sector], torch.minimum(obs[:, sector + 1], obs[:, sector + 11]))
        surge = cosine.clamp(0.0, 1.0) * ((room - 0.5) / 0.7).clamp(-0.5, 1.0)
        heave = (obs[:, self.at["lookahead"] + 2] / 0.4).clamp(-1.0, 1.0)
        return torch.stack([surge, 0 * surge, heave, (1.5 * sine).clamp(-1.0, 1.0)], 1)


if __name__ == "__main__":
    env = uuvtai.make("pool", num_envs=1)
    example, rows = (torch.zeros(2, env.num_obs),), ({0: torch.export.Dim("rows", min=1)},)
    made = torch.onnx.export(Policy(env.columns).eval(), example, dynamo=True, dynamic_shapes=rows)
    made.model_proto.metadata_props.add(key="hold_steps", value="10")  # of 0.02 s each
    made.save("model.onnx")

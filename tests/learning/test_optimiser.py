"""Adam that does not import torch's compiler (``export/test_deploy.py`` looks): torch's own numbers."""

import pytest
import torch

from uuvtai.learning.networks import PlainAdam


@pytest.mark.parametrize("fused", [False, True])
def test_steps_and_states_are_those_of_torch(fused):
    found = []
    for kind in (PlainAdam, torch.optim.Adam):
        weight = torch.nn.Parameter(torch.linspace(-1, 1, 50))
        optimiser = kind([weight], lr=0.01, fused=fused)
        for number in range(20):
            optimiser.zero_grad()
            (weight - number).square().sum().backward()
            optimiser.step()
        found.append((weight.detach(), optimiser.state_dict()))
    (weight, state), (expected, known) = found
    assert torch.equal(weight, expected) and not weight.equal(torch.linspace(-1, 1, 50))
    assert state["param_groups"] == known["param_groups"]
    assert all(torch.equal(state["state"][0][name], value) for name, value in known["state"][0].items())


def test_a_state_of_torchs_is_taken():
    weight = torch.nn.Parameter(torch.ones(3))
    theirs, ours = torch.optim.Adam([weight]), PlainAdam([weight])
    weight.grad = torch.ones(3)
    theirs.step()
    ours.load_state_dict(theirs.state_dict())
    assert ours.state[weight]["step"] == 1

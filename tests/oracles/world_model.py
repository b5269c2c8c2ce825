"""World model's forward pass and losses in NumPy float64, from a model's parameters."""

import numpy as np

LOW, HIGH = -12.0, 6.0


def _softplus(x):
    return np.logaddexp(0.0, x)


def _mlp(net, x):
    layers = [m for m in net if hasattr(m, "weight")]
    for number, layer in enumerate(layers):
        x = x @ layer.weight.detach().double().numpy().T + layer.bias.detach().double().numpy()
        if number < len(layers) - 1:
            x = np.where(x > 0, x, np.expm1(np.minimum(x, 0)))
    return x


def encode(model, obs):
    """z of raw observations, from the running moments; deviations count as 0.01 at least."""
    norm = model.observation_norm
    std = np.maximum(np.sqrt(norm.m2.numpy() / norm.count.item()), 1e-2)
    return _mlp(model.encoder, np.clip((obs - norm.mean.numpy()) / std, -10, 10))


def losses(model, obs, action, next_obs):
    """(reconstruction, dynamics) of every sample, each (B,)."""
    ahead = _mlp(model.dynamics, np.concatenate([encode(model, obs), np.clip(action, -1, 1)], axis=1))
    out = _mlp(model.decoder, ahead)
    mean, log_var = out[:, :24], HIGH - _softplus(HIGH - LOW - _softplus(out[:, 24:] - LOW))
    error = 0.5 * ((next_obs[:, :24] - mean) ** 2 * np.exp(-log_var) + log_var)
    return error.sum(axis=1), ((encode(model, next_obs) - ahead) ** 2).sum(axis=1)

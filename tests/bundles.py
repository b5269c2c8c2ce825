"""Bundles for tests of single stages, made once for the same parts: another bundle compiles anew."""

from dataclasses import is_dataclass

import numpy as np

from uuvtai.config import Config
from uuvtai.config.base import Section
from uuvtai.sim.stages import bind

_made = {}


def io_for(bundle, *parts):
    """The bundle with these structs and sections, those of a config, or those that a test's stage has as
    attributes; what is not given is None, and a kernel that touches it does not compile."""
    parts = [each for part in parts for each in _structs_of(part)]
    key = (bundle, *map(id, parts))
    if key not in _made:  # the parts stay alive: their identities are the key
        _made[key] = bind(bundle, *parts, partial=True), parts
    return _made[key][0]


def _structs_of(part):
    if isinstance(part, Config):
        return [getattr(part, name) for name in type(part).model_fields]
    if is_dataclass(part) or isinstance(part, Section):
        return [part]
    return [value for value in vars(part).values() if type(value).__module__.startswith("uuvtai.state")]


def clear(*structs):
    """Zero in every field."""
    for struct in structs:
        for field in vars(struct).values():
            field.fill(0)


def put(struct, **fields):
    """Values into fields by name, in their own types; one value for all is enough."""
    for name, value in fields.items():
        field = getattr(struct, name)
        old = field.to_numpy()
        field.from_numpy(np.broadcast_to(np.asarray(value).astype(old.dtype), old.shape).copy())

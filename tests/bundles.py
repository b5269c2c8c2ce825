"""Bundles for tests of single stages: made of the parts at hand, once for the same parts (a kernel is
compiled anew for another bundle)."""

import numpy as np

from uuvtai.sim.stages import bind

_made = {}


def io_for(bundle, *parts):
    """The bundle with these structs and sections; what is not given is None, and a kernel that touches it
    does not compile."""
    key = (bundle, *map(id, parts))
    if key not in _made:
        _made[key] = (
            bind(bundle, *parts, partial=True),
            parts,
        )  # the parts stay alive: their identities are the key
    return _made[key][0]


def clear(*structs):
    """Zero in every field."""
    for struct in structs:
        for field in vars(struct).values():
            field.fill(0)


def put(struct, **fields):
    """Values into fields by name, in their own types."""
    for name, value in fields.items():
        field = getattr(struct, name)
        field.from_numpy(np.asarray(value).astype(field.to_numpy().dtype))

"""Structs and bundles for tests of single stages, made once for the same parts: another bundle compiles
anew."""

from collections import defaultdict
from dataclasses import fields, is_dataclass
from functools import cache
from typing import get_type_hints

import numpy as np
import pytest

from tests.oracles import scenes
from uuvtai import state
from uuvtai.config import Config
from uuvtai.config.base import Section
from uuvtai.sim.stages import SimState, bind, members_of

STRUCTS = get_type_hints(SimState)
_made = {}


class Stage:
    """The structs of the simulator by their nouns, each allocated when it is first used: by its noun, or as
    a part of a bundle, where ``sizes`` has all its axes."""

    sizes = {}
    other = 0
    """length of every axis that ``sizes`` does not have; 0 = there is none"""

    def __init__(self, **sizes):
        self.sizes = {**type(self).sizes, **sizes}
        if self.other:
            self.sizes = defaultdict(lambda: self.other, self.sizes)

    @classmethod
    def fixture(cls):
        """A fixture: one of a module."""
        return pytest.fixture(scope="module")(cache(cls))

    @classmethod
    def begun(cls):
        """A fixture: one of a module, which begins anew with every test."""
        made = cache(cls)
        return pytest.fixture(lambda: made().begin())

    def __getattr__(self, noun):
        if noun not in STRUCTS:
            raise AttributeError(noun)
        struct = state.allocate(STRUCTS[noun], self.sizes)
        setattr(self, noun, struct)
        return struct

    def io(self, bundle, *sections):
        """The bundle with the structs of this stage and these sections."""
        kinds = {kind.__name__: noun for noun, kind in STRUCTS.items()}
        nouns = [kinds[kind] for kind in members_of(bundle).values() if kind in kinds]
        structs = [
            getattr(self, noun) for noun in nouns if noun in vars(self) or self._has_sizes(STRUCTS[noun])
        ]
        return io_for(bundle, *structs, *sections)

    def _has_sizes(self, struct):
        return (
            self.other
            or {axis for field in fields(struct) for axis in field.metadata["shape"]} <= self.sizes.keys()
        )

    def start(self, scene=None, key=1, active=1):
        """Every row at step 0, with a scene of the ray casters where one is given; row i has the random key
        ``key`` + i."""
        if scene is not None:
            scenes.load(scene, self.vehicle, self.world)
        put(self.episode, key=key + np.arange(self.sizes["n_env"]))
        put(self.clock, active=active, step=0)


def io_for(bundle, *parts):
    """The bundle with these structs and sections, those of a config, or those that a test's stage has as
    attributes; what is not given is None, and a kernel that touches it does not compile."""
    parts = [each for part in parts for each in _structs_of(part)]
    # structs stay alive, so that their identities are keys; sections that say the same compile the same
    key = (bundle, *(part if isinstance(part, Section) else id(part) for part in parts))
    if key not in _made:
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

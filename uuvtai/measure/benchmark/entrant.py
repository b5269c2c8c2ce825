"""Who enters a benchmark: one pilot, by a shipped name, a file or a piece of the user's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from uuvtai.errors import SettingError
from uuvtai.measure.evaluate.eval_request import ORACLE, drivers_of
from uuvtai.own.piece_spec import is_piece, piece_spec
from uuvtai.shipped import preset_names

if TYPE_CHECKING:
    from uuvtai.config import Config
    from uuvtai.measure.episodes.methods import Method
    from uuvtai.measure.evaluate.method_run import EvaluationWatch

_PRIVILEGED = "knows the truth: a yardstick, no pilot; enter one that senses, for example --controller bt"
_ONE = "an entry is of one pilot; give one --controller, --planner or --policy, once"


@dataclass(frozen=True)
class Entrant:
    """One pilot as it was named: a trained policy, or a controller as ``Request`` has it."""

    name: str
    is_trained: bool = False

    @property
    def is_shipped(self) -> bool:
        """Whether it comes with the package, so that anybody can replay it."""
        kinds = ("policy",) if self.is_trained else ("tree", "stack")
        return any(self.name in preset_names(kind) for kind in kinds)

    @property
    def typed(self) -> str:
        """As it is typed behind ``uuv benchmark NAME``."""
        if self.is_trained:
            return f"--policy {self.name}"
        return piece_spec(self.name).option if is_piece(self.name) else f"--controller {self.name}"

    def asked(self) -> dict[str, Any]:
        """What ``Request.typed`` is told of it."""
        policies, controllers = ([self.name], []) if self.is_trained else ([], [self.name])
        return {"policies": policies, "controllers": controllers}

    def method(self, config: Config, watch: EvaluationWatch) -> Method:
        """What drives. Raises ConfigError, CheckpointError, PieceError, FileError."""
        from uuvtai.measure.episodes.methods import policies_of, trees_of

        most = config.teacher.max_node
        if self.name == ORACLE:
            raise SettingError(f"--controller {ORACLE}: {_PRIVILEGED}")
        found = policies_of([self.name], most, watch.note) if self.is_trained else trees_of([self.name], most)
        if found[0].privileged:
            raise SettingError(f"--controller {self.name}: {_PRIVILEGED}")
        return found[0]

    def files(self) -> dict[str, str]:
        """sha256 of the user's own files; none where it is no piece of hers. Raises FileError."""
        from uuvtai.measure.benchmark.fingerprints import piece_files

        is_own = not self.is_trained and is_piece(self.name)
        return piece_files(piece_spec(self.name)) if is_own else {}


def entrant_of(trained: list[str], controllers: list[str]) -> Entrant:
    """The one pilot that was typed. Raises SettingError for none and for several."""
    named = [*(Entrant(name, True) for name in trained), *(Entrant(name) for name in controllers)]
    if len(named) != 1:
        raise SettingError(f"{', '.join(entrant.name for entrant in named) or 'nobody'}: {_ONE}")
    return named[0]


def sha256_of_method(method: Method) -> str:
    """Of what drives: a tree as it is played, a checkpoint, the file of a piece."""
    return drivers_of([method])[method.name]

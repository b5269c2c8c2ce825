"""``uuv export --stack``: the stack of a log as a folder that drives without Taichi and torch, written whole
or not at all."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.aboard import carried_stack, stack_check
from uuvtai.aboard.carried_stack import GOLDEN, MEMORY, SCHEMA, SPEC, digest_of
from uuvtai.aboard.cross import KINDS, library_of, linker
from uuvtai.aboard.stack_check import decided, packed_messages
from uuvtai.aboard.tape import Tape, record
from uuvtai.config import Config
from uuvtai.errors import UserError
from uuvtai.files import whole_folder
from uuvtai.kernels.planning.route import keep_route
from uuvtai.native.machine import UnfitError, runtime_layout
from uuvtai.pilot import Mission, OnboardPilot, SensorMessage
from uuvtai.stages import Stages
from uuvtai.tree import FlatTree
from uuvtai.version import __version__

PACKAGE = "uuv_stack"
"""of the copied files"""
CHECKED_STEPS = 500
_ROOT = Path(__file__).parents[1]
_COPIED = (
    "pilot/carrying.py", "pilot/fed_pilot.py", "pilot/fed_sensors.py", "pilot/inbox.py", "pilot/mission.py",
    "pilot/motion_watch.py", "pilot/own_motion.py", "pilot/pilot_numbers.py", "pilot/sensor_messages.py",
    "plan_codes.py", "aboard/carried_stack.py", "aboard/stack_check.py",
)  # fmt: skip
"""the frame around the kernels"""


class StackExportError(UserError, RuntimeError):
    """Why a stack cannot be exported."""


def export_stack(
    config: Config,
    tree: FlatTree,
    mission: Mission,
    arrivals: Sequence[tuple[int, SensorMessage]],
    out: Path,
    machines: Sequence[str],
) -> dict[str, Any]:
    """Write the folder; the document of ``uuv export --stack --json``. ``arrivals``: messages of a log, each
    with the step before which it arrives; what is decided on them goes into the folder as its check. Raises
    StackExportError, CrossError, OSError."""
    unknown = [name for name in machines if name not in KINDS]
    if unknown or not machines:
        raise StackExportError(f"--for {','.join(unknown)}: must be of {', '.join(KINDS)}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StackExportError(f"{out}: is there already; give a new or an empty folder")
    if config.mapping.stamp > 0:
        raise StackExportError("mapping.stamp: a map that takes the truth in cannot drive a vehicle")
    linker()
    try:
        tape, sim = record(config, tree, mission)
    except UnfitError as error:
        raise StackExportError(f"Taichi's code cannot be exported here: {error}") from None
    steps = min(CHECKED_STEPS, arrivals[-1][0] + 1) if arrivals else 0
    shown = [arrival for arrival in arrivals if arrival[0] < steps]
    beside, kept = OnboardPilot(sim, mission), _KeptRoutes()
    sim.fallback = kept  # type: ignore[assignment]
    commands = decided(beside, shown, steps)
    with whole_folder(out) as new:
        _write(new, tape, beside, machines)
        packed = {**packed_messages(shown), "commands": commands}
        (new / GOLDEN).write_bytes(_npz(packed))
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return {
        "schema": 1,
        "folder": str(out),
        "machines": list(machines),
        "kernels": len(tape.kernels),
        "checked_steps": steps,
        "kept_routes": kept.count,
        "bytes": size,
    }


class _KeptRoutes:
    """In place of the second planner, which the folder does not have: the old route stays."""

    count = 0

    def serve(
        self,
        stages: Stages,
        seed_of: Callable[[int], int],
        read: Callable[..., np.ndarray],
        count: Callable[[Any], int],
        planner: Any = None,
    ) -> int:
        """As ``RouteFallback.serve``."""
        if failed := count(stages.route.route.n_failed):
            keep_route(stages.route, 0)
            self.count += 1
        return failed


def _write(folder: Path, tape: Tape, pilot: OnboardPilot, machines: Sequence[str]) -> None:
    """All but the check."""
    package = folder / PACKAGE
    package.mkdir(parents=True)
    for name in _COPIED:
        text = (_ROOT / name).read_text(encoding="utf-8")
        for folder_name in ("uuvtai.pilot.", "uuvtai.aboard.", "uuvtai."):
            text = text.replace(f"from {folder_name}", f"from {PACKAGE}.")
        (package / Path(name).name).write_text(text, encoding="utf-8")
    (package / "__init__.py").write_text('"""The stack of uuvtai without Taichi and torch."""\n')
    main = f"from {PACKAGE}.{Path(stack_check.__file__).stem} import main\n\nraise SystemExit(main())\n"
    (package / "__main__.py").write_text(main)
    libraries = {}
    for machine in machines:
        libraries[machine] = f"{machine}.so"
        (folder / libraries[machine]).write_bytes(library_of(tape.kernels, KINDS[machine]))
    (folder / MEMORY).write_bytes(_npz({"memory": tape.memory}))
    spec = {
        "schema": SCHEMA,
        "uuvtai": __version__,
        "libraries": libraries,
        "sha256": {name: digest_of(folder / name) for name in (*libraries.values(), MEMORY)},
        "runtime": runtime_layout(),
        "numbers": dataclasses.asdict(pilot.numbers),
        "mission": dataclasses.asdict(pilot.mission),
        "kernels": [kernel.name for kernel in tape.kernels],
        "tensors": tape.tensors,
        "begin": tape.begin,
        "step": tape.step,
        "keep": tape.keep,
        "arrays": tape.arrays,
        "config": pilot.config.model_dump(mode="json"),
    }
    (folder / SPEC).write_text(json.dumps(spec), encoding="utf-8")
    (folder / "README.md").write_text(_README, encoding="utf-8")


def _npz(arrays: dict[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


_README = f"""# A stack of uuvtai {__version__}
Needs Python 3.10 and NumPy, on Linux. From this folder:

```sh
python3 -m {PACKAGE}
```

decides anew on the messages of `{GOLDEN}` and compares (exit code 3: it decides something else).

```python
from pathlib import Path
from {PACKAGE}.{Path(carried_stack.__file__).stem} import carried_pilot
from {PACKAGE}.mission import Mission
from {PACKAGE}.sensor_messages import ImuReading

pilot = carried_pilot(Path("."), Mission(start=(2, 3, -0.8), goal=(18, 3, -0.8)))
pilot.feed(ImuReading(0.0, rpy, rate_b, specific_force_b))  # whenever a message comes
command = pilot.tick()  # every 20 ms: command.velocity, command.leaf, command.held
```

World, sensors and tree are those of the log that it was exported with. Where no route is found the old one
stays: the second planner (RRT) is not here. It was never in the water.
"""

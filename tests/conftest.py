"""Fixtures shared by the tests: one Taichi runtime, one small simulator for every test of the whole stack."""

import atexit
import gc
import signal
import sys

import pytest

gc.disable()  # until all is imported and collected, which makes millions of objects, few of them garbage

BEGUN_FIRST = """
docs aboard deploy learned_forecast page cuda instruments_chain cli wheel surrogate world examples replay
training sonar localization report sweep stack tracking security log_alone flights link logs signals
resume_eval identify telemetry media_formats dynamics explain hostile_logs echoes behavior voronoi
"""
"""files of tests that take long, longest first: a process takes whole files, and none shall work alone at the
end"""


def pytest_collection_modifyitems(items):
    """Long files first, the others as they were found."""
    order = {f"test_{name}": number for number, name in enumerate(BEGUN_FIRST.split())}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


def pytest_collection_finish():
    """What is there by now stays to the end: nobody need look through it for garbage before."""
    gc.freeze()
    gc.enable()
    gc.set_threshold(50_000, 50, 1000)  # as in a command (``uuvtai/cli.py``)
    atexit.register(gc.unfreeze)  # libraries that then look for leaks would find all of it


def pytest_configure():
    """Coverage's looks through modules that threads change meanwhile (slipcover 1.1, its own FIXME)."""
    if "slipcover" in sys.modules:
        looked = sys.modules["slipcover"].Slipcover.find_functions
        sys.modules["slipcover"].Slipcover.find_functions = lambda items, seen: looked(list(items), seen)


@pytest.fixture(scope="session", autouse=True)
def interrupts():
    """Heard also where the tests run in the background of a shell, which has its children ignore them."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def taichi_runtime(request):
    """One CPU runtime with exact floating point for the whole session.

    Where a test of the session needs the small simulator it is built first of all: Taichi finds compiled
    kernels again by the layout of the memory before them too.
    """
    from tests.field_memory import look_in_memory
    from tests.small_sim import SmallSim
    from uuvtai.compile.runtime import start_taichi

    start_taichi("cpu")
    look_in_memory()
    if any("small" in getattr(item, "fixturenames", ()) for item in request.session.items):
        _built.append(SmallSim())


def set_step(clock, step):
    """Every env's step number."""
    clock.step.fill(step)


def configure(monkeypatch, sim, config):
    """Give a simulator another config for a test; stages whose sections stay keep their compiled kernels, and
    others are found where the config's numbers alone are others."""
    from uuvtai.compile.codegen import adopt
    from uuvtai.sim.stages import Stages, bind_all

    new = vars(bind_all(Stages, sim.s, config))
    same = {
        name: old
        for name, old in vars(sim.io).items()
        if all(vars(old)[member] is part for member, part in vars(new[name]).items())
    }
    monkeypatch.setattr(sim, "config", config)
    monkeypatch.setattr(sim, "io", Stages(**(new | same)))
    adopt([new[name] for name in new.keys() - same.keys()], sim.memory())


def launch_one_by_one(monkeypatch, sim):
    """For who puts something of her own in a kernel's place: what is launched in a row looks at none."""
    monkeypatch.setattr(sim, "_rows", None)


def estimate_pose(monkeypatch, small, **other):
    """Have its simulator find out where it is from harsh readings, or ``other`` ones: only kernels of
    proprioception and pose are compiled for it."""
    from uuvtai.config.loader import load_config
    from uuvtai.sim.stack import SimulatedSensors

    harsh = load_config("pool", "harsh").sensors
    changed = {name: getattr(harsh, name) for name in ("localization", "dvl", "imu", "pressure")}
    sensors = small.config.sensors.model_copy(update=changed | other)
    monkeypatch.setattr(small.sim, "sensors", SimulatedSensors(sensors))
    configure(monkeypatch, small.sim, small.sim.config.model_copy(update={"sensors": sensors}))


def near_horizon(env, rows, steps_left):
    """Put the clocks of these rows of a VectorEnv shortly before the horizon."""
    for row in rows:
        env.sim.s.clock.step[row] = env.config.episode.horizon_steps - steps_left


_built = []


@pytest.fixture(scope="session")
def small(taichi_runtime):
    """The session's simulator."""
    return _built[0]


@pytest.fixture
def no_onnx(monkeypatch):
    """As if the extra were not installed; ONNX takes seconds."""
    monkeypatch.setattr("uuvtai.learning.export.folder.missing_packages", lambda: ["onnx"])


@pytest.fixture(autouse=True)
def forgetful(request):
    """No test sees what an earlier one left in the session's simulator, nor does a fixture of a whole file,
    which comes before this one."""
    small = _built[0] if "small" in request.fixturenames else None
    if small:
        small.forget()
    yield
    if small:
        small.forget()

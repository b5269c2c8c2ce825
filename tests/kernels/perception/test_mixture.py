"""The learned forecast: what the network is told, what its kernel says, its weights' file."""

import numpy as np
import pytest
import torch
from safetensors.numpy import save

from tests.bundles import Stage, clear, put
from uuvtai.common import enums
from uuvtai.common.errors import UserError
from uuvtai.config import Config
from uuvtai.kernels.core.simd import LANES
from uuvtai.kernels.perception import prediction_network
from uuvtai.kernels.perception.io import TrackingIO
from uuvtai.learning.forecast import TIMES_S, MixtureNet, mirrored
from uuvtai.sim.forecast_weights import SHAPES, SPREADS, packed_weights, put_weights, read_weights

CFG = Config()
N_ENV, N_TRACK, N_SAMPLE = 3, 4, 26
SIZES = {
    "n_env": N_ENV, "n_ray": 16, "n_track": N_TRACK, "n_cluster": 1, "n_height": LANES, "n_turn_row": 7,
    "n_turn": 48, "n_forecast": N_SAMPLE, "n_future": enums.N_MODE, "n_past": enums.N_PAST,
    "n_bend": enums.N_BEND, "n_frame": enums.N_FRAME, "n_column": enums.N_COLUMN,
    "n_hidden": 2 * enums.N_HIDDEN, "n_said": enums.N_SAID,
    "n_weight": enums.N_WEIGHT,
}  # fmt: skip
TOLERANCE = 2e-5
"""float32 sums of 64 in another order"""
WIDTH_M, LENGTH_M = 6.0, 20.0


class Rig(Stage):
    """Tracks of obstacles, what is remembered of them, and a network that says what they may do."""

    sizes = SIZES

    def begin(self):
        clear(self.tracks, self.turn_history, self.forecast, self.futures, self.clock, self.clusters)
        self.clock.active.fill(1)
        self.clusters.fresh.fill(1)
        put(self.tracks, alive=1, moving=1, age=9, radius_m=0.2)
        prediction_network.reset_past(self.io(TrackingIO, CFG))
        return self

    def swim(self, places, velocity):
        """Every body at a place (n_env, n_track, 2), on a velocity, for a scan."""
        put(self.tracks, state=np.concatenate([places, velocity], -1))
        ahead = 0.1 * np.arange(N_SAMPLE)[:, None]
        put(self.forecast, pos_w=places[..., None, :] + ahead * velocity[..., None, :])

    def scan(self, step):
        self.clock.step.fill(step)
        put(self.tracks, scan_step=step, seen_step=step)
        prediction_network.remember_past(self.io(TrackingIO, CFG))

    def columns(self):
        prediction_network.describe_motion(self.io(TrackingIO, CFG))
        return self.mixture.column.to_numpy()

    def mix(self):
        prediction_network.mix_futures(self.io(TrackingIO, CFG))
        return self.futures.share.to_numpy(), self.futures.pos_w.to_numpy(), self.forecast.pos_w.to_numpy()


stage = Rig.fixture()


@pytest.fixture(scope="module")
def net():
    """A network that says something different of every track."""
    found = MixtureNet(torch.Generator().manual_seed(3))
    with torch.no_grad():
        found.said.weight.mul_(8.0)
    return found


def drive(stage, begin, velocity, seconds):
    """A straight way from ``begin`` (..., 2), a scan every 0.06 s, up to a decision step."""
    last = 5 * round(seconds * 10)
    for step in range(last % 3, last + 1, 3):
        stage.swim(begin + 0.02 * step * velocity, velocity)
        stage.scan(step)
    return last


def fill(field, values):
    field.from_numpy(np.ascontiguousarray(values, field.to_numpy().dtype))


def test_the_kernel_says_what_the_network_says(stage, net):
    stage.begin()
    put_weights(stage.mixture, net.weights(), fill)
    rng = np.random.default_rng(1)
    told = rng.normal(0, 0.5, (N_ENV, N_TRACK, enums.N_COLUMN)).astype(np.float32)
    course, speed = rng.uniform(-np.pi, np.pi, (N_ENV, N_TRACK)), rng.uniform(0.3, 1.5, (N_ENV, N_TRACK))
    told[..., 0], place = speed, rng.uniform(1, 5, (N_ENV, N_TRACK, 2))
    frame = np.concatenate([place, np.stack([np.cos(course), np.sin(course), speed], -1)], -1)
    put(stage.mixture, column=told, frame=frame)
    share, pos, forecast = stage.mix()
    said = net(torch.from_numpy(told).view(-1, told.shape[-1]))
    weight = said.log_weight.exp().detach().numpy().reshape(share.shape)
    likeliest = weight.argmax(-1)
    others = np.arange(enums.N_MODE) != likeliest[..., None]
    np.testing.assert_allclose(share, weight * others, atol=TOLERANCE)
    places = said.place.detach().numpy().reshape(*share.shape, len(TIMES_S), 2)
    for env, track, mode in np.ndindex(share.shape):
        turn = np.array([[np.cos(a := course[env, track]), -np.sin(a)], [np.sin(a), np.cos(a)]])
        anchors = np.concatenate([np.zeros((1, 2)), places[env, track, mode]]) @ turn.T + place[env, track]
        way = np.stack(
            [np.interp(0.1 * np.arange(N_SAMPLE), 0.5 * np.arange(6), anchors[:, i]) for i in (0, 1)], -1
        )
        here = way[0]
        for k in range(1, N_SAMPLE):  # never faster than now
            step = way[k] - here
            here = here + step * min(1.0, 0.1 * speed[env, track] / max(np.linalg.norm(step), 1e-9))
            np.testing.assert_allclose(pos[env, track, mode, k], here, atol=2e-4)
    best = np.take_along_axis(pos, likeliest[..., None, None, None], 2)[:, :, 0]
    np.testing.assert_array_equal(forecast, best)


def test_tracks_without_a_forecast_have_no_futures(stage, net):
    stage.begin()
    put_weights(stage.mixture, net.weights(), fill)
    radius = np.zeros((N_ENV, N_TRACK, N_SAMPLE), np.float32)
    radius[:, 1] = -1.0
    stage.forecast.radius_m.from_numpy(radius)
    share, _, _ = stage.mix()
    assert not share[:, 1].any()
    assert (share[:, 0].sum(-1) > 0).all()
    stage.clock.step.fill(3)  # no decision step: nothing is said anew
    stage.forecast.radius_m.fill(-1.0)
    assert (stage.mix()[0] == share).all()


def test_a_straight_way_is_told_by_its_places_and_walls(stage):
    stage.begin()
    begin, velocity = np.array([3.0, 2.0]), np.array([1.0, 0.0])
    last = drive(stage, begin, velocity, 4.0)
    columns = stage.columns()[0, 0]
    np.testing.assert_allclose(columns[:2], 1.0, atol=1e-5)
    at = enums.N_MOTION
    x, y = begin + 0.02 * last * velocity
    far = enums.FAR
    walls = [LENGTH_M - x - 0.2, x - 0.2, WIDTH_M - y - 0.2, y - 0.2]
    np.testing.assert_allclose(columns[at : at + 4], np.minimum(np.array(walls) / 4, far), atol=1e-5)
    past = columns[enums.COLUMNS - 1 - 2 * enums.N_PAST : enums.COLUMNS - 1]
    apart = np.diff(past.reshape(-1, 2), axis=0)
    np.testing.assert_allclose(apart, np.tile([-0.3 / 4, 0.0], (len(apart), 1)), atol=1e-5)
    late = columns[enums.COLUMNS - 1]
    assert past[0] == pytest.approx(-late / 4, abs=1e-5)
    assert 0 <= late < 0.3


def test_a_track_that_slows_down_can_still_go_as_fast_as_before(stage):
    """What reverses stands for a moment: its forecast is not to stand with it."""
    stage.begin()
    drive(stage, np.array([3.0, 2.0]), np.array([1.2, 0.0]), 2.0)
    state = stage.tracks.state.to_numpy()
    state[..., 2] = 0.1
    put(stage.tracks, state=state)
    assert stage.columns()[0, 0, :2] == pytest.approx([1.2, 0.1], rel=1e-3)
    assert stage.mixture.frame.to_numpy()[0, 0, 4] == pytest.approx(1.2, rel=1e-3)


def test_a_mirrored_track_has_mirrored_columns(stage):
    rng = np.random.default_rng(2)
    begin = rng.uniform([4, 1.5], [12, 4.5], (N_ENV, N_TRACK, 2))
    velocity = rng.normal(0, 0.7, (N_ENV, N_TRACK, 2))
    rate = rng.normal(0, 1, (N_ENV, N_TRACK))
    told = []
    for flip in (1, -1):
        mirror = np.array([1.0, flip])
        stage.begin()
        put(stage.tracks, turn_rate=flip * rate, turn_cov=0.1)
        since = np.where(flip > 0, 0, WIDTH_M) * np.array([0, 1]) + (begin - 0.5) * mirror
        put(stage.turn_history, run_from_w=since, run_kind=2)
        turned = np.zeros((N_ENV, 7, 3, LANES), np.float32)
        turned[..., 0] = np.array([14, 3, 1, 0, -0.6, 0.8 * flip, 1.0])[None, :, None]
        stage.turn_history.turn.from_numpy(turned)
        drive(
            stage, np.where(flip > 0, 0, WIDTH_M) * np.array([0, 1]) + begin * mirror, velocity * mirror, 2.0
        )
        told.append(stage.columns().reshape(-1, enums.N_COLUMN))
    straight, other = (torch.from_numpy(part) for part in told)
    nothing = torch.zeros(len(straight), len(TIMES_S), 2)
    np.testing.assert_allclose(mirrored(straight, nothing)[0], other, atol=1e-5)
    np.testing.assert_allclose(mirrored(*mirrored(straight, nothing))[0], straight, rtol=1e-6)


def test_a_new_track_remembers_nothing(stage):
    stage.begin()
    drive(stage, np.array([3.0, 2.0]), np.array([1.0, 0.0]), 3.0)
    assert (stage.past.past_count.to_numpy() == enums.N_PAST).all()
    age = np.full((N_ENV, N_TRACK), 9, np.int32)
    age[:, 2] = 0
    stage.tracks.age.from_numpy(age)
    stage.scan(153)
    count = stage.past.past_count.to_numpy()
    assert (count[:, 2] == 1).all()
    assert (count[:, [0, 1, 3]] == enums.N_PAST).all()


def test_turns_are_remembered_newest_first(stage):
    stage.begin()
    stage.turn_history.run_kind.fill(2)
    bends = [(2.0, 2.0), (5.0, 2.0), (2.05, 2.0), (5.1, 2.0), (2.0, 2.1), (5.0, 2.1)]
    for nth, bend in enumerate(bends):
        for again in range(2):
            fill(stage.turn_history.run_from_w, np.broadcast_to(bend, (N_ENV, N_TRACK, 2)))
            stage.scan(30 * nth + 3 * again)
    n = enums.N_BEND
    np.testing.assert_allclose(stage.past.bend_w.to_numpy()[0, 0], bends[::-1][:n], atol=1e-6)
    assert (stage.past.bend_count.to_numpy() == n).all()


# ---------------------------------------------------------------------------------------------- weights


def test_weights_come_back_from_their_file(tmp_path, net):
    path = tmp_path / "forecast.safetensors"
    path.write_bytes(packed_weights(net.weights()))
    for given in (path, tmp_path):
        found = read_weights(str(given))
        assert list(found) == [*SHAPES, *SPREADS]
        for name, values in net.weights().items():
            np.testing.assert_array_equal(found[name], values)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (None, "there is no"),
        (lambda w: b"nonsense", "is no safetensors file"),
        (lambda w: save({k: v for k, v in w.items() if k != "bias_mid"}), "bias_mid is missing"),
        (lambda w: save(w | {"bias_mid": np.zeros(3, np.float32)}), "not float32"),
        (lambda w: save(w | {"bias_mid": np.full(64, np.nan, np.float32)}), "is not finite"),
        (lambda w: save(w | {"bias_mid": np.zeros(64)}), "not float32"),
    ],
)
def test_files_that_hold_no_forecast_are_refused(tmp_path, net, spoil, says):
    path = tmp_path / "forecast.safetensors"
    if spoil:
        path.write_bytes(spoil(net.weights()))
    with pytest.raises(UserError, match=says):
        read_weights(str(path))

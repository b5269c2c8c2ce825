"""The pose filter: every step against a float64 filter, and whether it is as good as it says it is."""

import numpy as np
import pytest
from scipy.stats import chi2

from tests.bundles import Stage, put
from tests.conftest import set_step
from tests.oracles import localization as oracle
from uuvtai.config import EpisodeConfig, LocalizationConfig, TankConfig, VehicleConfig
from uuvtai.config.loader import load_config
from uuvtai.kernels.perception import localization
from uuvtai.kernels.perception.io import LocalizationIO

N_ENV, STEPS = 200, 201
RULES = EpisodeConfig()
SENSORS = {"harsh": load_config("pool", "harsh").sensors}
ASTRAY = {"sensors.start_sigma_m": 0.1, "sensors.imu.heading_sigma_rad": 0.03}
SENSORS["astray"] = load_config("pool", "harsh", overrides=ASTRAY).sensors
POOL, PEN = TankConfig(), TankConfig(shape="circle", x_m=(0.0, 8.0), y_m=(0.0, 8.0))
DEFAULT = LocalizationConfig()
PLAIN = LocalizationConfig(bearing_sigma_rad=0.0, wall_sigma_m=1e-4)
"""What the made-up worlds need: errors are those of the sensors, of the few false returns and ghosts that
pass the gate, and of obstacles."""
VEHICLE = VehicleConfig()
OBSTACLES = ((0.7, 4.0, 0.3), (6.9, 5.6, 0.35), (4.2, 0.5, 0.3), (5.5, 4.6, 0.2))
"""(x, y, radius) [m]: three at the pen's wall, closer than the gate is wide, and one before it"""

WRONG = 7.0
"""[m/s] what the DVL says while it is lost: whoever believes it is far off"""

ROUNDING_SIGMA, ROUNDING_SHARE = 5e-3, 5e-3
"""One step in float32: the mean in standard deviations of what the step leaves, these relatively."""
EDGE = 1e-3
"""A beam so close to its gate may be decided otherwise in float32."""


class Rig(Stage):
    """The filter's structs, and a voyage that is fed to it."""

    sizes = {"n_env": N_ENV, "n_ray": SENSORS["harsh"].sonar.n_ray}

    def begin(self, voyage, cfg):
        self.voyage, self.cfg, self.pings = voyage, cfg, {}
        self.filter = self.io(LocalizationIO, cfg, voyage.sensors, voyage.tank, RULES, VEHICLE)
        put(self.clock, active=1, step=0)
        put(self.ego, pos_w=voyage.told, vel_b=0)
        localization.reset_pose(self.filter)

    def sense(self, k):
        """What the instruments say in step k; while the DVL is lost it says nonsense."""
        v, ego = self.voyage, self.ego
        set_step(self.clock, k)
        put(ego, rpy=np.stack([v.roll[k], v.pitch[k], v.imu_yaw[k]], 1), rate_b=v.rates[k])
        put(ego, specific_force_b=v.force[k], depth_m=v.depth[k])
        if k % v.sensors.dvl.period_steps == 0:
            put(ego, vel_valid=v.valid[k], vel_b=np.where(v.valid[k][:, None] == 1, v.reading[k], WRONG))
        localization.predict_pose(self.filter)

    def ping(self, k):
        """Take a scan, deliver what is due; (ping step, range, Doppler, hit), or None."""
        sonar = self.voyage.sensors.sonar
        if k % sonar.period_steps == 0:
            told = (self.ego.pos_w.to_numpy(), self.ego.rpy.to_numpy()[:, 2], self.ego.vel_b.to_numpy())
            self.pings[k] = (*self.voyage.scan(k), *told)
        due = self.pings.pop(k - sonar.latency_steps, None)
        self.scan.fresh.fill(int(due is not None))
        if due is None:
            return None
        self.deliver(k - sonar.latency_steps, due)
        return due

    def deliver(self, k, due):
        """The scan of step ``k`` comes now."""
        names = ("range_m", "doppler_m_s", "hit", "ping_pos_w", "ping_yaw", "ping_vel_b")
        put(self.scan, **dict(zip(names, due, strict=True)), ping_step=k, fresh=1)

    def play(self, until=STEPS, since=0):
        for k in range(since, until):
            self.sense(k)
            self.ping(k)
            localization.correct_pose(self.filter)
        return self.errors(until - 1)

    def errors(self, k):
        """(NEES of x, y, heading; of z; position error [m]) of every row."""
        v = self.voyage
        off = np.concatenate(
            [self.ego.pos_w.to_numpy() - v.pos[k], (self.ego.rpy.to_numpy()[:, 2:] - v.yaw[k][:, None])], 1
        )
        off[:, 3] = (off[:, 3] + np.pi) % (2 * np.pi) - np.pi
        cov = oracle.full(self.ego.pose_cov.to_numpy().astype(float), 3)
        level = off[:, [0, 1, 3]]
        nees = np.einsum("ei,eij,ej->e", level, np.linalg.inv(cov), level)
        return nees, off[:, 2] ** 2 / self.ego.z_var.to_numpy(), np.hypot(off[:, 0], off[:, 1])

    def state(self):
        return [
            getattr(self.localization, name).to_numpy()
            for name in ("mean", "cov", "depth", "depth_cov", "motion")
        ]


rig = Rig.fixture()


def voyage(preset, tank, seed, steps=STEPS, **scene):
    return oracle.Voyage(
        N_ENV, steps, SENSORS[preset], tank, RULES.control_dt_s, np.random.default_rng(seed), **scene
    )


def unheard(v):
    """A voyage in which no beam returns."""
    ranges, doppler, hit = v.scan(0)
    v.scan = lambda _k: (np.full_like(ranges, v.sensors.sonar.max_range_m), 0 * doppler, 0 * hit)
    return v


def assert_consistent(values, dof):
    """Their mean lies within the 95 % bounds of a chi-square variable's mean over as many runs."""
    low, high = chi2.ppf([0.025, 0.975], dof * len(values)) / len(values)
    assert low < values.mean() < high


def assert_close(found, filters, rows):
    """Kernel against oracle after one step."""
    for row in rows:
        for mean, cov, theirs, theirs_cov in (
            (found[0][row], found[1][row], filters[row].mean, filters[row].cov),
            (found[2][row], found[3][row], filters[row].depth, filters[row].depth_cov),
        ):
            sigma = np.sqrt(np.diag(theirs_cov))
            assert np.all(np.abs(mean - theirs) < ROUNDING_SIGMA * sigma + 2e-6)
            own = oracle.full(cov, len(mean))
            assert np.all(np.abs(own - theirs_cov) <= ROUNDING_SHARE * np.outer(sigma, sigma) + 1e-12)


@pytest.mark.parametrize(("preset", "cfg", "tank"), [("astray", DEFAULT, PEN), ("harsh", PLAIN, POOL)])
def test_every_step_is_that_of_the_float64_filter(rig, preset, cfg, tank):
    """Each step from what the kernel had before it: rounding does not add up, a wrong term shows at once."""
    rows, v = (0, 75, 150), voyage(preset, tank, 3, obstacles=OBSTACLES)
    rig.begin(v, cfg)
    filters = {row: oracle.Filter(v.told[row], v.sensors, cfg, tank, RULES.control_dt_s) for row in rows}
    assert_close(rig.state(), filters, rows)
    scans = 0
    for k in range(61):
        before, lost = rig.state(), v.valid[k - k % v.sensors.dvl.period_steps] == 0
        rig.sense(k)
        for row, ours in filters.items():
            ours.seed(*(part[row] for part in before[:4]))
            if k > 0:
                now = oracle.motion(v.roll[k], v.pitch[k], v.force[k], v.rates[k])[row]
                ours.move(
                    v.roll[k][row], v.pitch[k][row], v.imu_yaw[k][row], before[4][row].astype(float), now
                )
            if k % v.sensors.dvl.period_steps == 0 and not lost[row]:
                ours.dvl(v.roll[k][row], v.pitch[k][row], v.reading[k][row])
            if k > 0:
                ours.pressure(v.depth[k][row])
        middle = rig.state()
        assert_close(middle, filters, rows)
        due = rig.ping(k)
        localization.correct_pose(rig.filter)
        if due is not None:
            late, clear = (k - int(rig.scan.ping_step[0])) * RULES.control_dt_s, []
            for row, ours in filters.items():
                ours.seed(*(part[row] for part in middle[:4]))
                ranges, doppler, hit, pos, yaw, vel_b = (part[row] for part in due)
                vel = oracle.level(v.roll[k][row], v.pitch[k][row], vel_b.astype(float))[:2]
                if ours.scan(pos, yaw, vel, late, ranges, doppler, hit) > EDGE:
                    clear.append(row)
            scans += len(clear)
            assert_close(rig.state(), filters, clear)
    assert scans > 20, "beams at the edge of a gate are few"


def test_errors_are_as_large_as_the_covariance_says(rig):
    """200 independent runs of 4 s in harsh water; every second one loses the DVL for 1.5 s."""
    rig.begin(voyage("harsh", POOL, 21), PLAIN)
    nees, of_z, off = rig.play()
    assert_consistent(nees, 3)
    assert_consistent(of_z, 1)
    assert np.quantile(off, 0.95) < 0.10


def test_without_a_wall_in_reach_the_uncertainty_grows_and_stays_honest(rig):
    """Dead reckoning, its heading's drift and scale error included."""
    rig.begin(unheard(voyage("harsh", POOL, 12)), PLAIN)
    halfway, _, _ = rig.play(101)
    early = rig.ego.pose_cov.to_numpy()
    nees, of_z, _ = rig.play(since=101)
    assert_consistent(halfway, 3)
    assert_consistent(nees, 3)
    assert_consistent(of_z, 1)
    late, never_lost = rig.ego.pose_cov.to_numpy(), slice(1, None, 2)
    assert np.all(late[never_lost][:, [0, 3, 5]] > early[never_lost][:, [0, 3, 5]])


def test_obstacles_at_a_round_wall_do_not_make_it_too_sure(rig):
    """The defaults: obstacles closer to the wall than the gate is wide pass for it."""
    rig.begin(voyage("astray", PEN, 13, obstacles=OBSTACLES), DEFAULT)
    nees, _, off = rig.play()
    assert nees.mean() < chi2.ppf(0.975, 3 * N_ENV) / N_ENV
    assert np.quantile(off, 0.95) < 0.15


def speed_errors(rig, k):
    """Length [m/s] of the velocity's error of every row."""
    v = rig.voyage
    return np.linalg.norm(rig.ego.vel_b.to_numpy() - oracle.tilted(v.roll[k], v.pitch[k], v.vel[k]), axis=1)


def test_the_velocity_goes_on_while_the_dvl_is_lost(rig):
    """By the accelerometer and the Doppler of the walls: as well as it is known, and no DVL is believed."""
    v = voyage("harsh", POOL, 14)
    rig.begin(v, PLAIN)
    rig.play(121)
    lost = v.valid[120] == 0
    assert lost.sum() > 60 and np.all(rig.ego.vel_valid.to_numpy() == 1)
    off = speed_errors(rig, 120)
    assert np.sqrt(np.mean(off[lost] ** 2)) < 0.04 and np.sqrt(np.mean(off[~lost] ** 2)) < 0.03


def test_a_velocity_that_nothing_tells_is_not_valid(rig):
    """No bottom, no wall, and an accelerometer that was never corrected; with the DVL again it is known."""
    v = unheard(voyage("harsh", POOL, 16))
    v.valid[:] = 0
    v.valid[61:] = 1
    rig.begin(v, PLAIN)
    rig.play(61)
    assert np.all(rig.ego.vel_valid.to_numpy() == 0)
    rig.play(81, since=61)
    assert np.all(rig.ego.vel_valid.to_numpy() == 1)
    assert np.quantile(speed_errors(rig, 80), 0.95) < 0.1


def test_what_stands_before_the_walls_makes_them_count_less(rig):
    """As many beams meet the walls both times, but once the others end at obstacles, before the walls."""
    v = voyage("harsh", POOL, 17)
    rig.begin(v, PLAIN)
    rig.play(6)
    ranges, doppler, hit = v.scan(5)
    ranges[:, ::4], before, sure = 1.0, rig.state(), []
    told = v.pos[5], v.yaw[5], oracle.tilted(v.roll[5], v.pitch[5], v.vel[5])
    for short in (0, 1):
        hit[:, ::4] = short
        for field, values in zip(("mean", "cov", "depth", "depth_cov", "motion"), before, strict=True):
            getattr(rig.localization, field).from_numpy(values)
        rig.deliver(5, (ranges, doppler, hit, *told))
        localization.correct_pose(rig.filter)
        sure.append(rig.ego.pose_cov.to_numpy()[:, [0, 3, 5]])
    assert np.all(sure[1] > sure[0])


def test_rows_do_not_touch_each_other_and_sleepers_keep_everything(rig):
    rig.begin(voyage("harsh", POOL, 15), PLAIN)
    rig.play(21)
    first = rig.state()
    rig.begin(voyage("harsh", POOL, 15), PLAIN)
    rig.clock.active.from_numpy((np.arange(N_ENV) % 2).astype(np.int32))
    rig.play(21)
    second = rig.state()
    for one, other in zip(first, second, strict=True):
        assert np.array_equal(one[1::2], other[1::2])
        assert not np.array_equal(one[::2], other[::2])

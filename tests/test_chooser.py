"""Who drives, tree or policy: columns, what is learnt from, the wheel, resuming, refusals."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

from tests.test_architecture import TRUTH
from uuvtai.binding import members_of
from uuvtai.errors import UserError
from uuvtai.learn import checkpoint
from uuvtai.learn.arrival_net import POLICY, TREE, ArrivalNet
from uuvtai.learn.checkpoint import CheckpointError
from uuvtai.learn.chooser import ChooserPilot, load_chooser
from uuvtai.learn.chooser_columns import AT_LATER, wished, with_approach
from uuvtai.learn.chooser_memory import ChooserMemory, Tick, moments_of_episodes
from uuvtai.learn.chooser_trainer import ChooserTrainer
from uuvtai.learn.pilot import load_pilot
from uuvtai.learn.set_pilot import load_set_pilot, set_pilot_of
from uuvtai.learn.set_policy import SetActor
from uuvtai.loader import load_training
from uuvtai.measure.episodes.playing import jobs_of, run_episodes
from uuvtai.measure.evaluate.hand_overs import hand_overs_of, told
from uuvtai.twin.observer import SET_TABLE
from uuvtai.twin.set_codes import BODY_WIDTH, EGO_COLUMNS, TREE_WIDTH
from uuvtai.twin.tree_columns import CHOOSER_TABLE, TreeColumnsIO
from uuvtai.twin.twin_arrays import ObserverIO

NET = {"twin.body_hidden": 8, "twin.head_hidden": 8}
SMALL = NET | {
    "train.num_envs": 8,
    "train.iterations": 6,
    "train.scenes": [[8, 6, 0.6]],
    "train.evaluate_episodes": 4,
    "chooser.worlds": ["pool"],
    "chooser.memory": 1024,
    "chooser.minibatches": 3,
    "chooser.minibatch": 32,
    "chooser.warm_up": 0.3,
    "chooser.ends_alone": 0.3,
}


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """Checkpoint of a policy of the twin that has learnt nothing: straight to the goal."""
    config = load_training("twin", overrides=NET)
    actor = SetActor(BODY_WIDTH, EGO_COLUMNS, config, torch.Generator().manual_seed(1))
    state = {"policy": actor.state_dict(), "counters": {}, "env": {}}
    return checkpoint.save(tmp_path_factory.mktemp("policy") / "checkpoints", 1, state, config, SET_TABLE)


@pytest.fixture(scope="module")
def config(policy):
    return load_training("chooser", overrides=SMALL | {"chooser.policy": str(policy)})


@pytest.fixture(scope="module")
def trainer(config, small):
    """After three iterations, in which everything is drawn, then some."""
    made = ChooserTrainer(config, {"pool": small.sim})
    for _ in range(3):
        made.iterate()
    return made


@pytest.fixture
def saved(trainer, config, tmp_path):
    """Function: checkpoint of the trainer after ``change`` (None = none) of its state."""

    def save(change=None):
        state = copy.deepcopy(trainer.state())
        if change:
            change(state["chooser"])
        path = checkpoint.save(tmp_path / "checkpoints", 3, state, config, trainer.observation_table)
        return checkpoint.open_checkpoint(path)

    return save


# ------------------------------------------------------------------------------------------------- columns


def test_approaches_are_those_of_a_search_in_time():
    rng = np.random.default_rng(0)
    bodies = np.zeros((20, 3, BODY_WIDTH), np.float32)
    bodies[..., 0] = 1.0
    bodies[..., 1:3] = rng.uniform(-1, 1, (20, 3, 2))
    bodies[..., 5:7] = rng.uniform(-1.5, 1.5, (20, 3, 2))
    bodies[..., 7] = 0.6
    bodies[..., 12:16] = rng.uniform(-1, 1, (20, 3, 4))
    bodies[0, 2] = 0.0
    tree, policy = rng.uniform(-0.8, 0.8, (2, 20, 2)).astype(np.float32)
    seen = with_approach(*(torch.from_numpy(part) for part in (bodies, tree, policy))).numpy()
    times = np.linspace(0.0, 3.0, 3001)
    for first, own in ((BODY_WIDTH, tree), (BODY_WIDTH + 7, policy)):
        when, gap, in_1s, in_2s = (seen[..., first + i] for i in range(4))
        moves = bodies[..., 5:7] - own[:, None]
        ways = 4 * bodies[..., None, 1:3] + times[:, None] * moves[:, :, None]
        far = np.linalg.norm(ways, axis=-1) - 0.3 - 0.22
        real = bodies[..., 0] > 0
        assert np.allclose(gap[real], far.min(-1)[real].clip(-1, 3), atol=2e-3)
        assert np.allclose(when[real], times[far.argmin(-1)][real], atol=5e-3)
        for seconds, heard, place in ((1, in_1s, AT_LATER[0]), (2, in_2s, AT_LATER[1])):
            later = np.linalg.norm(4 * bodies[..., place] - seconds * own[:, None], axis=-1) - 0.52
            assert np.allclose(heard[real], later[real].clip(-1, 3), atol=1e-5)
    assert not seen[0, 2].any(), "an empty row stays empty"


def test_a_wish_is_at_most_as_fast_as_the_vehicle():
    found = wished(torch.tensor([[3.0, 4.0], [0.3, 0.4]]), 0.85)
    assert torch.allclose(found, 0.85 * torch.tensor([[0.6, 0.8], [0.3, 0.4]]))


def test_what_it_sees_is_no_truth(saved):
    assert not (set(members_of(ObserverIO).values()) | set(members_of(TreeColumnsIO).values())) & TRUTH
    assert sorted(saved().model()) == ["chooser", "policy"]
    assert CHOOSER_TABLE[-1].slice.stop - CHOOSER_TABLE[-1].slice.start == TREE_WIDTH


# ------------------------------------------------------------------------------------ what it learns from


def ticks_of(drives_by_job):
    """Ticks as they come when all episodes begin together: row after row of those that still run."""
    found = []
    for age in range(max(len(drives) for drives in drives_by_job)):
        jobs = [job for job, drives in enumerate(drives_by_job) if age < len(drives)]
        found.append(
            Tick(
                torch.tensor(jobs),
                torch.full((len(jobs),), 25 * age),
                torch.zeros(len(jobs), 2, 3),
                torch.tensor([[100.0 * job + age] for job in jobs]),
                torch.tensor([drives_by_job[job][age] == "p" for job in jobs]),
            )
        )
    return found


def test_moments_by_hand():
    """Two episodes; a moment looks ahead until the other takes over, the episode ends, or three choices."""
    found = moments_of_episodes(ticks_of(["tttppt", "pp"]), torch.tensor([True, False]), 3)
    assert found.own[:, 0].tolist() == [0, 1, 2, 3, 4, 5, 100, 101]
    assert found.drives.tolist() == [0, 0, 0, 1, 1, 0, 1, 1]
    assert found.ahead.tolist() == [3, 2, 1, 2, 1, 0, 1, 0]
    assert found.ended.tolist() == [0, 0, 0, 0, 0, 1, 1, 1]
    assert found.arrived.tolist() == [1] * 6 + [0] * 2


def test_an_end_beyond_what_is_looked_ahead_is_not_seen():
    found = moments_of_episodes(ticks_of(["tttt"]), torch.tensor([True]), 2)
    assert found.ahead.tolist() == [2, 2, 1, 0] and found.ended.tolist() == [0, 0, 1, 1]


def test_the_oldest_moments_are_written_over_and_futures_stay_theirs():
    memory = ChooserMemory(5, 2, 3, 1)
    for first in (0, 10, 20):
        moments = moments_of_episodes(ticks_of(["ttt"]), torch.tensor([True]), 1)
        memory.add(moments._replace(own=moments.own + first))
    kept = memory.rows.own[:, 0].tolist()
    assert memory.count == 5 and sorted(kept) == [11, 12, 20, 21, 22]
    rows = torch.tensor([kept.index(20), kept.index(21), kept.index(22)])
    assert memory.rows.own[memory.after(rows), 0].tolist() == [21, 22, 22]


# ------------------------------------------------------------------------------------------------- the wheel


class _Said(ArrivalNet):
    """Says what it is told to."""

    chance = torch.zeros(0, 2)
    known = True

    def forward(self, bodies, own):
        """(n, 2) the first rows of what it is told, as often as needed."""
        return self.chance[:1].expand(len(bodies), 2)

    def knows(self, bodies, own):
        """(n,) as told."""
        return torch.full((len(bodies),), self.known)


@pytest.fixture
def wheel(small, saved, config):
    """A chooser whose network says what the test wants."""
    net = _Said(BODY_WIDTH, EGO_COLUMNS, TREE_WIDTH, config, torch.Generator())
    small.begin(range(small.N), seed=9)
    pilot = set_pilot_of(saved(), small.sim)
    made = ChooserPilot(net, pilot, small.sim, config.chooser)
    made.reset(torch.ones(small.N))
    return made


def hold(wheel, tree, policy):
    """Until the next choice, with these chances; whether the policy drives."""
    wheel.net.chance = torch.tensor([[tree, policy]])
    for _ in range(25):
        wheel.decide(torch.zeros(0))
        wheel.advance()
    return bool(wheel.drives.all()) if wheel.drives.any() else False


def test_the_likelier_one_drives_and_a_change_needs_a_margin(wheel, small):
    assert hold(wheel, 0.80, 0.81), "at the start nobody has to be better by a margin"
    assert hold(wheel, 0.815, 0.80), "a little better is not enough"
    assert not hold(wheel, 0.83, 0.80)
    assert not hold(wheel, 0.80, 0.815)
    assert hold(wheel, 0.80, 0.83)
    assert wheel.hand_overs.tolist() == [2] * small.N and wheel.driven.tolist() == [75] * small.N
    wheel.reset(torch.ones(small.N))
    assert not wheel.hand_overs.any()


def test_where_the_network_knows_nothing_the_tree_drives(wheel, small):
    wheel.net.known = False
    assert not hold(wheel, 0.1, 0.9)
    assert torch.equal(wheel.decide(torch.zeros(0)).action, small.sim.action)


def test_a_choice_is_held_and_asking_again_changes_nothing(wheel):
    wheel.net.chance = torch.tensor([[0.2, 0.9]])
    first = wheel.decide(torch.zeros(0))
    assert torch.equal(wheel.decide(torch.zeros(0)).action, first.action)
    assert torch.equal(first.action, wheel.pilot.decision.action) and first.value.unique().tolist() == [
        pytest.approx(0.9)
    ]
    wheel.advance()
    wheel.net.chance = torch.tensor([[0.9, 0.2]])
    assert bool(wheel.drives.all()) and torch.equal(wheel.decide(torch.zeros(0)).value, first.value)


def test_columns_beyond_those_of_the_training_are_not_known(config):
    net = ArrivalNet(BODY_WIDTH, EGO_COLUMNS, TREE_WIDTH, config, torch.Generator())
    bodies, own = torch.rand(50, 9, BODY_WIDTH), torch.rand(50, EGO_COLUMNS + TREE_WIDTH)
    assert not net.knows(bodies, own).any()
    net.widen(bodies, own)
    assert net.knows(bodies, own).all()
    far, wide = own[:2].clone(), bodies[:2].clone()
    far[0, 3], wide[1, 4, 5] = 1.5, -0.5
    assert net.knows(bodies[:2], far).tolist() == [False, True]
    assert net.knows(wide, own[:2]).tolist() == [True, False]


def test_it_drives_whatever_the_order_of_the_episodes(small, saved):
    def widened(part):
        part["least"].fill_(-1e9)
        part["most"].fill_(1e9)

    pilot = load_chooser(saved(widened), small.sim)
    jobs, counts = jobs_of([3], 5), hand_overs_of(pilot)
    assert counts and hand_overs_of(load_set_pilot) is None
    forth, _ = run_episodes(small.sim, jobs, counts, driver=pilot)
    entry = {"name": "x", **counts.entry(forth, 0.02)}
    assert counts.entry([*forth, dataclasses.replace(forth[0], episode=99)], 0.02) == {}
    assert 0.0 <= entry["chooser"]["policy_share"] <= 1.0 and told(entry).startswith("x: ")
    back, _ = run_episodes(small.sim, jobs[::-1], driver=pilot)
    assert [(r.outcome, r.time_s, r.path_length_m) for r in forth] == [
        (r.outcome, r.time_s, r.path_length_m) for r in back[::-1]
    ]


# ----------------------------------------------------------------------------------------------- the trainer


def test_learning_goes_on_from_a_state_bit_for_bit(trainer, config, small):
    other = ChooserTrainer(config, {"pool": small.sim})
    other.load_state(copy.deepcopy(trainer.state()))
    kept = copy.deepcopy(trainer.state())
    ours = trainer.iterate()
    theirs = other.iterate()
    same = [name for name in ours if not name.startswith("time/")]
    assert {n: ours[n] for n in same} == {n: theirs[n] for n in same}
    for name, tensor in trainer.net.state_dict().items():
        assert torch.equal(tensor, other.net.state_dict()[name]), name
    trainer.load_state(kept)


def test_what_an_episode_ended_with_is_learnt(config, small):
    """Memory full of moments in which the policy arrives and the tree does not."""
    made = ChooserTrainer(config, {"pool": small.sim})
    rows, generator = made.memory.rows, torch.Generator().manual_seed(2)
    made.memory.count = 1024
    rows.own.copy_(torch.rand(rows.own.shape, generator=generator))
    rows.drives.copy_(torch.rand(1024, generator=generator) < 0.5)
    rows.ended.fill_(1)
    rows.arrived.copy_(rows.drives)
    losses = [made._fit() for _ in range(200)]
    chance = made.net(rows.bodies[:64].float(), rows.own[:64].float())
    assert losses[-1] < 0.1 < losses[0]
    assert chance[:, POLICY].min() > 0.8 and chance[:, TREE].max() < 0.2


def test_what_is_to_come_counts_where_the_episode_goes_on(config, small):
    """Nobody arrives here, but a choice later the slow copy says 0.9 of the better one."""
    quick = config.model_copy(update={"chooser": config.chooser.model_copy(update={"learning_rate": 0.03})})
    made = ChooserTrainer(quick, {"pool": small.sim})
    made.iteration = 2
    made.memory.count = 1024
    with torch.no_grad():
        for net in made._slow.nets:
            for parameter in net.parameters():
                parameter.zero_()
            net.head[-1].bias.copy_(torch.tensor([-3.0, 2.197]))
    before = made.net(made.memory.rows.bodies[:1].float(), made.memory.rows.own[:1].float())
    frozen = copy.deepcopy(made._slow.state_dict())
    for _ in range(300):
        made._fit()
        made._slow.load_state_dict(frozen)
    after = made.net(made.memory.rows.bodies[:1].float(), made.memory.rows.own[:1].float())
    assert abs(after[0, TREE].item() - 0.9) < 0.03
    assert after[0, POLICY] < 0.8 and before[0, TREE] < 0.75, "only what was done is learnt from"


def test_an_evaluation_says_how_many_arrive(trainer):
    before = copy.deepcopy(trainer.state())
    found = trainer.evaluate()
    assert sorted(found) == ["eval/success_pool_6_0.6", "eval/success_rate"]
    assert 0.0 <= found["eval/success_rate"] <= 1.0
    assert torch.equal(trainer.generator.get_state(), before["generator"]), "training goes on as if not"


# --------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda part: part.pop("least"), "not those of its config"),
        (lambda part: part.update({"nets.0.own.0.weight": torch.zeros(8, 3)}), "not those of its config"),
        (lambda part: part["nets.1.head.0.weight"].fill_(float("nan")), "is not finite"),
    ],
)
def test_networks_that_cannot_choose_are_refused(small, saved, change, says):
    with pytest.raises(CheckpointError, match=says):
        load_chooser(saved(change), small.sim)


def test_it_is_no_policy_of_one_observation_and_no_policy_of_the_twin(small, saved, policy):
    with pytest.raises(CheckpointError, match="looks at the simulator itself"):
        load_pilot(saved(), 1)
    with pytest.raises(CheckpointError, match="observation table"):
        load_set_pilot(saved(), small.sim)
    with pytest.raises(CheckpointError, match="observation table"):
        load_chooser(checkpoint.open_checkpoint(policy), small.sim)


def test_a_run_without_a_policy_of_the_twin_is_refused(saved):
    with pytest.raises(UserError, match="names no policy; train one"):
        ChooserTrainer(load_training("chooser", overrides=SMALL))
    other = {"chooser.policy": str(saved().path)}
    with pytest.raises(UserError, match="was not trained in the twin"):
        ChooserTrainer(load_training("chooser", overrides=SMALL | other))
    with pytest.raises(UserError, match="nowhere"):
        ChooserTrainer(load_training("chooser", overrides=SMALL | {"chooser.policy": "nowhere"}))

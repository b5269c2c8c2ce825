"""What training adds to a run: policy, PPO, distillation, world model and the schedule of the run itself.

Defaults are Table app_repro of the paper where it gives a number; the rest says why. Presets
(``presets/train``) state differences only.
"""

from __future__ import annotations

import itertools
from typing import Annotated, Literal

from pydantic import Field, field_validator

from uuvtai.config import Config
from uuvtai.config.base import Count, Fraction, NonNegative, Positive, PositiveCount, Section, Seed

Points = tuple[tuple[NonNegative, NonNegative], ...]
"""(share of the run, value): linear in between, constant outside; two points at the same share are a jump"""
SearchScene = tuple[Annotated[str, Field(min_length=1, max_length=200)], Count, Count, NonNegative]
"""world preset, S, D, v [m/s]"""


class PolicyConfig(Section):
    """Actor and critic."""

    hidden: tuple[PositiveCount, ...] = (256, 256)
    """widths of both networks' layers (Table app_repro)"""
    activation: Literal["elu", "tanh", "relu"] = "elu"
    initial_std: Positive = 0.6
    """of the action, in parts of the vehicle's limits (EC)"""
    min_std: Positive = 0.05
    """floor: the policy never stops exploring altogether (EC)"""
    hold_steps: PositiveCount = 5
    """control steps that an action is held: 10 Hz. Noise drawn anew every 0.02 s averages out before the
    vehicle has moved; held, it explores, and the networks run that much less often"""


class PpoConfig(Section):
    """Proximal policy optimisation (Table app_repro)."""

    rollout_steps: PositiveCount = 64
    learning_rate: Positive = 3e-4
    epochs: PositiveCount = 6
    minibatches: PositiveCount = 4
    clip: Positive = 0.2
    gamma: Fraction = 0.99
    gae_lambda: Fraction = 0.95
    entropy_weight: NonNegative = 0.003
    value_weight: NonNegative = 1.5
    max_grad_norm: Positive = 1.0
    target_kl: NonNegative = 0.0
    """0 = fixed learning rate; else the rate follows the KL divergence of every update (as rsl_rl does)"""
    normalise_observations: bool = True
    normalise_values: bool = True


class DistillationConfig(Section):
    """Supervision by the behaviour tree."""

    schedule: Points = ((0.0, 1.0), (2 / 3, 1.0), (2 / 3, 0.2), (4 / 3, 0.0))
    """lambda over the share of the run; the paper's breakpoints 800 and 1600 of 1200 iterations"""
    batch: PositiveCount = 1024
    steps: Count = 2
    """gradient steps on teacher batches after every update; 0 = none"""
    learning_rate: Positive = 1.5e-4

    @field_validator("schedule")
    @classmethod
    def _in_order(cls, value: Points) -> Points:
        if not value or any(a[0] > b[0] for a, b in itertools.pairwise(value)):
            raise ValueError(
                "needs at least one (share, value) point, shares not falling, for example [[0, 1], [1, 0]]"
            )
        return value


class UncertaintyConfig(Section):
    """Scale of the distillation by the world model's uncertainty (Table app_repro)."""

    ema: Annotated[float, Field(gt=0, le=1)] = 0.05
    """rho: weight of the newest uncertainty in the running mean"""
    gain: NonNegative = 0.8
    """alpha; 0 = no scaling (ablation 'LWM risk')"""
    max_scale: Annotated[float, Field(ge=1, le=1e12)] = 2.0


class WorldModelConfig(Section):
    """Latent one-step predictor (Table app_repro)."""

    enabled: bool = True
    as_features: bool = True
    """its residual and uncertainty are part of the policy's input; false feeds zeros (ablation 'LWM')"""
    latent: PositiveCount = 64
    hidden: tuple[PositiveCount, ...] = (128, 128)
    batch: PositiveCount = 2048
    steps: PositiveCount = 2
    """gradient steps per iteration"""
    learning_rate: Positive = 3e-4
    reconstruction_weight: NonNegative = 1.0
    dynamics_weight: NonNegative = 0.2
    """beta"""


class TrainConfig(Section):
    """The run."""

    iterations: PositiveCount = 1200
    num_envs: PositiveCount = 8
    seed: Seed = 0
    scenes: tuple[tuple[Count, Count, NonNegative], ...] = ()
    """(S, D, v [m/s]) dealt out to the envs in turn, slots permitting; none = the world's own, which
    evaluations use in any case"""
    checkpoint_every: PositiveCount = 50
    """iterations between checkpoints"""
    keep_checkpoints: PositiveCount = 3
    """newest ones kept, beside the best"""
    evaluate_every: Count = 0
    """iterations between evaluations without exploration noise; 0 = none"""
    evaluate_episodes: PositiveCount = 64
    evaluate_seed: Annotated[Seed, Field(validate_default=True)] = 500_000
    """scenarios of these evaluations; training never meets them"""
    patience: PositiveCount = 10
    """iterations in a row with values that are not finite before the run stops with an error (EC)"""

    @field_validator("evaluate_seed")
    @classmethod
    def _apart(cls, value: int, info) -> int:
        if value == info.data.get("seed"):
            raise ValueError(
                "must differ from train.seed: an evaluation on training scenarios proves nothing"
            )
        return value


class SurrogateConfig(Section):
    """A kinematic surrogate of the simulator to train in, and the policy over a set of obstacles that learns
    there (``docs/learning.md``)."""

    enabled: bool = False
    """train in the surrogate; false = in the simulator"""
    worlds: tuple[Annotated[str, Field(min_length=1, max_length=200)], ...] = ("pool", "gauntlet")
    """world presets whose scenarios are dealt out, each with all of ``train.scenes``"""
    scenarios: Annotated[int, Field(ge=1, le=2**20)] = 4096
    """drawn by the simulator for every pair of world and scene"""
    obstacle_hidden: PositiveCount = 64
    """width of the encoder that every obstacle goes through"""
    head_hidden: PositiveCount = 128
    """width of the layers behind it"""
    goal_gain: NonNegative = 0.7
    """the policy begins as this part of full speed along the route"""
    vertical_gap_m: Positive = 0.26
    """[m] heave is held back so that the centre stays so far from floor and surface"""
    safety_horizon_s: Annotated[float, Field(ge=0.0, le=5.0)] = 0.0
    """[s] a wish that leads to a contact or to a stop by time to collision within it gives way to a safe one,
    in training as on the vehicle (``surrogate/safety.py``); 0 = no wish does"""
    progress: NonNegative = 0.05
    """reward per metre nearer to the goal; arriving is worth 1, an accident costs 1"""
    time_cost: NonNegative = 0.01
    """per second"""
    closeness_cost: NonNegative = 0.1
    """per second at contact, none from ``soft_clearance_m`` on"""
    soft_clearance_m: Positive = 0.5
    warm_start_waves: Annotated[int, Field(ge=0, le=1000)] = 0
    """waves of episodes in the simulator in which the policy first learns to imitate the behaviour tree
    (DAgger), world by world and scene by scene; 0 = none"""


class ParameterSearchConfig(Section):
    """A search for better numbers of the behaviour tree (``tuned_numbers``; ``docs/learning.md``)."""

    enabled: bool = False
    """learn the tree's numbers"""
    scenes: tuple[SearchScene, ...] = (
        ("gauntlet", 8, 9, 1.5),
        ("pool", 8, 6, 0.6),
        ("pool", 8, 9, 1.5),
        ("maze", 8, 6, 0.6),
        ("gauntlet", 8, 9, 1.5),
        ("pool", 8, 6, 0.6),
    )
    """world preset, S, D and v [m/s] of what is run, an iteration each, in turn. By its speed a scene is
    one of slow obstacles (``fast.from_m_s`` or less) or of fast ones (``fast.full_m_s`` or more), and moves
    the numbers for these alone"""
    spread: Fraction = 0.3
    """numbers are tried so far from the best ones, in parts of the way between their bounds"""
    warm_up: Fraction = 0.25
    """part of the run before the numbers are moved for the first time"""
    time_cost: NonNegative = 0.005
    """[1/s] an arrival among fast obstacles is worth so much less per second"""
    slow_time_cost: NonNegative = 0.01
    """[1/s] the same among slow ones, where nearly all arrive"""


class ForecastTrainingConfig(Section):
    """A network that says what moving obstacles may do in the next 2.5 s (``docs/learning.md``)."""

    enabled: bool = False
    """learn a forecast"""
    worlds: tuple[Annotated[str, Field(min_length=1, max_length=200)], ...] = (
        "pool",
        "gauntlet",
        "maze",
        "gauntlet_inertial",
    )
    """world presets whose episodes are run in turn, ``train.scenes`` dealt out to the envs"""
    episode_steps: PositiveCount = 1500
    """control steps after which an episode is left"""
    minibatches: PositiveCount = 3000
    """steps of the network per iteration"""
    learning_rate: Positive = 2e-3
    """falls linearly over the run"""


class LearningConfig(Config):
    """A run's config with what training adds."""

    policy: PolicyConfig = PolicyConfig()
    ppo: PpoConfig = PpoConfig()
    distillation: DistillationConfig = DistillationConfig()
    uncertainty: UncertaintyConfig = UncertaintyConfig()
    world_model: WorldModelConfig = WorldModelConfig()
    surrogate: SurrogateConfig = SurrogateConfig()
    parameter_search: ParameterSearchConfig = ParameterSearchConfig()
    forecast_training: ForecastTrainingConfig = ForecastTrainingConfig()
    train: TrainConfig = TrainConfig()

    @property
    def learner(self) -> str:
        """Which trainer learns (``learning/runner.py``): ppo, search or forecast."""
        if self.forecast_training.enabled:
            return "forecast"
        return "search" if self.parameter_search.enabled else "ppo"

    @property
    def worlds(self) -> tuple[str, ...]:
        """World presets that are learnt in; none = the config's own world."""
        own = {
            "ppo": self.surrogate.worlds if self.surrogate.enabled else (),
            "search": dict.fromkeys(scene[0] for scene in self.parameter_search.scenes),
            "forecast": self.forecast_training.worlds,
        }
        return tuple(own[self.learner])

    @property
    def encoder(self) -> str:
        """What a policy's network takes: set, a set of obstacles, in the surrogate; mlp, an observation
        vector, in the simulator."""
        return "set" if self.surrogate.enabled else "mlp"

"""Evaluations in the course of a training: the policy as it is, on the simulator that it is trained with."""

from __future__ import annotations

from typing import TYPE_CHECKING

from uuvtai.config.learning import LearningConfig

if TYPE_CHECKING:
    from uuvtai.learn.run import AnyTrainer, Metrics


def evaluate_now(trainer: AnyTrainer, config: LearningConfig) -> Metrics:
    """``eval/*``: the policy as it is, without exploration, on scenarios of its own; training goes on as if
    nothing had been."""
    from uuvtai.learn.forecast_trainer import ForecastTrainer
    from uuvtai.learn.pilot import Pilot
    from uuvtai.learn.tuner_trainer import TunerTrainer
    from uuvtai.learn.twin_trainer import TwinTrainer
    from uuvtai.measure.episodes.playing import jobs_of, run_episodes
    from uuvtai.measure.evaluate.summary import summary

    if isinstance(trainer, TwinTrainer | TunerTrainer | ForecastTrainer):  # they play by themselves
        return trainer.evaluate()
    env = trainer.env
    model = trainer.world_model if config.world_model.as_features else None
    pilot = Pilot(trainer.policy, model, env.num_envs, env.device)
    held = env.capture()
    try:
        env.sim.sleep()
        env.sim.set_scenes()
        jobs = jobs_of([config.train.evaluate_seed], config.train.evaluate_episodes)
        results, env_steps = run_episodes(env.sim, jobs, driver=pilot)
    finally:
        env.sim.set_scenes(config.train.scenes)
        env.restore(held)
    results_document = summary("policy", results, env_steps, 0.0)
    names = ("success_rate", "collision_rate", "return_mean", "time_to_success_mean_s")
    return {f"eval/{name}": results_document[name] for name in names if results_document[name] is not None}

"""Evaluations in the course of a training: the policy as it is, on the simulator that it is trained with."""

from __future__ import annotations

from typing import TYPE_CHECKING

from uuvtai.config.learning import LearningConfig

if TYPE_CHECKING:
    from uuvtai.learn.run import AnyTrainer, Metrics
    from uuvtai.measure.evaluate.foresight import Foresight


def evaluate_now(trainer: AnyTrainer, config: LearningConfig) -> Metrics:
    """``eval/*``: the policy as it is, without exploration, on scenarios of its own; training goes on as if
    nothing had been.

    Half of these episodes calibrate the risk head, where there is one and they hold enough accidents; the
    others judge it.
    """
    from uuvtai.learn.chooser_trainer import ChooserTrainer
    from uuvtai.learn.forecast_trainer import ForecastTrainer
    from uuvtai.learn.pilot import Pilot
    from uuvtai.learn.tuner_trainer import TunerTrainer
    from uuvtai.learn.twin_trainer import TwinTrainer
    from uuvtai.measure.episodes.playing import Recorders, jobs_of, run_episodes
    from uuvtai.measure.evaluate.foresight import foresight_of
    from uuvtai.measure.evaluate.summary import summary

    if isinstance(
        trainer, TwinTrainer | ChooserTrainer | TunerTrainer | ForecastTrainer
    ):  # they play by themselves
        return trainer.evaluate()
    env = trainer.env
    model = trainer.world_model if config.world_model.as_features else None
    pilot = Pilot(trainer.policy, model, env.num_envs, env.device, trainer.risk)
    foresight = foresight_of(pilot, config.episode.control_dt_s)
    held = env.capture()
    try:
        env.sim.sleep()
        env.sim.set_scenes()
        jobs = jobs_of([config.train.evaluate_seed], config.train.evaluate_episodes)
        results, env_steps = run_episodes(env.sim, jobs, Recorders([foresight]), driver=pilot)
    finally:
        env.sim.set_scenes(config.train.scenes)
        env.restore(held)
    results_document = summary("policy", results, env_steps, 0.0)
    names = ("success_rate", "collision_rate", "return_mean", "time_to_success_mean_s")
    metrics = {f"eval/{name}": results_document[name] for name in names if results_document[name] is not None}
    return metrics | (_calibrated(foresight) if foresight else {})


_RISK_FIGURES = ("event_rate", "brier", "brier_base_rate", "ece", "auroc", "alarm_rate_safe")


def _calibrated(foresight: Foresight) -> Metrics:
    """Calibrate on every second episode, ``eval/risk_*`` on the others; nothing where accidents are too few
    for the promised miss rate."""
    from uuvtai.measure.evaluate.foresight import fit, judged

    moments = foresight.moments()
    try:
        fit(foresight.head, moments.of_episodes(0))
    except ValueError:
        return {}
    figures = judged(foresight.head, moments.of_episodes(1))
    if figures is None:
        return {}
    rates = {"miss_rate": figures["missed"] / figures["accidents"]} | {
        name: figures[name] for name in _RISK_FIGURES
    }
    return {f"eval/risk_{name}": float(value) for name, value in rates.items()}

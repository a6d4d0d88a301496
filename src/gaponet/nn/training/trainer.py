"""One training run: inputs, supervised pre-training, PPO, choice of the gain, export.

A run that was stopped and resumed equals an uninterrupted run bit for bit if its budget counts
control steps.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gaponet.base.errors import ModelError, UsageError
from gaponet.base.files import lock_folder, write_json
from gaponet.base.structure import validated
from gaponet.data.checks.gate import GateReport
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset, dataset_hash
from gaponet.nn.artifact import GapModel
from gaponet.nn.delay_offset import DelayOffset
from gaponet.nn.layers import DeltaNet
from gaponet.nn.networks import build_network
from gaponet.nn.onnx_export import export
from gaponet.nn.training.checkpoint import BestNetwork, Checkpoint, PPOState, StateDict
from gaponet.nn.training.config import Budget, Status, TrainConfig
from gaponet.nn.training.env import UNLIMITED, DeltaEnv, EnvOptions
from gaponet.nn.training.ppo import PPO
from gaponet.nn.training.pretraining import Pretraining, trajectory_labels
from gaponet.nn.training.run_card import run_card
from gaponet.nn.training.run_folder import Loggers, TrainingData, require_suitable, write_setup
from gaponet.nn.training.run_progress import RunProgress
from gaponet.nn.training.sensor_fit import fit_inputs, fit_sensors
from gaponet.nn.training.validation import Validator, choose_gain
from gaponet.robot.spec import RobotSpec

MAX_LABEL_SHARE = 0.99  # of delta_max, so that the network can reach the labels
EXPORT_ENVS = 64  # whose inputs are samples for the export, or one for each condition


class Trainer:
    """Runs the stages of one training run.

    Ctrl-C ends training, and the best model so far is exported.

    Attributes:
        baseline: Delay and offset of the training recordings. If it is not set before `run`, it is
            fitted.
        net: The network in training.
        progress: Budget, best networks and checkpoint.
        interrupted: Ctrl-C ended the run.
    """

    def __init__(
        self,
        dataset: Dataset,
        robot: RobotSpec,
        out: Path,
        config: TrainConfig,
        budget: Budget,
        *,
        resume: bool = False,
        holdout_units: tuple[str, ...] = (),
        show: Callable[[Status], None] = lambda status: None,
        log: tuple[str, ...] = (),
        shared: dict[str, Any] | None = None,
        gate: GateReport | None = None,
    ) -> None:
        """Read the recordings and write the run's setup.

        All inputs are checked before training takes time.

        Args:
            robot: The simulator that the network corrects.
            show: Called with the state of the run.
            shared: Name → result that does not depend on the kind of network, and the seconds that
                it took. Trainings of several kinds on the same recordings fill and use it; each has
                the same time left for its network.
            gate: What the doctor found in the recordings, for the card.

        Raises:
            DatasetError, UsageError: The recordings, the options or the folder do not fit.
            ModelError: The checkpoint is damaged.
        """
        config = validated(TrainConfig, asdict(config), "training options", UsageError).sized()
        require_suitable(out, robot, resume)
        self.out = out
        self.config = config
        self.gate = gate or GateReport()
        self.data = TrainingData(dataset, robot, config, holdout_units)
        torch.manual_seed(config.seed)
        torch.set_num_threads(config.learner_threads)
        self.net = build_network(config.model, len(robot.operated))
        weights = copy.deepcopy(self.net.state_dict())
        state = Checkpoint(
            BestNetwork(weights), BestNetwork(weights), dataset_hash=dataset_hash(dataset.entries)
        )
        with lock_folder(out, "run"):
            if resume:
                state = Checkpoint.read(out, self.net, state.dataset_hash)
            despite_errors = bool(self.gate.errors)
            write_setup(out, self.data, config, budget, resume, despite_errors)
            state.write_progress(out)
        self.net.to(config.network_device())
        loggers = Loggers(log, out, asdict(config))
        self.baseline: DelayOffset | None = None
        self.shared = {} if shared is None else shared
        self.validator = Validator(self.data.val, robot, config.model, config.threads)
        self.rng_state = torch.get_rng_state()
        self.interrupted = False
        self.progress = RunProgress(out, self.net, state, budget, self.validator, loggers, show)

    def run(self) -> GapModel:
        """Train until the budget is spent or Ctrl-C, and return the exported best model.

        Raises:
            FolderError: Another process writes into the run folder.
            ModelError: The budget ended before the first training step.
        """
        with lock_folder(self.out, "run"):
            self.baseline = self._write_baseline()
            nominal_errors = self.validator.errors(None, self.data.robot.nominal)
            self.progress.nominal_error = float(nominal_errors.mean())
            try:
                self._run_stages()
            except KeyboardInterrupt:
                self.interrupted = True
            if not self.progress.state.steps:
                why = "interrupted" if self.interrupted else "the budget ended"
                raise ModelError(
                    f"{self.out}: {why} after {self.progress.seconds():.0f} s, before the first "
                    "step of training: nothing was learned, no model written. Give --budget more "
                    "than that; gaponet train … --resume goes on here"
                )
            return self._finish()

    # ---- stages

    def _run_stages(self) -> None:
        """Run the stages that are left."""
        state = self.progress.state
        rounds = self.config.pretraining.rounds
        if not np.isfinite(state.best.error):
            # The untrained network corrects nothing: this is the error to improve on.
            self.progress.save_if_best(self.net, float(self.validator.errors(None).mean()))
        if state.ppo is None and state.pretraining_rounds < rounds:
            self._pretrain()
        elif state.ppo is None and not rounds:
            self._fit_inputs()
        if not self.progress.is_budget_spent() and self.config.model.kind != "trees":
            self._train_by_ppo()
        self._choose_gain()

    def _write_baseline(self) -> DelayOffset:
        """Write delay and offset of the training recordings into the run."""
        baseline = self.baseline or self._once("baseline", self._fit_baseline)
        write_json(self.out / "delay_offset.json", baseline)
        return baseline

    def _fit_baseline(self) -> DelayOffset:
        robot = self.data.robot.before_identification
        return DelayOffset.fit(self.data.recorded, robot, self.config.threads)

    def _once(self, name: str, make: Callable[[], Any]) -> Any:
        """Return a shared result.

        The first training makes it; its time counts for every training that uses it.
        """
        if name in self.shared:
            result, seconds = self.shared[name]
            self.progress.add_seconds(seconds)
            return result
        began = time.monotonic()
        result = make()
        self.shared[name] = result, time.monotonic() - began
        return result

    def _pretrain(self) -> None:
        """Supervised pre-training (nn/training/pretraining.py)."""
        progress = self.progress
        state = progress.state
        robot = self.data.robot
        config = self.config.pretraining
        threads = self.config.threads
        progress.stage = "labels"
        sequences = self.data.labelled_subset(config.rows)
        env = self._env(config.num_envs, UNLIMITED, self.config.seed, sequences=sequences)
        largest = MAX_LABEL_SHARE * self.config.model.delta_max
        labels = self._once(
            "labels",
            lambda: trajectory_labels(sequences, robot, largest, threads, progress.report),
        )
        pretraining = Pretraining(self.net, env, labels, config, self.config.seed, threads)
        if state.pretraining_rounds == 0:
            progress.begin_stage("sensors" if self.net.predictor is not None else "inputs")
            state.sensor_r2 = pretraining.fit_inputs()
        progress.stage = "pretraining"
        if state.pretraining is not None and not progress.is_budget_spent():
            pretraining.load_state_dict(state.pretraining)
            torch.set_rng_state(self.rng_state)
        while pretraining.rounds_done < config.rounds and not progress.is_budget_spent():
            fit = pretraining.round(progress.report)
            state.pretraining_rounds = pretraining.rounds_done
            state.pretraining = pretraining.state_dict()
            state.steps += config.num_envs * config.steps
            progress.validate_and_save(fit)

    def _fit_inputs(self) -> None:
        """Fit input statistics and the sensor predictor for PPO without pre-training."""
        self.progress.begin_stage("sensors")
        seed = self.config.seed
        env = self._env(self.config.pretraining.num_envs, UNLIMITED, seed)
        x = env.get_observations()["actor"]
        states = self.config.pretraining.sensor_states
        state = self.progress.state
        state.sensor_r2 = fit_inputs(self.net, env, x, states, seed, self.config.threads)
        state.best_trained.weights = copy.deepcopy(self.net.state_dict())

    def _train_by_ppo(self) -> None:
        """Train by PPO (nn/training/ppo.py) until the budget is spent."""
        progress = self.progress
        state = progress.state
        config = self.config.ppo
        progress.stage = "ppo"
        env = self._env(config.num_envs, self.config.episode_s, self.config.seed + 1)
        if state.ppo is None:
            self.net.load_state_dict(self._initial_ppo_weights())
        ppo = PPO(env, self.net, config)
        if state.ppo is not None:
            ppo.load_state_dict(state.ppo.learner)
            env.set_state(state.ppo.env)
            torch.set_rng_state(self.rng_state)
        state.pretraining = None
        while not progress.is_budget_spent():
            progress.update = ppo.update()
            state.ppo_updates += 1
            state.steps += config.num_envs * config.num_steps * self.config.model.delta_hold
            if config.refit_sensors and state.ppo_updates % config.refit_sensors == 0:
                self._refit_sensors(env)
            progress.report()
            if state.ppo_updates % self.config.validate_every == 0:
                self._save_ppo(ppo, env)
        self._save_ppo(ppo, env)

    def _save_ppo(self, ppo: PPO, env: DeltaEnv) -> None:
        """Validate the network, and store it with the states of PPO and its environments."""
        self.progress.state.ppo = PPOState(ppo.state_dict(), env.state())
        self.progress.validate_and_save(vars(self.progress.update))

    def _refit_sensors(self, env: DeltaEnv) -> None:
        """Continue the fit of the sensor predictor at the environment's present states."""
        state = self.progress.state
        states = self.config.pretraining.sensor_states
        seed = self.config.seed + state.ppo_updates
        threads = self.config.threads
        state.sensor_r2 = fit_sensors(self.net, env, states, seed, threads, refit=True)

    def _initial_ppo_weights(self) -> StateDict:
        """Return the best pre-trained weights, or untrained ones.

        Untrained ones if the best have a larger error than no correction. The sensor predictor
        stays as it is.
        """
        state = self.progress.state
        too_large = state.best_trained.error > state.untrained_error
        state.ppo_from_untrained = bool(self.config.pretraining.rounds) and too_large
        weights = dict(state.best_trained.weights)
        if not state.ppo_from_untrained:
            return weights
        with torch.random.fork_rng():
            torch.manual_seed(self.config.seed)
            untrained = build_network(self.config.model, self.net.n).state_dict()
        for name, _ in self.net.named_parameters():
            if not name.startswith("predictor."):
                weights[name] = untrained[name]
        return weights

    def _choose_gain(self) -> None:
        """Reduce the correction if that reduces the validation error.

        A resumed run continues with gain 1.
        """
        state = self.progress.state
        if not np.isfinite(state.best_trained.error):
            return
        self.progress.begin_stage("gain")
        net = self._network(state.best_trained.weights)
        gain = choose_gain(
            net, lambda: float(self.validator.errors(net).mean()), state.best_trained.error
        )
        if gain < 1.0:
            self.progress.save_if_best(net, float(self.validator.errors(net).mean()))

    def _finish(self) -> GapModel:
        """Export the best network."""
        self.progress.begin_stage("export")
        net = self._network(self.progress.state.best.weights).eval()
        env = self._env(max(EXPORT_ENVS, len(self.data.conditions)), UNLIMITED, 0, device="cpu")
        self.progress.close_loggers()
        samples = env.get_observations()["actor"].numpy()
        export(net, self.out / "model", self._card(net), samples)
        return GapModel.load(self.out)

    def _card(self, net: DeltaNet) -> dict[str, Any]:
        """Return the card of the best network."""
        assert self.baseline is not None
        state = self.progress.state
        reduction, standard_error = self.validator.improvement(net)
        errors = {
            "model": state.best.error,
            "nominal": self.progress.nominal_error,
            "start": state.untrained_error,
            "added": reduction,
        }
        if not np.isnan(standard_error):
            errors["error"] = standard_error
        return run_card(
            self.config,
            self.data,
            state,
            val_mpjae=errors,
            doctor=self.gate.to_dict(),
            excess_delay=max(self.baseline.delay.values()),
            seconds=round(self.progress.seconds(), 1),
            interrupted=self.interrupted,
        )

    # ---- parts of stages

    def _network(self, weights: StateDict) -> DeltaNet:
        with torch.random.fork_rng():
            net = build_network(self.config.model, self.net.n)
        net.load_state_dict(weights)
        return net

    def _env(
        self,
        num_envs: int,
        episode_s: float,
        seed: int,
        *,
        device: str | None = None,
        sequences: list[Sequence] | None = None,
    ) -> DeltaEnv:
        config = self.config
        return DeltaEnv(
            sequences or self.data.train,
            self.data.robot,
            config.model,
            EnvOptions(
                num_envs=num_envs,
                episode_s=episode_s,
                reward=config.reward,
                seed=seed,
                nthread=config.threads,
                device=device or config.device,
            ),
        )

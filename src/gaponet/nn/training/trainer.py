"""One training run: inputs, supervised pre-training, PPO, choice of the gain, export.

A run that was stopped and resumed equals an uninterrupted run bit for bit if its budget counts control steps.
"""

from __future__ import annotations

import copy
import platform
import time
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gaponet.base.errors import ModelError, UsageError
from gaponet.base.files import lock_folder, write_json
from gaponet.base.structure import validated
from gaponet.data.checks.gate import GateReport
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.store import Dataset, dataset_hash
from gaponet.nn.artifact import GapModel, KnownSimulators, make_card
from gaponet.nn.delay_offset import DelayOffset
from gaponet.nn.layers import DeltaNet
from gaponet.nn.networks import build_network
from gaponet.nn.onnx_export import export
from gaponet.nn.training.checkpoint import Checkpoint, StateDict
from gaponet.nn.training.config import Budget, Status, TrainConfig
from gaponet.nn.training.env import UNLIMITED, DeltaEnv, EnvOptions
from gaponet.nn.training.ppo import PPO, Update
from gaponet.nn.training.pretraining import Pretraining, trajectory_labels
from gaponet.nn.training.run_folder import Loggers, TrainingData, require_suitable, write_setup
from gaponet.nn.training.sensor_fit import fit_inputs, fit_sensors
from gaponet.nn.training.validation import Validator, choose_gain
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Condition
from gaponet.sim.context import contexts


class Trainer:
    """Runs the stages of one training run. Ctrl-C ends training, and the best model so far is exported.

    Attributes:
        baseline: Delay and offset of the training recordings. If it is not set before `run`, it is fitted.
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
        """Read the recordings and write the run's setup. All inputs are checked before training takes time.

        Args:
            robot: The simulator that the network corrects.
            show: Called with the state of the run.
            shared: Name → result that does not depend on the kind of network, and the seconds that it took. Trainings
                of several kinds on the same recordings fill and use it; each has the same time left for its network.
            gate: What the doctor found in the recordings, for the card.

        Raises:
            DatasetError, UsageError: The recordings, the options or the folder do not fit.
            ModelError: The checkpoint is damaged.
        """
        config = validated(TrainConfig, asdict(config), "training options", UsageError).sized()
        require_suitable(out, robot, resume)
        self.robot, self.out, self.config, self.budget, self.show = robot, out, config, budget, show
        self.gate = gate or GateReport()
        self.data = TrainingData(dataset, robot, config, holdout_units)
        torch.manual_seed(config.seed)
        torch.set_num_threads(self.config.learner_threads)
        self.net = net = build_network(config.model, len(robot.operated))
        weights = copy.deepcopy(net.state_dict())
        self.state = Checkpoint(weights, weights, dataset_hash=dataset_hash(dataset.entries))
        with lock_folder(out, "run"):
            if resume:
                self.state = Checkpoint.read(out, net, self.state.dataset_hash)
            despite_errors = bool(self.gate.errors)
            write_setup(out, self.data, config, budget, resume, despite_errors)
            self.state.write_progress(out)
        net.to(config.network_device())
        self.loggers = Loggers(log, out, asdict(config))
        self.baseline: DelayOffset | None = None
        self.shared = {} if shared is None else shared
        self.validator = Validator(self.data.val, robot, config.model, self.config.threads)
        self.rng_state = torch.get_rng_state()
        self.nominal_error = float("nan")
        self.update = Update()
        self.interrupted, self.stage = False, "start"
        self.started_at = time.monotonic()

    def run(self) -> GapModel:
        """Train until the budget is spent or Ctrl-C, and return the exported best model.

        Raises:
            FolderError: Another process writes into the run folder.
            ModelError: The budget ended before the first training step.
        """
        with lock_folder(self.out, "run"):
            self.baseline = self._write_baseline()
            self.nominal_error = float(self.validator.errors(None, self.robot.nominal).mean())
            try:
                self._run_stages()
            except KeyboardInterrupt:
                self.interrupted = True
            if not self.state.steps:
                why = "interrupted" if self.interrupted else "the budget ended"
                raise ModelError(
                    f"{self.out}: {why} after {self.seconds():.0f} s, before the first step of training: "
                    "nothing was learned, no model written. Give --budget more than that; gaponet train … --resume "
                    "goes on here"
                )
            return self._finish()

    def seconds(self) -> float:
        """Return the training time, including earlier parts of a resumed run."""
        return self.state.seconds + time.monotonic() - self.started_at

    # ---- stages

    def _run_stages(self) -> None:
        state, rounds = self.state, self.config.pretraining.rounds
        if not np.isfinite(
            state.best_error
        ):  # the untrained network corrects nothing: the error to improve on
            self._save_if_best(self.net, self.validator.errors(None).mean())
        if state.ppo is None and state.pretraining_rounds < rounds:
            self._pretrain()
        elif state.ppo is None and not rounds:
            self._fit_inputs()
        self._ppo()
        self._choose_gain()

    def _write_baseline(self) -> DelayOffset:
        robot = self.robot.before_identification
        fit = lambda: DelayOffset.fit(self.data.recorded, robot, self.config.threads)  # noqa: E731
        baseline = self.baseline or self._once("baseline", fit)
        write_json(self.out / "delay_offset.json", baseline)
        return baseline

    def _once(self, name: str, make: Callable[[], Any]) -> Any:
        """Return a shared result. The first training makes it; its time counts for every training that uses it."""
        if name in self.shared:
            result, seconds = self.shared[name]
            self.started_at -= seconds
            return result
        began, result = time.monotonic(), make()
        self.shared[name] = result, time.monotonic() - began
        return result

    def _pretrain(self) -> None:
        """Supervised pre-training (nn/training/pretraining.py)."""
        state, config, threads = self.state, self.config.pretraining, self.config.threads
        self.stage = "labels"
        sequences = self.data.labelled_subset(config.rows)
        env = self._env(config.num_envs, UNLIMITED, self.config.seed, sequences=sequences)
        largest = 0.99 * self.config.model.delta_max
        labels = self._once(
            "labels", lambda: trajectory_labels(sequences, self.robot, largest, threads, self._tick)
        )
        pretraining = Pretraining(self.net, env, labels, config, self.config.seed, threads)
        if state.pretraining_rounds == 0:
            self.stage = "sensors" if self.net.predictor is not None else "inputs"
            self._tick()
            state.sensor_r2 = pretraining.fit_inputs()
        self.stage = "pretraining"
        if state.pretraining is not None and self._spent() < 1:
            pretraining.load_state_dict(state.pretraining)
            torch.set_rng_state(self.rng_state)
        while pretraining.rounds_done < config.rounds and self._spent() < 1:
            fit = pretraining.round(self._tick)
            state.pretraining_rounds, state.pretraining = (
                pretraining.rounds_done,
                pretraining.state_dict(),
            )
            state.steps += config.num_envs * config.steps
            self._validate_and_save(fit)

    def _fit_inputs(self) -> None:
        """Fit input statistics and the sensor predictor for PPO without pre-training."""
        self.stage = "sensors"
        self._tick()
        env = self._env(self.config.pretraining.num_envs, UNLIMITED, self.config.seed)
        x = env.get_observations()["actor"]
        states, threads = self.config.pretraining.sensor_states, self.config.threads
        self.state.sensor_r2 = fit_inputs(self.net, env, x, states, self.config.seed, threads)
        self.state.best_trained_state = copy.deepcopy(self.net.state_dict())

    def _ppo(self) -> None:
        config, state = self.config.ppo, self.state
        if self._spent() >= 1 or self.config.model.kind == "trees":
            return
        self.stage = "ppo"
        episode_steps = round(self.config.episode_s / self.data.train[0].dt)
        env = self._env(config.num_envs, episode_steps, self.config.seed + 1)
        if state.ppo is None:
            self.net.load_state_dict(self._initial_ppo_weights())
        ppo = PPO(env, self.net, config)
        if state.ppo is not None and state.env is not None:
            ppo.load_state_dict(state.ppo)
            env.set_state(state.env)
            torch.set_rng_state(self.rng_state)
        state.pretraining = None
        while self._spent() < 1:
            self.update = ppo.update()
            state.ppo_updates += 1
            state.steps += config.num_envs * config.num_steps * self.config.model.delta_hold
            if config.refit_sensors and state.ppo_updates % config.refit_sensors == 0:
                states, seed = (
                    self.config.pretraining.sensor_states,
                    self.config.seed + state.ppo_updates,
                )
                state.sensor_r2 = fit_sensors(
                    self.net, env, states, seed, self.config.threads, refit=True
                )
            self._tick()
            if state.ppo_updates % self.config.validate_every == 0:
                state.ppo, state.env = ppo.state_dict(), env.state()
                self._validate_and_save(vars(self.update))
        state.ppo, state.env = ppo.state_dict(), env.state()
        self._validate_and_save(vars(self.update))

    def _initial_ppo_weights(self) -> StateDict:
        """Return the best pre-trained weights, or untrained ones if these have a larger error than no correction."""
        state = self.state
        too_large = state.best_trained_error > state.untrained_error
        state.ppo_from_untrained = bool(self.config.pretraining.rounds) and too_large
        if not state.ppo_from_untrained:
            return state.best_trained_state
        with torch.random.fork_rng():
            torch.manual_seed(self.config.seed)
            untrained = build_network(self.config.model, self.net.n).state_dict()
        parameters = {
            name for name, _ in self.net.named_parameters() if not name.startswith("predictor.")
        }
        return {
            k: untrained[k] if k in parameters else v for k, v in state.best_trained_state.items()
        }

    def _choose_gain(self) -> None:
        """Reduce the correction if that reduces the validation error. A resumed run continues with gain 1."""
        state = self.state
        # it has no gain
        if not np.isfinite(state.best_trained_error) or self.config.model.kind == "paper":
            return
        self.stage = "gain"
        self._tick()
        net = self._network(state.best_trained_state)
        if (
            choose_gain(
                net, lambda: float(self.validator.errors(net).mean()), state.best_trained_error
            )
            < 1.0
        ):
            self._save_if_best(net, self.validator.errors(net).mean())

    def _finish(self) -> GapModel:
        self.stage = "export"
        self._tick()
        net = self._network(self.state.best_state).eval()
        reduction, error = self.validator.improvement(net)
        improvement = {"added": reduction} | ({} if np.isnan(error) else {"error": error})
        self._export(net, improvement)
        return GapModel.load(self.out)

    def _export(self, net: DeltaNet, improvement: dict[str, float]) -> None:
        env = self._env(max(64, len(self.data.conditions)), 10, 0, device="cpu")
        self.loggers.close()
        samples = env.get_observations()["actor"].numpy()
        export(net, self.out / "model", self._card(improvement), samples)

    # ---- parts of stages

    def _network(self, weights: StateDict) -> DeltaNet:
        with torch.random.fork_rng():
            net = build_network(self.config.model, self.net.n)
        net.load_state_dict(weights)
        return net

    def _env(
        self,
        num_envs: int,
        episode_steps: int,
        seed: int,
        *,
        device: str | None = None,
        sequences: list[Sequence] | None = None,
    ) -> DeltaEnv:
        config = self.config
        return DeltaEnv(
            sequences or self.data.train,
            self.robot,
            config.model,
            EnvOptions(
                num_envs=num_envs,
                episode_steps=episode_steps,
                reward=config.reward,
                seed=seed,
                nthread=config.threads,
                device=device or config.device,
            ),
        )

    def _validate_and_save(self, metrics: dict[str, float]) -> None:
        """Validate the network in training, and save it with these metrics of its stage."""
        state, error = self.state, float(self.validator.errors(self.net).mean())
        if error < state.best_trained_error:
            state.best_trained_error, state.best_trained_state = (
                error,
                copy.deepcopy(self.net.state_dict()),
            )
        self._save_if_best(self.net, error, metrics)

    def _save_if_best(
        self, net: DeltaNet, error: float, metrics: dict[str, float] | None = None
    ) -> None:
        """Store a network if it is the best so far; write progress.jsonl and the checkpoint."""
        state = self.state
        state.val_error = float(error)
        if state.val_error < state.best_error:
            state.best_error, state.best_state = state.val_error, copy.deepcopy(net.state_dict())
        line = {
            "stage": self.stage, "steps": state.steps, "seconds": round(self.seconds(), 1),
            "val_mpjae": state.val_error, "nominal_mpjae": self.nominal_error,
        } | (metrics or {})  # fmt: skip
        state.progress.append({k: v if v == v else None for k, v in line.items()})
        self.loggers.write(line)
        state.seconds, self.started_at = self.seconds(), time.monotonic()
        state.write(self.out, self.net)
        self._tick()

    def _spent(self) -> float:
        return self.budget.spent(self.seconds(), self.state.steps)

    def _tick(self) -> None:
        """Report the state of the run."""
        state, share = self.state, min(self._spent(), 1.0)
        errors = state.val_error, state.best_error, self.nominal_error
        self.show(
            Status(self.stage, share, state.steps, self.seconds(), self.update.reward, *errors)
        )

    def _card(self, improvement: dict[str, float]) -> dict[str, Any]:
        data, state = self.data, self.state
        assert self.baseline is not None
        metas = [s.meta for s in data.recorded]
        return make_card(
            self.config.model,
            self.robot,
            dt=sorted({s.dt for s in data.recorded}),
            payload_seen=sorted({m.payload_mass for m in metas}),
            units=sorted({m.unit_id for m in metas}),
            recorded=_recorded_gains(metas, self.robot),
            virtual=any(m.virtual for m in metas),
            dataset_hash=dataset_hash(data.dataset.entries),
            hours=round(sum(s.duration for s in data.recorded) / 3600, 3),
            motions={
                part: sorted({e.meta.motion for e in entries})
                for part, entries in data.splits.items()
            },
            val_mpjae={
                "model": state.best_error,
                "nominal": self.nominal_error,
                "start": state.untrained_error,
            }
            | improvement,
            doctor=self.gate.to_dict(),
            sensor_r2=state.sensor_r2,
            seed=self.config.seed,
            gain=state.best_state["bounded.gain"].item(),
            excess_delay=max(self.baseline.delay.values()),
            steps=state.steps,
            seconds=round(self.seconds(), 1),
            interrupted=self.interrupted,
            **self._known_simulators(),
            stages={
                "pretraining_rounds": [state.pretraining_rounds, self.config.pretraining.rounds],
                "ppo_updates": state.ppo_updates,
                "ppo_from_untrained": state.ppo_from_untrained,
            },
            versions={p: version(p) for p in ("gaponet", "mujoco", "numpy", "torch")}
            | {"python": platform.python_version()},
        )

    def _known_simulators(self) -> dict[str, Any]:
        """Return the card's range of contexts, if the network is told its simulator's."""
        if not self.config.model.context:
            return {}
        nominal = Condition.of(self.data.recorded[0], self.robot)
        threads = self.config.threads
        loaded = self.config.model.context_is_loaded
        conditions = sorted(self.data.conditions, key=repr)
        trained = contexts(self.robot, conditions, threads, loaded=loaded)
        known = KnownSimulators.of(contexts(self.robot, [nominal], loaded=loaded)[0], trained)
        return {"context": known.to_card()}


def _recorded_gains(metas: list[SequenceMeta], robot: RobotSpec) -> dict[str, list[float] | None]:
    """Return kp and kd of the real servos in the training recordings; None where unknown or not the same in all.

    "kp" and "kd" of the card are the simulator's.
    """
    recorded: dict[str, list[float] | None] = {}
    for name in ("kp", "kd"):
        gains = {
            tuple(round(g[i], 9) for i in robot.operated_index)
            for m in metas
            if (g := getattr(m, name))
        }
        recorded[name] = list(gains.pop()) if len(gains) == 1 else None
    return recorded

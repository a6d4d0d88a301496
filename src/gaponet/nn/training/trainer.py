"""One training run: split, sensors, warm start, PPO, the best model on validation, its gain, export.

RUN/config.json        everything needed to repeat it       RUN/progress.jsonl   training curve, one line per validation
RUN/split.json         content hashes per part              RUN/checkpoint.pt    newest state, for --resume
RUN/delay_offset.json  the cheap baseline, same data        RUN/model/           the artifact: model.onnx, card.json
RUN/robot/             the simulator corrected              RUN/tensorboard/     the same curve, with --log tensorboard

A run that was stopped and resumed equals one that was not, bit for bit, as long as its budget counts steps.
"""

from __future__ import annotations

import copy
import hashlib
import json
import os
import platform
import time
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError, UsageError
from gaponet.base.files import lock_folder, write_text
from gaponet.base.structure import validated
from gaponet.data.pair import require_disjoint
from gaponet.data.sequence import Sequence, SequenceMeta, require_same_gains
from gaponet.data.split import parts_of, spread
from gaponet.data.store import Dataset, dataset_hash
from gaponet.nn import delay_offset
from gaponet.nn.artifact import GapModel, make_card
from gaponet.nn.layers import DeltaNet
from gaponet.nn.networks import build_network
from gaponet.nn.onnx_export import export
from gaponet.nn.training import ranks
from gaponet.nn.training.budget import Budget, Status
from gaponet.nn.training.checkpoint import Checkpoint, StateDict
from gaponet.nn.training.config import TrainConfig, command
from gaponet.nn.training.env import DeltaEnv
from gaponet.nn.training.labels import trajectory_labels
from gaponet.nn.training.loggers import Loggers
from gaponet.nn.training.ppo import PPO, Update
from gaponet.nn.training.pretraining import Pretraining, recipe
from gaponet.nn.training.sensor_fit import fit_inputs, refit_sensors
from gaponet.nn.training.validation import added, choose_gain, errors
from gaponet.robot.folder import STORED_ROBOT, has_stored_robot, load_stored_robot, save_robot
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Condition
from gaponet.sim.model import model_hash

VALIDATION_RUNS = 24  # free runs per validation at most, of every payload, unit and rate


class Trainer:
    """Holds one run; `run()` does it. Ctrl-C ends training and still exports the best model so far."""

    def __init__(
        self,
        dataset: Dataset,
        robot: RobotSpec,
        out: Path,
        config: TrainConfig,
        budget: Budget,
        resume: bool = False,
        holdout_units: tuple[str, ...] = (),
        show: Callable[[Status], None] = lambda status: None,
        log: tuple[str, ...] = (),
    ) -> None:
        """Split the dataset and refuse what cannot work, before any time is spent; log: any of loggers.KINDS."""
        dataset.require_robot(robot)
        config = validated(TrainConfig, asdict(config), "training options", UsageError).sized()
        if not resume and any((out / name).exists() for name in ("checkpoint.pt", "model/card.json")):
            raise UsageError(f"{out}: holds a run already; add --resume to go on with it, or choose another --out")
        if resume and not (out / "checkpoint.pt").is_file():
            raise UsageError(f"{out}: nothing to resume (no checkpoint.pt); train without --resume")
        if resume and has_stored_robot(out) and model_hash(load_stored_robot(out, robot.name)) != model_hash(robot):
            raise UsageError(f"{out}: was trained in another simulator; resume with --robot {out / STORED_ROBOT}")
        self.dataset, self.robot, self.out, self.config = dataset, robot, out, config
        self.budget, self.show, self.own = budget, show, ranks.share(config)
        rule = (holdout_units, config.holdout_payloads, config.rates, config.train_share)
        self.parts = parts_of(dataset, config.split, *rule)
        if not config.mixed_gains:
            together = (e.meta for part in self.parts.values() for e in part)
            require_same_gains(together, dataset.joint_names, robot.operated)
        self.train_set = dataset.sequences(self.parts["train"], optional=False)
        self.val_set = dataset.sequences(spread(self.parts["val"], VALIDATION_RUNS), optional=False)
        if not config.mixed_gains and (other := next((c for c in self._conditions() if c.kp or c.kd), None)):
            raise UsageError(
                f"the recordings were made with kp {other.kp} and kd {other.kd}, robot.toml says others: write there "
                "what the robot runs with, or add --mixed-gains to train in simulators of the recordings' own gains"
            )
        require_disjoint(*self.parts.values(), key=lambda entry: entry.hash)
        self.n = len(robot.operated)
        torch.manual_seed(config.seed)
        torch.set_num_threads(self.own.learner_threads)
        self.net = build_network(config.model, self.n)
        if ranks.rank():  # the same network, other noise
            torch.manual_seed(_seed(config.seed))
        self.untrained = copy.deepcopy(self.net.state_dict())
        self.state = Checkpoint(self.untrained, self.untrained, dataset=dataset_hash(dataset.entries))
        self.nominal, self.found, self.measured = float("nan"), Update(), dict[bytes, Array]()
        self.baseline: delay_offset.DelayOffset | None = None  # fitted at the start, unless it is known
        self.interrupted, self.stage = False, "start"
        self.began = time.monotonic()
        with ranks.on_first(lock_folder(out, "run")):
            if resume:
                self.state, self.rng = Checkpoint.read(out, self.net, self.state.dataset)
            if not ranks.rank():
                self._write_config(holdout_units, resume)
        self.net.to(config.network_device())
        self.loggers = Loggers(() if ranks.rank() else log, out, asdict(config))

    def run(self) -> GapModel:
        """Train until the budget is out or Ctrl-C; returns the exported best model.

        Raises:
            FolderError: Another process writes into the run.
        """
        with ranks.on_first(lock_folder(self.out, "run")):
            return self._run()

    def _run(self) -> GapModel:
        ranks.once(self._fit_baseline)
        self.nominal = float(self.validate(None, self.robot.nominal).mean())
        try:
            if not np.isfinite(self.state.best):  # the untrained network corrects nothing: nothing worse is ever kept
                self.measured[self._key(self.net)] = self.validate(None)
                self._consider()
            if self.state.learner is None and recipe(self.config).rounds > self.state.rounds_done:
                self._warm_start()
            elif not recipe(self.config).rounds and self.state.learner is None:
                self._cold_start()
            self._ppo()
            self._shrink()
        except KeyboardInterrupt:
            self.interrupted = True
        if not self.state.steps:
            why = "interrupted" if self.interrupted else "the budget ended"
            raise ModelError(
                f"{self.out}: {why} after {self.seconds():.0f} s, before the first step of training: nothing was "
                "learned, no model written. Give --budget more than that; gaponet train … --resume goes on here"
            )
        return self.finish()

    # ---- stages

    def _fit_baseline(self) -> None:
        if self.baseline is None:
            robot = self.robot.before_identification
            self.baseline = delay_offset.DelayOffset.fit(self.train_set, robot, self.own.threads)
        write_text(self.out / "delay_offset.json", json.dumps(self.baseline.to_json(), indent=1) + "\n")

    def _warm_start(self) -> None:
        config = recipe(self.own)
        self.stage = "labels"
        part = self.parts["train"]
        some = spread(part, max(1, config.rows * len(part) // sum(e.rows for e in part)))
        labelled = self.dataset.sequences(some, optional=False)
        env = self._env(config.num_envs, 10**9, self.config.seed, sequences=labelled)
        labels = trajectory_labels(
            labelled, self.robot, 0.99 * self.config.model.delta_max, self.own.threads, self._tick
        )
        warm = Pretraining(self.net, env, labels, config, _seed(self.config.seed), self.own.threads)
        warm.report = self.state.sensor_r2
        if self.state.rounds_done == 0:
            self.stage = "sensors" if self.net.predictor is not None else "inputs"
            self._tick()
            warm.begin()
        self.stage = "warm start"
        if self.state.warm is not None and self._spent() < 1:
            warm.set_state(self.state.warm)
            torch.set_rng_state(self.rng)
        while warm.done < config.rounds and self._spent() < 1:
            fit = warm.round(self._tick)
            self.state.sensor_r2 = warm.report
            self.state.rounds_done, self.state.warm = warm.done, warm.state()
            self.state.steps += ranks.world() * config.num_envs * config.steps
            self._consider(None, **fit)

    def _cold_start(self) -> None:
        """PPO alone also needs the statistics of its inputs, and sensors that answer."""
        self.stage = "sensors"
        self._tick()
        env = self._env(self.own.warm_start.num_envs, 10**9, self.config.seed)
        x = env.get_observations()["actor"]
        self.state.sensor_r2 = fit_inputs(
            self.net, env, x, self.config.warm_start.sensor_states, self.config.seed, self.own.threads
        )
        self.state.trained_state = copy.deepcopy(self.net.state_dict())

    def _ppo(self) -> None:
        ppo = self.own.ppo
        if self._spent() >= 1 or self.config.model.kind == "inverse":
            return
        self.stage = "ppo"
        steps = round(self.config.episode_s / self.train_set[0].dt)
        env = self._env(ppo.num_envs, steps, self.config.seed + 1)
        if self.state.learner is None:
            self.net.load_state_dict(self._ppo_start())
        learner = PPO(env, self.net, ppo)
        if self.state.learner is not None and self.state.env is not None:
            learner.load(self.state.learner)
            env.set_state(self.state.env)
            torch.set_rng_state(self.rng)
        self.state.warm = None
        while self._spent() < 1:
            self.found = learner.update()
            self.state.updates += 1
            self.state.steps += ranks.world() * ppo.num_envs * ppo.num_steps * self.config.model.delta_hold
            if ppo.refit_sensors and self.state.updates % ppo.refit_sensors == 0 and self.net.predictor is not None:
                seed = self.config.seed + self.state.updates
                self.state.sensor_r2 = refit_sensors(
                    self.net, env, self.own.warm_start.sensor_states, seed, self.own.threads
                )
            self._tick()
            if self.state.updates % self.config.validate_every == 0:
                self.state.learner, self.state.env = learner.state(), env.state()
                self._consider()
        self.state.learner, self.state.env = learner.state(), env.state()
        self._consider()

    def _ppo_start(self) -> StateDict:
        """The best of the warm start or, where that is worse than no correction, the untrained network beside it."""
        best = self.state.trained_state
        self.state.anew = bool(recipe(self.config).rounds) and self._in_vain()
        if not self.state.anew:
            return best
        trained = {name for name, _ in self.net.named_parameters() if not name.startswith("predictor.")}
        return {k: self.untrained[k] if k in trained else v for k, v in best.items()}

    def _in_vain(self) -> bool:
        """Whether nothing that was fitted is better than no correction."""
        return self.state.trained > self.state.progress[0]["val_mpjae"]

    def _shrink(self) -> None:
        """Less of the best correction where validation motions say so; a resumed run trains on with all of it."""
        if not np.isfinite(self.state.trained) or self.config.model.kind == "paper":  # which has no gain
            return
        self.stage = "gain"
        self._tick()
        with torch.random.fork_rng():
            net = build_network(self.config.model, self.n)
        net.load_state_dict(self.state.trained_state)
        if choose_gain(net, lambda: float(self.validate(net).mean()), self.state.trained) < 1.0:
            self._consider(net)

    def finish(self) -> GapModel:
        """Export the best model and write its card."""
        self.stage = "export"
        self._tick()
        net = build_network(self.config.model, self.n)
        net.load_state_dict(self.state.best_state)
        net.eval()
        adds, error = added(self.val_set, self.validate(None), self.validate(net))
        ranks.once(lambda: self._export(net, {"added": adds} | ({} if np.isnan(error) else {"error": error})))
        return GapModel.load(self.out)

    def _export(self, net: DeltaNet, worth: dict[str, float]) -> None:
        env = self._env(max(64, len(self._conditions())), 10, 0, "cpu")
        self.loggers.close()
        export(net, self.out / "model", self._card(worth), env.get_observations()["actor"].numpy())

    def _env(
        self, num_envs: int, episode_steps: int, seed: int, device: str | None = None,
        sequences: list[Sequence] | None = None,
    ) -> DeltaEnv:  # fmt: skip
        c = self.own
        how = c.reward, _seed(seed), c.threads, device or c.device
        return DeltaEnv(sequences or self.train_set, self.robot, c.model, num_envs, episode_steps, *how)

    # ---- validation, checkpoints, card

    def validate(self, net: DeltaNet | None, robot: RobotSpec | None = None) -> Array:
        """MPJAE of a whole-motion free run of each validation recording, (k,) rad, found once.

        Args:
            net: Corrects; None for the simulator as it is.
            robot: The simulator, if not the one that is trained in.
        """
        key = self._key(net, robot)
        if key not in self.measured:
            what = robot or self.robot, self.config.model, net, self.own.threads
            self.measured[key] = ranks.each(self.val_set, lambda own: errors(own, *what))
        return self.measured[key]

    @staticmethod
    def _key(net: DeltaNet | None, robot: RobotSpec | None = None) -> bytes:
        weights = [] if net is None else [x.cpu().numpy().tobytes() for x in net.state_dict().values()]
        return hashlib.sha256(b"".join([repr(robot).encode(), *weights])).digest()

    def _consider(self, shrunk: DeltaNet | None = None, **told: float) -> None:
        """Validate the present network, or a shrunk one; keep it if it is the best, write progress and checkpoint."""
        net = shrunk or self.net
        self.state.val = float(self.validate(net).mean())
        if self.state.val < self.state.best:
            self.state.best, self.state.best_state = self.state.val, copy.deepcopy(net.state_dict())
        if self.stage in ("warm start", "ppo") and self.state.val < self.state.trained:
            self.state.trained, self.state.trained_state = self.state.val, copy.deepcopy(net.state_dict())
        line = {
            "stage": self.stage, "steps": self.state.steps, "seconds": round(self.seconds(), 1),
            "val_mpjae": self.state.val, "nominal_mpjae": self.nominal,
        }  # fmt: skip
        line |= vars(self.found) if self.stage == "ppo" else told
        self.state.progress.append({k: v if v == v else None for k, v in line.items()})
        self.loggers.write(line)
        self.state.seconds, self.began = self.seconds(), time.monotonic()
        self.state.write(self.out, self.net)
        self._tick()

    def seconds(self) -> float:
        """Trained so far, earlier parts of a resumed run included."""
        return self.state.seconds + time.monotonic() - self.began

    def _spent(self) -> float:
        return ranks.decided(self.budget.spent(self.seconds(), self.state.steps))

    def _tick(self) -> float:
        """Show where the run stands; returns the share of the budget spent."""
        k, spent = self.state, self._spent()
        share = min(spent, 1.0)
        self.show(Status(self.stage, share, k.steps, self.seconds(), self.found.reward, k.val, k.best, self.nominal))
        return spent

    def _write_config(self, holdout_units: tuple[str, ...], resume: bool) -> None:
        data = self.dataset
        what = data.address or data.path, self.out, self.budget, self.config, self.robot, holdout_units, ranks.world()
        config = asdict(self.config) | {
            "budget": asdict(self.budget), "holdout_units": list(holdout_units), "robot": self.robot.name,
            "command": command(*what),
            "dataset": data.address or os.path.relpath(data.path, self.out), "dataset_hash": dataset_hash(data.entries),
        }  # fmt: skip
        write_text(self.out / "config.json", json.dumps(config, indent=1) + "\n")
        kept = self.out / STORED_ROBOT
        if self.robot.folder.resolve() != kept.resolve() and not (resume and has_stored_robot(self.out)):
            save_robot(self.robot, kept)
        split = {part: {e.id: e.hash for e in entries} for part, entries in self.parts.items()}
        write_text(self.out / "split.json", json.dumps(split, indent=1, ensure_ascii=False) + "\n")
        self.state.write_progress(self.out)

    def _conditions(self) -> set[Condition]:
        return {Condition.of(s, self.robot) for s in self.train_set}

    def _card(self, worth: dict[str, float]) -> dict[str, Any]:
        seen = self.train_set
        assert self.baseline is not None
        return make_card(
            self.config.model,
            self.robot,
            dt=sorted({s.dt for s in seen}),
            payload_seen=sorted({s.meta.payload_mass for s in seen}),
            units=sorted({s.meta.unit_id for s in seen}),
            recorded=_recorded_gains([s.meta for s in seen], self.robot),
            virtual=any(s.meta.virtual for s in seen),
            dataset_hash=dataset_hash(self.dataset.entries),
            hours=round(sum(s.duration for s in seen) / 3600, 3),
            motions={part: sorted({e.meta.motion for e in entries}) for part, entries in self.parts.items()},
            val_mpjae={"model": self.state.best, "nominal": self.nominal, "start": self.state.progress[0]["val_mpjae"]}
            | worth,
            sensor_r2=self.state.sensor_r2,
            seed=self.config.seed,
            gain=self.state.best_state["bounded.gain"].item(),
            excess_delay=max(self.baseline.delay.values()),
            steps=self.state.steps,
            seconds=round(self.seconds(), 1),
            interrupted=self.interrupted,
            stages={
                "warm_start_rounds": [self.state.rounds_done, recipe(self.config).rounds],
                "ppo_updates": self.state.updates,
                "ppo_anew": self.state.anew,
            },
            versions={p: version(p) for p in ("gaponet", "mujoco", "numpy", "torch")}
            | {"python": platform.python_version()},
        )


def _recorded_gains(metas: list[SequenceMeta], robot: RobotSpec) -> dict[str, list[float] | None]:
    """kp, kd of the operated joints while the training data were recorded; None where unknown or not one and the same.

    They are the real robot's; "kp" and "kd" of the card are the simulator's.
    """
    found: dict[str, list[float] | None] = {}
    for name in ("kp", "kd"):
        gains = {tuple(round(g[i], 9) for i in robot.operated_index) for m in metas if (g := getattr(m, name))}
        found[name] = list(gains.pop()) if len(gains) == 1 else None
    return found


def _seed(first: int) -> int:
    """The seed of what shall differ between ranks, from that of the first."""
    return first + ranks.APART * ranks.rank()

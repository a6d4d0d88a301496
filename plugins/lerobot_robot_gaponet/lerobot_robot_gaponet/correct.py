"""The correction of joint targets within bounds, and the processor step behind a policy."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry

from gaponet.robot.spec import RobotSpec, load_robot

from .units import DEFAULT_RATE, Units

MEMORY_PERIODS = 50  # control periods after which a correction no longer depends on its start


class Corrector:
    """Corrects joint targets once per control period, in rad, within bounds of size and rate.

    Attributes:
        spec: The robot.
        dt: Control period, s.
    """

    def __init__(
        self, spec: RobotSpec, compensator: Any, dt: float, payload_mass: float = 0.0
    ) -> None:
        from gaponet.hw.control.safety import Limits, SafetyConfig

        self.spec = spec
        self.compensator = compensator
        self.dt = dt
        self.payload_mass = payload_mass
        self.limits = Limits.from_robot(spec, spec.joint_names, SafetyConfig())
        self._delta: np.ndarray | None = None

    @classmethod
    def load(
        cls,
        known: str,
        model: str,
        payload_mass: float = 0.0,
        dynamics: bool = False,
        follow: bool = False,
        fps: float = DEFAULT_RATE,
    ) -> "Corrector":
        """Make the corrector of an identified robot or of a trained network.

        Args:
            known: Robot folder of gaponet identify, or a name of the package.
            model: Instead of it, a run of gaponet train.
            payload_mass: In each hand, kg.
            dynamics: Feed forward accelerations: only for planned, smooth targets.
            follow: Move as the nominal simulator of `known` does.
            fps: Control rate of LeRobot's loop, Hz.

        Raises:
            ValueError: Not one of known and model was given, or a model with follow.
            UsageError, ModelError: The robot or the model cannot carry the payload, or the model
                was trained at another rate.
        """
        from gaponet.deploy.compensator import Compensator, CompensatorConfig
        from gaponet.nn.artifact import GapModel

        if bool(model) == bool(known):
            raise ValueError(
                "gaponet: give either model, a run, or known, a robot folder of gaponet identify"
            )
        if follow and model:
            raise ValueError("gaponet: follow needs known, and takes no model")
        network = GapModel.load(model) if model else None
        place = Path(known) if Path(known).is_dir() else known
        spec = load_robot(place) if network is None else network.simulator()
        dt = 1 / fps
        config = CompensatorConfig(dynamics=dynamics)
        compensator = Compensator(
            spec, network, config=config, dt=dt, follow="nominal" if follow else None
        )
        compensator.require_payload(payload_mass)
        return cls(spec, compensator, dt, payload_mass)

    def restart(self) -> None:
        """Begin anew with the next target."""
        self._delta = None

    @property
    def started(self) -> bool:
        """Whether a target was corrected since the last restart."""
        return self._delta is not None

    def __call__(self, target: np.ndarray, qpos: np.ndarray | None = None) -> np.ndarray:
        """Return the corrected target, (n,) rad.

        Args:
            target: (n,) rad.
            qpos: Measured positions, (n,) rad, if they are known.
        """
        from gaponet.hw.control.safety import limit_delta

        if not np.isfinite(target).all():
            raise ValueError(
                "gaponet: the action lacks a joint, or holds a value that is not a number"
            )
        if self._delta is None:
            self.compensator.reset(target, self.payload_mass)
            self._delta = np.zeros_like(target)
        wanted = self.compensator.step(target, qpos) - target
        self._delta = limit_delta(wanted, self._delta, self.dt, self.limits)
        return np.clip(target + self._delta, self.limits.low, self.limits.high)


@ProcessorStepRegistry.register("gaponet_correct")
@dataclass
class GaponetCorrect(ProcessorStep):
    """Processor step that corrects joint targets once per control period.

    It corrects by a model or an identified robot. It is for robots other than gaponet_so101: the
    correction is limited in size and rate, but no watchdog protects the arm. As last step of a
    policy's postprocessor (gaponet attach), actions are tensors (..., n) of all joints, or a chunk
    (1, T, n) that is sent one row per period, and the state is unknown. As a robot action
    processor, actions are named, and the observation is used.
    """

    model: str = ""
    known: str = ""  # instead of a model, a robot folder of gaponet identify
    payload_mass: float = 0.0
    dynamics: bool = False  # feed forward accelerations: only for planned, smooth targets
    # Move as the nominal simulator of `known` does. The policy sees the measured state, whose delay
    # a policy with a high gain may not bear (docs/deploy.md): gaponet_so101 gives it the nominal
    # simulator's instead.
    follow: bool = False
    fps: float = DEFAULT_RATE  # control rate, Hz, equal to LeRobot's

    def __post_init__(self) -> None:
        self.corrector = Corrector.load(
            known=self.known,
            model=self.model,
            payload_mass=self.payload_mass,
            dynamics=self.dynamics,
            follow=self.follow,
            fps=self.fps,
        )
        self.units = Units(self.corrector.spec)
        self.reset()

    def reset(self) -> None:
        self.corrector.restart()
        # rows of the last chunk, after those that it continued
        self._chunk: np.ndarray | None = None

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        transition = transition.copy()
        action = transition[TransitionKey.ACTION]
        named = isinstance(action, dict)
        if not named and action.reshape(-1, len(self.units.keys)).shape[0] > 1:
            transition[TransitionKey.ACTION] = self._corrected_chunk(action)
            return transition
        given = (
            action if named else dict(zip(self.units.keys, action.flatten().tolist(), strict=True))
        )
        seen = transition.get(TransitionKey.OBSERVATION) or {}
        state = self.units.rad(seen) if all(key in seen for key in self.units.keys) else None
        sent = self.units.named(self.corrector(self.units.rad(given), state))
        transition[TransitionKey.ACTION] = (
            action | sent
            if named
            else torch.tensor(list(sent.values()), dtype=action.dtype).reshape(action.shape)
        )
        return transition

    def _corrected_chunk(self, action: torch.Tensor) -> torch.Tensor:
        """Correct all rows of a chunk.

        LeRobot does not tell how many rows of the last chunk were sent: the correction continues
        after the rows before the nearest one of that chunk.
        """
        if action.ndim > 2 and action.shape[:-2].numel() != 1:
            raise ValueError(
                f"gaponet_correct corrects one robot's chunk, not {tuple(action.shape)}"
            )
        keys = self.units.keys
        rows = [
            self.units.rad(dict(zip(keys, x.tolist(), strict=True)))
            for x in action.reshape(-1, len(keys))
        ]
        chunk = np.array(rows)
        before = chunk[:0]
        if self._chunk is not None:
            nearest = int(np.abs(self._chunk - chunk[0]).max(axis=1).argmin())
            before = self._chunk[max(0, nearest - MEMORY_PERIODS) : nearest]
        self.corrector.restart()
        sent = np.array([self.corrector(row) for row in (*before, *chunk)])[len(before) :]
        self._chunk = np.concatenate([before, chunk])
        out = [list(self.units.named(row).values()) for row in sent]
        return torch.tensor(out, dtype=action.dtype, device=action.device).reshape(action.shape)

    def get_config(self) -> dict[str, Any]:
        return {
            "model": self.model,
            "known": self.known,
            "payload_mass": self.payload_mass,
            "dynamics": self.dynamics,
            "follow": self.follow,
            "fps": self.fps,
        }

    def transform_features(self, features: dict[Any, dict[str, Any]]) -> dict[Any, dict[str, Any]]:
        return features

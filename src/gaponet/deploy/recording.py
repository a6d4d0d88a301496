"""Recording: every period of a controller, what it read, sent and why; as a Log of the motion, and as files."""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gaponet.arrays import Array
from gaponet.data.formats.npz import CYCLES
from gaponet.data.log import Channel, Log
from gaponet.deploy.driver import State
from gaponet.errors import LogError
from gaponet.files import whole, write_text, writing


class Event(NamedTuple):
    """A change of phase: when (s, monotonic), into which, and why."""

    time: float
    phase: str
    kind: str
    text: str


class Row(NamedTuple):
    """One period: its start, phase, what was asked for and sent (n) rad (None: no position command), and the state."""

    time: float
    phase: str
    target: Array | None
    ctrl: Array | None
    state: State


@dataclass
class Recording:
    """What a controller did.

    Attributes:
        virtual: Whether there was no real robot.
        joint_names: All joints, (n).
        dt: Control period, s.
        rows, events: In order of time.
        missed: Periods in which the loop did not start at all.
        late: How late each period started, s.
        meta: What the caller knows beside (unit, payload, gains, model).
    """

    robot: str
    virtual: bool
    joint_names: tuple[str, ...]
    commanded: tuple[str, ...]
    dt: float
    rows: list[Row] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    missed: int = 0
    late: list[float] = field(default_factory=list)
    meta: dict[str, Any] = field(default_factory=dict)

    @property
    def fault(self) -> Event | None:
        """The fault that ended it, if one did."""
        return next((e for e in self.events if e.phase in ("damp", "stopped") and e.kind not in ("end", "")), None)

    def log(self, source: str = "controller", phase: str = "run") -> Log:
        """The periods of a phase as a Log of the commanded joints, time from its first period, s.

        A row is what to_sequence wants: the state read at the start of a period, and the command sent in it.

        Raises:
            LogError: The phase was not reached or has fewer than two periods.
        """
        rows = [r for r in self.rows if r.phase == phase and r.ctrl is not None]
        if len(rows) < 2:
            last = self.events[-1] if self.events else None
            why = f"; it ended with: {last.text}" if last else ""
            raise LogError(f"{source}: {len(rows)} periods of phase '{phase}', nothing to learn from{why}")
        at = [self.joint_names.index(name) for name in self.commanded]
        time = np.array([r.time for r in rows])
        values = {"ctrl": np.stack([r.ctrl for r in rows if r.ctrl is not None])[:, at]}
        for name in ("qpos", "qvel", "tau", "temperature"):
            column = np.stack([getattr(r.state, name) for r in rows])[:, at]
            if np.isfinite(column).all():  # a bus without thermometers, say
                values[name] = column
        channels = {name: Channel(time - time[0], value) for name, value in values.items()}
        return Log(self.robot, self.commanded, channels, source, {"files": {}, **self.summary()})

    def summary(self) -> dict[str, Any]:
        """Phases, reasons and timing, for JSON; times from the first period, s."""
        start = self.rows[0].time if self.rows else 0.0
        late = np.array(self.late or [0.0])
        ages = np.array([r.time - r.state.time for r in self.rows] or [0.0])
        return self.meta | {
            "robot": self.robot,
            "virtual": self.virtual,
            "rate_hz": 1 / self.dt,
            "periods": len(self.rows),
            "missed": self.missed,
            "late_ms": {q: round(float(np.quantile(late, p)) * 1e3, 3) for q, p in QUANTILES.items()},
            "state_age_ms": {q: round(float(np.quantile(ages, p)) * 1e3, 3) for q, p in QUANTILES.items()},
            "refused_messages": self.rows[-1].state.refused if self.rows else 0,
            "events": [[round(e.time - start, 4), e.phase, e.kind, e.text] for e in self.events],
        }

    def save(self, folder: Path, name: str) -> Path:
        """NAME.parquet for gaponet import (if the run was reached), NAME.json, and all periods in NAME.cycles.npz.

        Where there is a recording of that name, this one is NAME-2, and so on. Returns the path of NAME.parquet.
        """
        with writing(folder, "recordings"):
            return self._save(folder, name)

    def _save(self, folder: Path, name: str) -> Path:
        import pyarrow as pa
        import pyarrow.parquet as pq

        taken = {file.name.split(".json")[0] for file in folder.glob("*.json")}
        name = next(n for k in itertools.count(1) if (n := f"{name}-{k}" if k > 1 else name) not in taken)
        write_text(folder / f"{name}.json", json.dumps(self.summary(), indent=1, ensure_ascii=False) + "\n")
        full = lambda x: np.full(len(self.joint_names), np.nan) if x is None else x  # noqa: E731
        states = {n: np.array([getattr(r.state, n) for r in self.rows]) for n in ("qpos", "qvel", "tau", "temperature")}
        everything = states | {
            "joint_names": np.array(self.joint_names),
            "time": np.array([r.time for r in self.rows]),
            "state_time": np.array([r.state.time for r in self.rows]),
            "phase": np.array([r.phase for r in self.rows]),
            "target": np.array([full(r.target) for r in self.rows]),
            "ctrl": np.array([full(r.ctrl) for r in self.rows]),
        }
        with whole(folder / f"{name}{CYCLES}") as temporary:
            np.savez_compressed(temporary, **everything)  # type: ignore[arg-type]
        path = folder / f"{name}.parquet"
        if sum(r.phase == "run" for r in self.rows) >= 2:
            log = self.log(str(path))
            columns = {"time": log.channels["ctrl"].time}
            for channel, (_, values) in log.channels.items():
                columns |= {f"{channel}.{j}": values[:, i] for i, j in enumerate(log.joint_names)}
            with whole(path) as temporary:
                pq.write_table(pa.table(columns), temporary)
        return path


QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}

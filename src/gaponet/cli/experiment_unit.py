"""gaponet experiment tracking and delivery: a VIRTUAL unit is played, with models that exist or are trained first."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from gaponet.cli.inputs import open_dataset
from gaponet.cli.out import Out, show_result, writes
from gaponet.cli.progress import bar
from gaponet.errors import UsageError
from gaponet.study.options import Options

if TYPE_CHECKING:
    from gaponet.data.store import Dataset
    from gaponet.robot import RobotSpec
    from gaponet.study.played.play import Progress
    from gaponet.study.played.trained import Trained
    from gaponet.study.result import Result

Shared = Annotated[Options, tyro.conf.arg(name="")]
MODELS = ("gaponet", "mlp:mlp_match=on")
QUICK_MOTIONS, QUICK_PLANS = 4, 5
PARTS = "parts"  # of OUT: what each method did


@dataclass(frozen=True)
class Played:
    """What is played on."""

    unit: str = ""
    """Of the fleet; default one that no model was trained on."""
    fleet: str = "default"
    """Virtual units: default, shifted, or a .toml file."""
    payloads: tuple[float, ...] = ()
    """kg in each hand; default those trained on, with --quick the lightest and the heaviest of them."""


@writes("experiments")
def tracking(
    dataset: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    runs: tuple[Path, ...] = (),
    motions: Path | None = None,
    count: int = 10,
    played: Annotated[Played, tyro.conf.arg(name="")] = Played(),
    options: Shared = Options(),  # noqa: B008
) -> None:
    """Figure 3 of the paper: Q_dis on motions never trained on, joint by joint and payload by payload.

    Alignment (simulator to robot) and compensation (robot to target) on a VIRTUAL unit; of real recordings, alignment
    on the test motions. About ten minutes on one core with models that are there; --quick in under five with training.

    Args:
        dataset: Dataset folder that the models were trained on.
        out: Folder of the results.
        runs: Run folders, or folders of them such as gaponet compare's cells; without any, GAPONet and the MLP are
            trained here, in OUT/cells.
        motions: Folder of motion files (SAGE txt, csv, npz) to play too, reported apart.
        count: How many motions are made for the experiment.
        played: The unit.
        options: Shared.
    """
    from gaponet.study.played.tracking import track
    from gaponet.study.played.tracking_result import result
    from gaponet.study.played.unseen import from_files, generated, require_unseen

    began = time.monotonic()
    data, robot, trained, out = _models(dataset, out, runs, played, options)
    if not any(e.meta.virtual for e in data.entries):
        show_result(_recorded(data, robot, trained, began), out, Out(options.json))
        return
    who, physics, payloads = _unit(robot, trained, played, options.quick)
    known = any(who in t.model.card["units"] for t in trained)
    with bar("motions") as update:
        made = generated(robot, QUICK_MOTIONS if options.quick else count, max(payloads))
        update(1, 2, "")
        made += from_files(robot, motions, max(payloads))[: QUICK_MOTIONS if options.quick else None] if motions else []
        made = require_unseen(made, data, robot, trained, open_dataset(dataset, options.robot)[0])
        update(2, 2, "")
    with bar("tracking") as update:
        scores, example = track(robot, physics, who, made, payloads, trained, _by_method(update), out / PARTS)
    more: dict[str, Any] = {"unit_trained_on": True} if known else {}
    more |= {"motions": len(made), "compensator": _compensator("tracking")}
    told = _facts(data, trained, who, played, payloads, began, more)
    show_result(
        result(robot, scores, example, made, _label(data, options.quick and not runs), told), out, Out(options.json)
    )


@writes("experiments")
def delivery(
    dataset: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    runs: tuple[Path, ...] = (),
    goals: int = 100,
    hold: float = 3.0,
    front: float = 0.1,
    goal_seed: int = 0,
    played: Annotated[Played, tyro.conf.arg(name="")] = Played(),
    options: Shared = Options(),  # noqa: B008
) -> None:
    """Table 1 of the paper: hands at goals under load, X, Y and Z offsets, success, settling, torque and heat.

    A VIRTUAL unit, targets from inverse kinematics, sent raw and through the compensator. About fifteen minutes on one
    core with models that are there; --quick in under five with training.

    Args:
        dataset: Dataset folder that the models were trained on.
        out: Folder of the results.
        runs: As of tracking.
        goals: Per payload, over the space that the hands reach and can hold the heaviest payload in.
        hold: At each goal, s.
        front: Goals lie at least so far in front of the robot's base, m.
        goal_seed: Of the goals.
        played: The unit.
        options: Shared.
    """
    from gaponet.study.played.delivery import deliver
    from gaponet.study.played.delivery_result import result
    from gaponet.study.played.goals import STOPS, Planner

    began = time.monotonic()
    if hold < 1.5:
        raise UsageError(f"--hold {hold:g}: offsets are those of the last second; hold for 1.5 s or more")
    data, robot, trained, out = _models(dataset, out, runs, played, options)
    if not any(e.meta.virtual for e in data.entries):
        raise UsageError(f"{dataset}: holds recordings of real robots; delivery plays a virtual unit, give its dataset")
    who, physics, payloads = _unit(robot, trained, played, options.quick)
    with bar("goals") as update:
        update(0, 1, "")
        planner = Planner(robot, max(payloads), goal_seed, hold, front)
        plans = planner.plans(QUICK_PLANS if options.quick else -(-goals // (STOPS * len(planner.arms))))
        update(1, 1, "")
    with bar("delivery") as update:
        found, costs, example = deliver(
            robot, physics, planner, plans, payloads, trained, _by_method(update), out / PARTS
        )
    more = {"goals_per_payload": len(plans) * STOPS * len(planner.arms), "hold_s": hold,
            "compensator": _compensator("delivery")}  # fmt: skip
    told = _facts(data, trained, who, played, payloads, began, more)
    show_result(result(found, costs, example, _label(data, options.quick and not runs), told), out, Out(options.json))


def _models(
    dataset: Path, out: Path, runs: tuple[Path, ...], played: Played, options: Options
) -> tuple[Dataset, RobotSpec, list[Trained], Path]:
    """Dataset, nominal robot, models (those given, else trained now or found in OUT/cells), folder of the results."""
    from gaponet.study.played.trained import load_trained

    data, robot = open_dataset(dataset, options.robot)
    data.require_robot(robot)
    if not runs:
        data, runs, out = _train(data, robot, out, played, options)
    robot = robot.nominal or robot
    trained = load_trained(runs, robot)
    if options.quick:
        trained = [t for t in trained if t.seed == trained[0].seed]
    return data, robot, trained, out


def _train(
    data: Dataset, robot: RobotSpec, out: Path, played: Played, options: Options
) -> tuple[Dataset, tuple[Path, ...], Path]:
    """GAPONet and an MLP of its size, resumable, without the unit that will be played; a rehearsal's folder is its own.

    Returns:
        Dataset trained on, runs, folder of the results.
    """
    from gaponet.cli.progress import bars
    from gaponet.study.study import Study, train_all

    units = sorted({e.meta.unit_id for e in data.entries})
    holdout = (played.unit or units[-1],) if len(units) > 1 and (not played.unit or played.unit in units) else ()
    study = Study.of(data, robot, out, options, holdout)
    cells = study.cells(MODELS)
    with bars("trainings", sum(not c.done for c in cells)) as show:
        failed = train_all(cells, study, show)
    if failed:
        raise UsageError(f"{failed[0]}; run it again to retry")
    return study.data, tuple(c.folder for c in cells), study.out


def _unit(robot: RobotSpec, trained: list[Trained], played: Played, quick: bool) -> tuple[str, Any, tuple[float, ...]]:
    """Name and physics of the unit, and the payloads."""
    from gaponet.virtual.fleet import load_fleet

    fleet = load_fleet(played.fleet, robot)
    known = {u for t in trained for u in t.model.card["units"]}
    who = played.unit or next((u for u in reversed(fleet.units) if u not in known), list(fleet.units)[-1])
    payloads = played.payloads or tuple(sorted({float(p) for t in trained for p in t.model.card["payload_seen"]}))
    if quick and not played.payloads:
        payloads = tuple(sorted({payloads[0], payloads[-1]}))
    return who, fleet.unit(who), payloads


def _recorded(data: Dataset, robot: RobotSpec, trained: list[Trained], began: float) -> Result:
    """Alignment with real recordings: the test motions of the runs."""
    from gaponet.eval.evaluate import choose
    from gaponet.study.played.tracking import align
    from gaponet.study.played.tracking_result import result
    from gaponet.study.result import facts, label

    entries, unseen = choose([t.run for t in trained], data)
    sequences = data.sequences(entries)
    with bar("alignment") as update:
        scores = align(lambda: sequences, ["recorded"] * len(entries), robot, trained, _by_method(update))
    told = facts(
        data, sorted({t.seed for t in trained}), test_motions=len({e.meta.motion for e in entries}), unseen=unseen,
        runs=_weights(trained), minutes=round((time.monotonic() - began) / 60, 1),
    )  # fmt: skip
    return result(robot, scores, None, [], label(data), told)


def _facts(
    data: Dataset, trained: list[Trained], who: str, played: Played, payloads: tuple[float, ...], began: float,
    more: dict[str, Any],
) -> dict[str, Any]:  # fmt: skip
    from gaponet.study.result import facts

    return facts(
        data, sorted({t.seed for t in trained}), unit=who, fleet=Path(played.fleet).stem,
        payloads=[f"{p:g} kg" for p in payloads], runs=_weights(trained), **more,
        minutes=round((time.monotonic() - began) / 60, 1),
    )  # fmt: skip


def _weights(trained: list[Trained]) -> list[str]:
    return [f"{t.method} seed {t.seed} ({t.model.weights_hash()})" for t in trained]


def _by_method(update: Callable[[float, float, str], None]) -> Progress:
    """A progress bar's update as what is told of each method."""
    return lambda method, share: update(share, 1.0, method)


def _compensator(name: str) -> str:
    """Its settings, in words."""
    from gaponet.study.played import delivery, tracking

    config = tracking.PLANNED if name == "tracking" else delivery.HOLD
    return ", ".join(f"{k} {v}" for k, v in asdict(config).items())


def _label(data: Dataset, trained_here: bool) -> str:
    """Whose numbers; those of a rehearsal's models mean nothing."""
    from gaponet.study.result import label

    note = " REHEARSAL: hardly any training, on a slice of the dataset; these numbers mean nothing."
    return label(data) + (note if trained_here else "")

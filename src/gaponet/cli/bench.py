"""gaponet bench: speed of simulation (sim), of training (train), and of a trained model (latency, aligned)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from gaponet.cli.options import Folder, Json
from gaponet.cli.out import Out
from gaponet.robot.folder import kept_robot
from gaponet.robot.spec import load_robot

CALLS = 3000  # of each runtime, with latency


def bench(
    what: tyro.conf.Positional[Literal["sim", "train", "latency", "aligned", "real"]],
    run: Folder = Path("."),
    robot: str = "so101",
    model: Literal["gaponet", "mlp"] = "gaponet",
    num_envs: int | None = None,
    rounds: int | None = None,
    data: Path | None = None,
    out: Path = Path("bench_real"),
    sets: tuple[str, ...] = (),
    questions: tuple[str, ...] = (),
    method: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    networks: int = 0,
    adversary: Literal["", "labels", "asked_labels", "late", "all_late", "joints"] = "",
    json: Json = False,
) -> None:
    """Measure speed, or methods on public recordings of real robots.

    Args:
        what: sim: replay and environment. train: inference, collection, update, and PPO as a whole. latency: one
            correction of a trained model, on each runtime. aligned: the aligned simulator against the nominal one.
            real: docs/benchmark.md.
        run: Run folder of gaponet train, for latency and aligned.
        robot: Robot name or folder.
        model: Network that is trained.
        num_envs: Simulations side by side; default 512, 1024 with train.
        data: Folder of the public recordings, with real; default GAPONET_DATA, else ../shared/data.
        out: Folder for datasets, table and figure, with real.
        sets: Only these data sets, with real.
        questions: Only these questions, such as "3 kg left out", with real.
        method: A method of your own, FILE.py:FUNCTION, with real; may be repeated.
        networks: Train networks too, with real, for so many control steps each; 0 for none.
        adversary: What is done, with real, to the recordings that are learned from: labels dealt out anew, or those of
            the recordings asked (asked_labels); late, 40 ms of delay added to one in ten, or to all of them and to
            those asked (all_late); joints in another order.
        rounds: Interleaved turns of each; default 15, 3 with train. The fastest counts, with train the median.
    """
    screen = Out(json)
    if what == "latency":
        _latency(run, screen)
    elif what == "aligned":
        _aligned(run, screen, num_envs or 512, rounds or 15)
    elif what == "sim":
        _sim(robot, screen, num_envs or 512, rounds or 15)
    elif what == "real":
        _real(data, out, sets, questions, method, networks, adversary, screen)
    else:
        _train(robot, model, screen, num_envs or 1024, rounds or 3)


def _real(
    data: Path | None,
    out: Path,
    sets: tuple[str, ...],
    questions: tuple[str, ...],
    method: tuple[str, ...],
    steps: int,
    adversary: str,
    screen: Out,
) -> None:  # fmt: skip
    from gaponet.experiments.real.bench import Bench, load_method
    from gaponet.experiments.real.cards import data_folder, read_cards
    from gaponet.experiments.real.page import COLUMNS, table, write_page
    from gaponet.experiments.real.rivals import METHODS

    methods = METHODS | {name: (name, function) for name, function in map(load_method, method)}
    if steps:
        from gaponet.experiments.real.networks import networks

        methods |= networks(steps)
    found = Bench(read_cards(), data_folder(data), out, methods, adversary, screen.say).run(sets, questions)
    screen.table("Real robots, recordings that no method was fitted to", list(COLUMNS), table(found["rows"]))
    for name, remarks in found["labels"].items():
        screen.say(f" of {name}: {'; '.join(remarks)}", "labels")
    for path in write_page(found, out):
        screen.say(f"written: {path!s}")
    screen.result(found)


def _sim(robot: str, out: Out, num_envs: int, rounds: int) -> None:
    from gaponet.experiments.speed.training import bench_sim

    speeds = bench_sim(load_robot(robot), num_envs, rounds=rounds)
    _print_speeds(out, f"{robot}, {num_envs} simulations", speeds)
    out.result({"robot": robot, "num_envs": num_envs, "results": speeds})


def _train(robot: str, model: Literal["gaponet", "mlp"], out: Out, num_envs: int, rounds: int) -> None:
    from gaponet.experiments.speed.training import bench_train
    from gaponet.nn.config import ModelConfig
    from gaponet.nn.training.config import TrainConfig

    result = bench_train(load_robot(robot), TrainConfig(ModelConfig(model)), num_envs, rounds)
    _print_speeds(out, f"{robot}, {model}, {num_envs} simulations", result["speeds"])
    out.say(
        f"PPO: {result['share_of_expected'] * 100:.0f} % of the {result['expected']:,.0f} control steps/s that physics,"
        f" inference and update allow; peak memory {result['peak_memory_bytes'] / 2**30:.2f} GiB"
    )
    out.result({"robot": robot, "model": model, "num_envs": num_envs} | result)


def _latency(run: Path, out: Out) -> None:
    from gaponet.experiments.speed.latency import measure

    result = measure(run, CALLS, threads=1)
    out.table(
        f"One step of {run}, {result['joints']} joints, one thread", ["", "p50 µs", "p99 µs", "max µs"],
        [[name, *(f"{t[q]:.0f}" for q in ("p50", "p99", "max"))] for name, t in result["microseconds"].items()],
    )  # fmt: skip
    out.say(f"{result['batch']} robots at once: {result['deltas_per_s']:,.0f} deltas/s")
    out.result(result)


def _aligned(run: Path, out: Out, num_envs: int, rounds: int) -> None:
    from gaponet.experiments.speed.aligned import bench_aligned
    from gaponet.nn.artifact import GapModel

    model = GapModel.load(run, threads=0)
    robot = kept_robot(run, model.card["robot"])
    speed = bench_aligned(robot, model, num_envs, rounds=rounds)
    ratio = speed["aligned"] / speed["nominal"]
    out.table(f"{robot.name}, {num_envs} simulations", ["", "control steps/s", "of nominal"], [
        [name, f"{v:,.0f}", f"{v / speed['nominal'] * 100:.0f} %"] for name, v in speed.items()
    ])  # fmt: skip
    out.result({"run": str(run), "num_envs": num_envs, "control_steps_per_s": speed, "ratio": ratio})


def _print_speeds(out: Out, title: str, speeds: dict[str, dict[str, float]]) -> None:
    rows = [[name, f"{r['control_steps_per_s']:,.0f}", f"{r['ratio'] * 100:.0f} %"] for name, r in speeds.items()]
    out.table(title, ["", "control steps/s", "of bare"], rows)

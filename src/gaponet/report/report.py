"""One self-contained offline HTML page about an identified robot or a run: what was fitted to what, how well it does,
what to beware of."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError, ModelError, UsageError
from gaponet.base.files import write_text
from gaponet.base.progress import Progress, no_progress
from gaponet.base.result_table import ResultTable
from gaponet.data.sequence import SequenceMeta
from gaponet.data.store import Dataset
from gaponet.nn.artifact import GapModel
from gaponet.report.candidate import is_robot, read_origin
from gaponet.report.methods import method, title
from gaponet.report.page import element, facts_table, figure, page, table, tag
from gaponet.report.page import picture as image
from gaponet.report.run_files import MEND, read_config, read_gap, read_metrics, read_progress, read_trajectories
from gaponet.report.tables import by_group, mrad, totals
from gaponet.report.verdict import added, verdict
from gaponet.robot.folder import has_stored_robot, load_stored_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.model import require_stored_robot

Picture = Callable[[RobotSpec, SequenceMeta, float, dict[str, Array]], bytes]
OPEN = 3  # motions shown without a click


def write_report(
    run: Path,
    dataset: Path | None = None,
    also: tuple[Path, ...] = (),
    robot: str | None = None,
    progress: Progress = no_progress,
    picture: Picture | None = None,
) -> Path:
    """Write report.html into a run or a robot folder from its newest evaluation, evaluating first where there is none.

    Args:
        run: Run of gaponet train, or robot folder of gaponet identify.
        dataset: Evaluate on this dataset first; default the newest evaluation, or the test motions of the dataset that
            was fitted to.
        also: Further runs to compare (only when evaluating).
        robot: Robot name or folder, if not the one that the run keeps.
        picture: Draws the robot (view.portrait); left out where it can draw nothing.
    """
    model = None if is_robot(run) else GapModel.load(run)
    asked = None if robot is None else require_stored_robot(run, load_robot(robot), ModelError, "leave --robot out")
    spec = load_robot(run) if model is None else asked or load_stored_robot(run, model.card["robot"])
    if dataset is not None or also or not (run / "trajectories.npz").is_file():
        _evaluate(run, dataset, also, asked, progress)
    metrics = read_metrics(run)
    arrays = read_trajectories(run, metrics, len(spec.operated))
    config, curve, gap = {} if model is None else read_config(run), read_progress(run), read_gap(run)
    own = "identified" if model is None else method(model.config.kind, spec)
    _require_complete(run, model, own, metrics, curve, spec)
    progress(0, 1, "drawing")
    commands = [config.get("command", ""), metrics["command"], shlex.join(["gaponet", "report", str(run)])]
    photo = () if picture is None else _photo(picture, arrays, metrics, spec, own)
    card = None if model is None else model.card
    text = _page(card, own, config, metrics, arrays, curve, spec, gap, photo, commands)
    path = run / "report.html"
    write_text(path, text)
    progress(1, 1, "drawing")
    return path


def _evaluate(
    run: Path, dataset: Path | None, also: tuple[Path, ...], robot: RobotSpec | None, progress: Progress
) -> None:
    from gaponet.report.evaluate import evaluate

    origin = read_origin(run) if is_robot(run) else read_config(run)
    kept = "" if origin is None else origin["dataset"]
    if dataset is None and "://" in kept:
        raise DatasetError(f"{run}: fitted to {kept}; evaluate it first: gaponet eval {run} '{kept}'")
    place = dataset or run / kept
    try:
        data = Dataset(place)
    except DatasetError as error:
        raise DatasetError(f"{error}. Say where the dataset is: gaponet report {run} --dataset DIR") from None
    robot = robot or load_stored_robot(place if has_stored_robot(place) else run, data.robot_name)
    evaluate([run, *also], data, robot, progress=progress).save(run)


def _require_complete(
    run: Path,
    model: GapModel | None,
    own: str,
    metrics: dict[str, Any],
    curve: list[dict[str, Any]],
    robot: RobotSpec,
) -> None:
    """Refuse what lacks something that a report says."""
    told = ("dt", "payload_seen", "units", "hours", "steps", "seconds", "seed", "excess_delay", "parity_rad", "motions")
    missing = [] if model is None else [name for name in (*told, "versions", "dataset_hash") if name not in model.card]
    methods, parts = metrics["methods"], {"date", "command", "moves", "shown"}
    whole = (
        parts <= metrics.keys()
        and set(methods["nominal"]["by_joint"]) <= set(metrics["moves"])  # joints that a recording holds
        and set(metrics["moves"]) == set(robot.operated)
    )
    missing += [] if own in methods and whole else [f"a whole evaluation of {title(own)}"]
    if model is not None:
        missing += [] if curve else ["progress.jsonl"]
        missing += ["motions"] if not missing and {"train", "val"} - set(model.card["motions"]) else []
    if missing:
        raise ModelError(f"{run}: {', '.join(missing)} is missing; {MEND}")


def _page(
    card: dict[str, Any] | None,
    own: str,
    config: dict[str, Any],
    metrics: dict[str, Any],
    arrays: dict[str, Array],
    curve: list[dict[str, Any]],
    robot: RobotSpec,
    gap: dict[str, Any] | None,
    photo: Iterable[Markup],
    commands: list[str],
) -> str:
    from gaponet.report.figures import evaluation as draw
    from gaponet.report.figures.gap_figure import waterfall

    methods, name = metrics["methods"], title(own)
    best = int(np.argmin([m["mpjae"] for m in methods.values()]))
    held_out = "on held-out recordings" if metrics["unseen"] else "(some recordings were used in training)"
    bars = [
        figure(draw.by_joint(methods), "Mean |q_sim − q_robot| of each operated joint."),
        figure(draw.by_horizon(methods), "Does it grow? Error in the last half of the time since the common start."),
    ]
    if len(methods["nominal"]["by_payload"]) > 1:
        bars.append(figure(draw.by_payload(methods), "Payload in each hand."))
    body = [
        element("h1", f"{robot.description}: {name}"),
        element("p", tag(metrics["virtual"]), " ", *_facts_line(card, metrics)),
        element("p", " ".join(verdict(methods)), css="lead"),
        *(element("div", text, css="warn") for text in warnings(card, own, metrics)),
        *photo,
        element("h2", f"Errors, whole-motion free run {held_out}"),
        _table(totals(methods, _both), best), *_simulators(metrics.get("simulators", {})),
        _explained(methods),
        element("h2", "By joint"), _by_joint(methods, own, metrics),
        element("div", *bars, css="row"),
        element("h2", "Trajectories"), *_trajectories(arrays, metrics, robot),
    ]  # fmt: skip
    if gap is not None:
        body += [
            element("h2", "Where the gap comes from"),
            figure(waterfall(gap), "What each step removes of the mean |error| (hollow: adds to it)."),
        ]
    if card is not None:
        curve_figure = figure(
            draw.training_curve(curve), "Free run over whole validation motions; the circled model was kept."
        )
        body += [element("h2", "Training"), element("div", curve_figure, _training_table(card, config), css="row")]
    body += [element("h2", "By motion"), _table(by_group(methods, "motion", _both))]
    body += [] if card is None else [element("h2", "What exactly"), _facts(card, metrics)]
    body += [
        element("h2", "Do it again"), *(element("p", element("code", line)) for line in commands if line),
    ]  # fmt: skip
    return page(f"{robot.name} {name}", Markup("").join(body))


def _simulators(ran: dict[str, str]) -> Iterator[Markup]:
    if ran:
        said = "; ".join(f"{title(name)} {simulator}" for name, simulator in ran.items())
        yield element("p", f"Simulators, by their hashes: {said}.", css="small")


def _trajectories(arrays: dict[str, Array], metrics: dict[str, Any], robot: RobotSpec) -> Iterator[Markup]:
    from gaponet.report.figures import evaluation as draw

    drawn = draw.trajectories(arrays, metrics["shown"], robot.operated, list(metrics["methods"]))
    shown = []
    for row, fig in drawn.items():
        facts = metrics["shown"][row]
        shown.append(
            figure(fig, element("b", facts["motion"]), f" (unit {facts['unit_id']}, {facts['payload_mass']:g} kg)")
        )
    yield element(
        "p", "The 20 s with most motion of each recording, of the joints that move the three with the largest nominal "
        "error. The zoom (shaded above) is where the command turns or stops: there lag and sag are seen. Errors of "
        "one motion are on one scale; Δa is a network's correction, where there is any.", css="small",
    )  # fmt: skip
    yield from shown[:OPEN]
    if shown[OPEN:]:
        yield element("details", element("summary", f"{len(shown) - OPEN} more motions"), *shown[OPEN:])


def _photo(
    draw: Picture, arrays: dict[str, Array], metrics: dict[str, Any], robot: RobotSpec, own: str
) -> Iterator[Markup]:
    """The robot in the motion with most travel, or a sentence that says why it is not seen."""
    travel = [np.abs(np.diff(arrays[f"{row}/recorded"], axis=0)).sum() for row in range(len(metrics["shown"]))]
    if not travel:
        return
    row = int(np.argmax(travel))
    facts = metrics["shown"][row]
    meta = SequenceMeta(
        robot.name, facts["unit_id"], facts["motion"], facts["payload_mass"], virtual=metrics["virtual"]
    )
    shown = {n: arrays[f"{row}/{n}"] for n in dict.fromkeys(("command", "nominal", own, "recorded"))}
    shown["command"] = np.roll(shown["command"], 1, axis=0)  # a command of row t says where to be at t + 1
    shown["command"][0] = shown["recorded"][0]
    try:
        png = draw(robot, meta, facts["dt"], shown)
    except UsageError as error:
        yield element("p", f"No picture of the robot: {error}", css="small")
        return
    caption = "When the nominal simulator is furthest from the robot; the shadow is the recording."
    yield element("figure", element("div", image(png, "image/png"), css="photo"), element("figcaption", caption))


def warnings(card: dict[str, Any] | None, own: str, metrics: dict[str, Any]) -> list[str]:
    """What a careful colleague would say about these numbers; own is the method, with the card of its model if any."""
    out, methods = [], metrics["methods"]
    if metrics["virtual"]:
        out.append("The recordings come from a virtual robot: these numbers say nothing about real hardware.")
    if not metrics["unseen"]:
        out.append("Some recordings were used in training or for choosing the model: not a held-out result.")
    if card is not None:
        out += _warnings_of_model(card, own, methods)
    worse = [j for j, m in methods[own]["by_joint"].items() if m["mpjae"] > methods["nominal"]["by_joint"][j]["mpjae"]]
    if worse:
        out.append(f"Worse than the nominal simulator on: {', '.join(worse)}.")
    return out


def _warnings_of_model(card: dict[str, Any], own: str, methods: dict[str, Any]) -> list[str]:
    out = []
    better = [n for n, m in methods.items() if n not in (own, "adapted") and m["mpjae"] <= methods[own]["mpjae"]]
    if better:
        out.append(f"The model does not beat {', '.join(map(title, better))}: do not use it.")
    seen, asked = card["payload_seen"], [float(p) for p in methods["nominal"]["by_payload"]]
    outside = [p for p in asked if not min(seen) <= p <= max(seen)]
    if outside:
        out.append(f"Payloads {outside} kg lie outside those trained on ({min(seen):g} to {max(seen):g} kg).")
    if len(card["units"]) == 1:
        out.append(
            f"Trained on one unit ({card['units'][0]}): another unit's zero offsets and friction are unknown to it."
        )
    span = card["model"]["history"] * card["model"]["stride"] * min(card["dt"])
    if card["excess_delay"] > span + 1e-6:
        out.append(
            f"The robot lags the simulator by {card['excess_delay'] * 1e3:.0f} ms, the history spans "
            f"{span * 1e3:.0f} ms: "
            "raise --model.history or --model.stride."
        )
    done, planned = card.get("stages", {}).get("warm_start_rounds", (0, 0))
    if done < planned:
        longer = "" if "identified" in methods and not added(methods, own).helps else "; train longer"
        out.append(f"Undertrained: the budget ended after {done} of {planned} rounds of the supervised start{longer}.")
    if card.get("interrupted"):
        out.append("Training was interrupted before its budget was out.")
    return out


def _facts_line(card: dict[str, Any] | None, metrics: dict[str, Any]) -> list[str]:
    trained = "" if card is None else f"trained {card['hours']:.2f} h of logs, {card['steps']:,} control steps; "
    return [
        f"{metrics['date']}: {metrics['sequences']} recordings, {len(metrics['motions'])} motions; {trained}simulator ",
        element("code", metrics["simulator_hash"]),
    ]  # fmt: skip


def _both(value: float) -> str:
    return f"{mrad(value)} ({np.degrees(value):.2f}°)"


def _explained(methods: dict[str, Any]) -> Markup:
    text = {
        "MPJAE": "mean |q_sim − q_robot| over all joints and steps, averaged over motions. The simulator starts where "
        "the recording starts and is given its commands, nothing else. 10 mrad = 0.57°.",
        "RMSE": "root of the mean squared error, mrad: large errors count more.",
        "static": "size of a joint's median error over a motion, mrad: what stays, such as sag and zero offsets.",
        "dynamic": "mean distance from that median, mrad: what comes and goes, such as lag, friction and backlash.",
        "Q_dis": "sum of |error| × Δt over a motion, mean of the joints: grows with the motion's length.",
        "≥ 0.05 rad": "share of steps with an error of 2.9° or more (0.1 rad: 5.7°).",
        "correlation": "Pearson's r between simulated and recorded angle of joints that moved.",
    }  # fmt: skip
    if "adapted" in methods:
        text[title("adapted")] = "the model in the simulator adapted to the unit (gaponet adapt)."
    return element("div", facts_table([[k, v] for k, v in text.items()]), css="small")


def _by_joint(methods: dict[str, Any], own: str, metrics: dict[str, Any]) -> Markup:
    mean, joints = by_group(methods, "joint"), methods[own]["by_joint"]
    rows = []
    for joint, *errors in mean.texts():
        moving = metrics["moves"][joint]
        moves = f"{moving} of {metrics['sequences']}" if moving else "none: stands still"
        rows.append([joint, *errors, *(mrad(joints[joint][k]) for k in ("static", "dynamic")), moves])
    return table([*mean.columns, f"{title(own)} static", f"{title(own)} dynamic", "moves in"], rows)


def _table(made: ResultTable, best: int | None = None) -> Markup:
    return table(made.columns, made.texts(), best)


def _training_table(card: dict[str, Any], config: dict[str, Any]) -> Markup:
    r2, shape, ppo, motions = card.get("sensor_r2"), card["model"], config["ppo"], card["motions"]
    rows = [
        ["trained on", f"{len(motions['train'])} motions, {card['hours']:.2f} h, units {', '.join(card['units'])}"],
        ["trained", GapModel.how_trained(card)],
        ["payloads", ", ".join(f"{p:g} kg" for p in card["payload_seen"])],
        ["validated on", ", ".join(motions["val"][:6]) + (" …" if len(motions["val"]) > 6 else "")],
        ["observation", f"{shape['history']} past frames, payload {'in' if shape['payload_input'] else 'out'}"],
        ["sensors", shape.get("sensors", "–") if shape["kind"] == "gaponet" else "–"],
        ["sensor predictor R²", _r2(r2)],
        ["steps, time", f"{card['steps']:,} control steps in {card['seconds'] / 60:.1f} min"],
        ["PPO", f"{ppo['num_envs']} environments, {ppo['epochs']} epochs, σ {ppo['std']:g} rad"],
        ["seed", str(card["seed"])],
        ["ONNX against torch", f"{card['parity_rad']:.1e} rad"],
    ]  # fmt: skip
    return facts_table(rows)


def _r2(found: dict[str, Any] | None) -> str:
    """Held-out R² of the sensor predictor."""
    if found is None:
        return "–"
    joints = ", ".join(f"{j} {v:.2f}" for j, v in found["by_joint"].items())
    return f"{found['mean']:.3f} on held-out states ({joints})"


def _facts(card: dict[str, Any], metrics: dict[str, Any]) -> Markup:
    rows = [
        ["robot, joints", f"{card['robot']}: {', '.join(card['joint_names'])}"],
        ["simulator", f"{metrics['simulator_hash']}; kp {card['kp']}, kd {card['kd']}"],
        ["dataset", f"{metrics['dataset']} (trained on {card['dataset_hash']})"],
        ["rate", ", ".join(f"{1 / dt:.2f} Hz" for dt in card["dt"])],
        ["largest |Δa|", f"limit {card['model']['delta_max']} rad; seen "
         + ", ".join(f"{n} {d['max']:.3f}" for n, d in metrics["delta"].items())],
        ["artifacts", ", ".join(f"{n} {a['weights']} (seed {a['seed']})" for n, a in metrics["artifacts"].items())],
        ["versions", ", ".join(f"{k} {v}" for k, v in card["versions"].items())],
    ]  # fmt: skip
    return facts_table(rows)

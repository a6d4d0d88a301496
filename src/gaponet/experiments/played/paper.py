"""Every figure and table of the GAPONet paper from one command: of its network and of ours, beside its numbers."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from gaponet.base.errors import UsageError
from gaponet.base.result_table import MeanStd, ResultTable
from gaponet.data.card import count
from gaponet.data.store import Dataset
from gaponet.experiments.found import Found, spread
from gaponet.experiments.options import MODELS
from gaponet.experiments.paper import CARD, CLAIMS, PAYLOADS, TABLE_1, TABLE_1_METHODS, TABLE_2, Printed
from gaponet.experiments.played import delivery, tracking
from gaponet.experiments.played.deliver import HOLD, Placed
from gaponet.experiments.played.measured import cut, methods, of, over_seeds, payloads
from gaponet.experiments.played.session import Playing, Session, Tell
from gaponet.experiments.played.track import Score
from gaponet.experiments.pool import Cell
from gaponet.experiments.result import Result
from gaponet.experiments.study import Study, rates_of
from gaponet.report.methods import title
from gaponet.robot.spec import RobotSpec

FORM = "paper"  # the paper's network in its own setting
SUPERVISED = f"{FORM}:payload_input=off:warm_start.rounds=2"  # the same network with the recipe of gaponet train
LEARNED = ("mlp", FORM, "gaponet")
AXES = delivery.AXES
TRAINED = {"paper": "PPO alone", "labels": "supervised labels, then PPO"}
# Comparisons that our network has the switch for; it observes the payload in its own setting.
OURS: dict[str, dict[str, str | None]] = {
    "payload input": {"payload_input=on": "", "payload_input=on:payload_trunk=off": None, "": "payload_input=off"},
    "control rate": {},
    "history H": {},
}
FIGURE_2 = ("joint_ranges", "composition", "torque_temperature")


@dataclass(frozen=True)
class Paper(Playing):
    """All figures and tables of the GAPONet paper: data, Figures 2 and 3, Tables 1 and 2, of its network and of ours.

    Of real recordings: the data, alignment and Table 2. The same command again goes on where it was. About one night
    on two cores; --quick in under five minutes.
    """

    recipe: Literal["paper", "labels"] = "paper"
    """How the paper's network is trained. paper: PPO from an untrained network. labels: as gaponet train does."""
    paper_budget: str = "1000000"
    """Control steps of each training of the paper's network; with --quick --budget says it."""
    count: int = 10
    """Motions of Figure 3, made for the experiment."""
    goals: int = 100
    """Goals of Table 1, per payload."""

    def require(self, data: Dataset) -> None:
        """Refuse runs made elsewhere: rows of Table 2 must differ in one setting alone."""
        if self.runs:
            raise UsageError("--runs: experiment paper trains all its models; leave --runs out")

    def own(self, study: Study) -> Study:
        """The study with the setting and training of the paper."""
        config = study.config.paper_recipe() if self.recipe == "paper" else study.config
        config = replace(config, model=replace(config.model, payload_input=False))
        return replace(study, config=config, budget=study.budget if study.rehearsal else self.paper_budget)

    def cells(self, study: Study) -> list[Cell]:
        """The models of Figure 3 and Table 1 first, then the rows of Table 2."""
        own = self.own(study)
        words = [word for _, _, word, _ in settings(own)]
        ours = [word for _, _, word, _ in settings(study)]
        supervised = [SUPERVISED] if self.recipe == "paper" else []
        return [*own.cells([FORM]), *study.cells(MODELS), *own.cells(_new(words, FORM)),
                *study.cells([*_new(ours, *MODELS), *supervised])]  # fmt: skip

    def played(self, cells: ListOf[Cell]) -> tuple[Path, ...]:
        """The models in their own settings."""
        return tuple(c.folder for c in cells if c.variant.name in (FORM, *MODELS))

    def play(self, session: Session, tell: Tell) -> Result:
        """Everything, in the paper's order."""
        from gaponet.report.figures.draw_dataset import pictures  # needs the extra "report"

        assert session.study is not None
        study, data, robot = session.study, session.data, session.robot
        figures, _ = pictures(data, robot, FIGURE_2)
        tracked = tracking.Tracking(count=self.count).measured(session, tell)
        virtual = any(e.meta.virtual for e in data.entries)
        placed, told = list[Placed](), dict[str, Any]()
        if virtual:
            delivered = delivery.Delivery(goals=self.goals).measured(session, tell)
            placed, told = delivered.placed, {"config": HOLD}
            figures["offsets"] = delivery.draw_offsets(placed)
        scores, joints = tracked.scores, tracking.joint_sets(robot)
        source = "VIRTUAL robot" if virtual else "real robot"
        figures["joints"] = tracking.draw_joints(scores, robot, source)
        parts = list(dict.fromkeys(s.part for s in scores))
        found = Found.of(session.cells, study)
        tables = [card(data, robot), claims(scores, placed, joints[0])]
        tables += [tracking.by_payload(scores, part, joints) for part in parts]
        tables += [delivery.beside_paper(placed), ratios(placed), delivery.offsets(placed)] if virtual else []
        supervised: Setting = ("training", TRAINED["labels"], SUPERVISED, None)
        tables += [table_2(found, self.own(study), supervised), table_2(found, study)]
        tables += [replace(tracking.by_joint(scores, part, robot), shown=False) for part in parts]
        heading = f"The GAPONet paper's figures and tables ({source})"
        said = [f"The paper's network was trained by {TRAINED[self.recipe]}, {self.own(study).budget} control steps."]
        return session.result("paper", heading, tables, figures, said, **told)


Setting = tuple[str, str, str, Printed | None]  # comparison, setting, word of study.variant, printed row


def settings(study: Study) -> list[Setting]:
    """Rows of Table 2 that the dataset allows: of the paper's network where payload is not observed, else of ours."""
    several = {"payload input": len({e.meta.payload_mass for e in study.data.entries}) > 1,
               "control rate": len(rates_of(study.data)) > 1}  # fmt: skip
    own = not study.config.model.payload_input
    found: list[Setting] = []
    for comparison, rows in TABLE_2.items():
        if not several.get(comparison, True) or not (own or comparison in OURS):
            continue
        for setting, change, printed in rows:
            word = change if own else OURS[comparison].get(change, change)
            if word is not None:
                kind = FORM if own else "gaponet"
                found.append((comparison, setting, f"{kind}:{word}" if word else kind, printed))
    return found


def _new(words: ListOf[str], *known: str) -> list[str]:
    return [w for w in dict.fromkeys(words) if w not in known]


def card(data: Dataset, robot: RobotSpec) -> ResultTable:
    """What the dataset holds beside what the paper counts."""
    entries = data.entries
    here = count(entries) | {
        "units": len({e.meta.unit_id for e in entries}), "joints": len(robot.operated),
        "repetitions": len({e.meta.repetition for e in entries}),
        "signals": len({c for e in entries for c in e.channels}),
    }  # fmt: skip
    rows: list[tuple[Any, ...]] = [(name, printed, here[name]) for name, printed in CARD.items()]
    rows.append(("payloads, kg", ", ".join(f"{p:g}" for p in PAYLOADS), _listed(e.meta.payload_mass for e in entries)))
    rows.append(("rates, Hz", "50, 100", _listed(round(1 / e.dt) for e in entries)))
    caption = (
        "The paper's counts do not agree with each other: 28.46 h at 50 Hz are 5.1 million frames, and 257,493 frames "
        "of 11,198 sequences are 23 frames each. Signals: channels that any sequence holds."
    )
    return ResultTable("card", ("what", "the paper", "here"), tuple(rows), caption)


def _listed(values: Any) -> str:
    return ", ".join(f"{v:g}" for v in sorted(set(values)))


def claims(scores: ListOf[Score], placed: ListOf[Placed], joints: tracking.Joints) -> ResultTable:
    """What the paper claims, and the same of each model here: how much less error, %."""
    learned = [m for m in LEARNED if m in methods(scores)]
    rows: list[tuple[Any, ...]] = []

    def less(some: ListOf[Any], base: float, value: Callable[[Any], float]) -> list[MeanStd]:
        return [over_seeds(of(some, m), lambda measured: cut(value(measured), base)) for m in learned]

    for part in dict.fromkeys(s.part for s in scores):
        some, base = [s for s in scores if s.part == part], tracking.BASE[part]
        for name, mass in (("Q_dis, all payloads", None), ("Q_dis, heaviest payload", payloads(some)[-1])):
            group = of(some, payload=mass)
            error = tracking.q_dis(group, base, joints[1]).mean
            found = less(group, error, lambda s: float(s.q_dis[joints[1]].mean()))
            rows.append((f"{part}: {name}, less than {title(base)}", CLAIMS[name], *found))
    heavy = payloads(placed)[-1:]
    for a, axis in enumerate(AXES if heavy and "mlp" in methods(placed) else ()):
        error = delivery.axis(placed, "mlp", heavy[0], a)
        found = less(of(placed, payload=heavy[0]), error, partial(_along, a))
        rows.append((f"delivery: {axis} at {heavy[0]:g} kg, less than {title('mlp')}", CLAIMS[axis], *found))
    caption = (
        f"Per cent less error, mean ± std over seeds; Q_dis of {joints[0]}. The paper says Q_dis once of simulator and "
        "robot (alignment) and once of target and robot (compensation)."
    )
    return ResultTable(
        "claims", ("claim", "the paper, %", *(f"{title(m)}, %" for m in learned)), tuple(rows), caption, 0
    )


def _along(axis: int, measured: Placed) -> float:
    return float(measured.offset[axis])


def ratios(placed: ListOf[Placed]) -> ResultTable:
    """Offsets of GAPONet as shares of the MLP's and of raw targets', as the printed Table 1 gives them and here."""
    shown = [m for m in (FORM, "gaponet") if m in methods(placed)]
    rows: list[tuple[Any, ...]] = []
    for p in (p for p in payloads(placed) if p in TABLE_1):
        for base in (m for m in ("mlp", "raw") if m in methods(placed)):
            printed, below = TABLE_1[p][0], TABLE_1[p][TABLE_1_METHODS[base]]
            rows.append((
                f"{p:g} kg, of {title(base)}", *(a / b for a, b in zip(printed, below, strict=True)),
                *(delivery.axis(placed, m, p, a) / delivery.axis(placed, base, p, a) for m in shown for a in range(3)),
            ))  # fmt: skip
    columns = ("payload", *(f"{who}: {a}" for who in ("the paper", *map(title, shown)) for a in AXES))
    caption = (
        "Mean |offset| along an axis as a share of that of the MLP and of raw targets. The paper's text claims 0.6 in "
        "X and Y and 0.3 in Z against the MLP; its own table gives the shares in the first columns."
    )
    return ResultTable("ratios", columns, tuple(rows), caption)


def table_2(found: Found, study: Study, *extra: Setting) -> ResultTable:
    """Table 2 of the paper with the rows of one network, and the paper's row behind each."""
    masses = sorted({e.meta.payload_mass for e in study.data.entries})
    columns = ("setting", "Obs Dim", *(f"{m:g} kg" for m in masses), "eight joints", "of nominal", "the paper")
    rows = [_row(found, study, masses, row) for row in (*settings(study), *extra) if found.of_word(row[2])]
    kind = "gaponet" if study.config.model.payload_input else FORM
    caption = (
        f"{title(kind)}: MPJAE in mrad of held-out motions in whole-motion free run, ± std over seeds. Eight joints: "
        "without wrists, all payloads. The paper: Obs Dim, then mrad at 0, 1, 2 and 3 kg. Its action duration stands "
        "twice: correction held, sensors held."
    )
    return ResultTable(f"table2_{kind}", columns, tuple(rows), caption)


def _row(found: Found, study: Study, masses: list[float], setting: Setting) -> tuple[Any, ...]:
    comparison, name, word, printed = setting
    runs, n = found.of_word(word), len(study.robot.operated)
    nominal = found.base("nominal", "known", "mpjae", word=word, scale=1).mean
    return (
        f"{comparison}: {name}",
        study.variant(word).config.model.observation_dim(n),
        *(spread(runs, "known", "by_payload", f"{m:g}", "mpjae") for m in masses),
        spread(runs, "known", "mpjae_no_wrist"),
        MeanStd.from_values([run["known"]["mpjae"] / nominal for run in runs]),
        f"{printed.obs_dim}: {' '.join(f'{v * 1e3:.0f}' for v in printed.mpjae)}" if printed else "",
    )

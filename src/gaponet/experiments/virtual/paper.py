"""All figures and tables of the GAPONet paper, for its network and for ours, beside the printed numbers."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from gaponet.base.errors import UsageError
from gaponet.base.result_table import MeanStd, ResultTable
from gaponet.data.paper_counts import PAPER, count_as_paper, table_beside_paper
from gaponet.data.store import Dataset
from gaponet.experiments.cells import Cell
from gaponet.experiments.outcomes import StudyOutcomes, summarize
from gaponet.experiments.result import Result
from gaponet.experiments.study import DEFAULT_MODELS, QUICK_BUDGET, Study, control_rates
from gaponet.experiments.virtual import delivery, tracking
from gaponet.experiments.virtual.delivery import HoldError
from gaponet.experiments.virtual.play import Progress
from gaponet.experiments.virtual.session import Session, UnitExperiment
from gaponet.experiments.virtual.statistics import methods, over_seeds, payloads, reduction, select
from gaponet.experiments.virtual.tracking import Score
from gaponet.report.methods import title

# Numbers printed in the paper, whose robots are real.
PAYLOADS = PAPER.payloads_kg  # kg per hand
# Its claims: reduction of the error, %.
CLAIMS = {"Q_dis, all payloads": 40, "Q_dis, heaviest payload": 50, "X": 40, "Y": 40, "Z": 70}


@dataclass(frozen=True)
class Printed:
    """A row of Table 2: number of observed values, and MPJAE in rad by payload."""

    obs_dim: int
    mpjae: tuple[float, float, float, float]


# The paper's own setting, without payload input, is a row of five comparisons.
OWN = Printed(140, (0.013, 0.012, 0.013, 0.015))
# Comparison → (setting, change in the syntax of experiments/variant.py, printed row).
TABLE_2: dict[str, tuple[tuple[str, str, Printed | None], ...]] = {
    "payload input": (
        ("in", "payload_input=on", Printed(141, (0.016, 0.017, 0.018, 0.019))),
        ("in, predictor alone", "payload_input=on:payload_trunk=off", None),
        ("out", "", OWN),
    ),
    "control rate": (
        ("50 Hz", "", OWN),
        ("100 Hz", "rates=100", Printed(140, (0.019, 0.019, 0.023, 0.021))),
    ),
    "history H": (
        ("2", "history=2", Printed(80, (0.016, 0.016, 0.017, 0.019))),
        ("4", "", OWN),
        ("6", "history=6", Printed(200, (0.015, 0.016, 0.016, 0.019))),
        ("8", "history=8", Printed(260, (0.017, 0.017, 0.018, 0.021))),
    ),
    "action duration": (
        ("1 period", "", OWN),
        ("3 periods, correction held", "delta_hold=3", Printed(140, (0.017, 0.016, 0.017, 0.018))),
        ("5 periods, correction held", "delta_hold=5", Printed(140, (0.015, 0.016, 0.017, 0.019))),
        ("3 periods, sensors held", "sensor_hold=3", Printed(140, (0.017, 0.016, 0.017, 0.018))),
        ("5 periods, sensors held", "sensor_hold=5", Printed(140, (0.015, 0.016, 0.017, 0.019))),
    ),
    "sensor value": (
        ("S(t+1) − S(t)", "", OWN),
        ("S(t+1)", "sensor_target=absolute", Printed(140, (0.016, 0.017, 0.018, 0.020))),
    ),
}

PAPER_MODEL = "paper"  # the paper's network in its own setting
SUPERVISED = (
    f"{PAPER_MODEL}:payload_input=off:pretraining.rounds=2"  # the same, trained as by gaponet train
)
LEARNED = ("mlp", PAPER_MODEL, "gaponet")
AXES = delivery.AXES
RECIPES = {"paper": "PPO alone", "labels": "supervised labels, then PPO"}
# Comparisons of Table 2 that our network supports: change of the paper's network → of ours, which observes the payload.
OUR_SETTINGS: dict[str, dict[str, str | None]] = {
    "payload input": {
        "payload_input=on": "",
        "payload_input=on:payload_trunk=off": None,
        "": "payload_input=off",
    },
    "control rate": {},
    "history H": {},
}
QUICK_MOTIONS, QUICK_GOALS = 4, 10


@dataclass(frozen=True)
class Paper(UnitExperiment):
    """All figures and tables of the GAPONet paper: data, Figures 2 and 3, Tables 1 and 2, for its network and ours.

    Of real recordings: the data, Figure 2, alignment and Table 2. The same command continues interrupted trainings.
    About one night on two cores.
    """

    recipe: Literal["paper", "labels"] = "paper"
    """How the paper's network is trained. paper: PPO from an untrained network. labels: as gaponet train does."""
    paper_budget: str = "1000000"
    """Control steps of each training of the paper's network."""
    count: int = 10
    """Motions of Figure 3, made for the experiment."""
    goals: int = 100
    """Goals of Table 1, per payload."""

    def require(self, data: Dataset) -> None:
        """Refuse given runs, since rows of Table 2 must differ in one setting alone."""
        if self.runs:
            raise UsageError("--runs: experiment paper trains all its models; leave --runs out")

    def quick(self) -> Paper:
        """Return the experiment with few motions and the budget of a quick run."""
        return replace(self, count=QUICK_MOTIONS, goals=QUICK_GOALS, paper_budget=QUICK_BUDGET)

    def paper_study(self, study: Study) -> Study:
        """Return the study with the setting and training of the paper."""
        config = study.config.paper_recipe() if self.recipe == "paper" else study.config
        config = replace(config, model=replace(config.model, payload_input=False))
        return replace(study, config=config, budget=self.paper_budget)

    def cells(self, study: Study) -> list[Cell]:
        """Return the models of Figure 3 and Table 1 first, then the rows of Table 2."""
        own = self.paper_study(study)
        theirs = [row.word for row in table_2_rows(own) if row.word != PAPER_MODEL]
        ours = [row.word for row in table_2_rows(study) if row.word not in DEFAULT_MODELS]
        ours += [SUPERVISED] if self.recipe == "paper" else []
        return [*own.cells([PAPER_MODEL]), *study.cells(DEFAULT_MODELS), *own.cells(list(dict.fromkeys(theirs))),
                *study.cells(list(dict.fromkeys(ours)))]  # fmt: skip

    def evaluated(self, cells: ListOf[Cell]) -> tuple[Path, ...]:
        """Return the models in their own settings."""
        return tuple(c.folder for c in cells if c.variant.name in (PAPER_MODEL, *DEFAULT_MODELS))

    def run(self, session: Session, progress: Progress) -> Result:
        """Return all figures and tables in the paper's order."""
        from gaponet.report.figures.dataset_figures import draw_figures  # needs the extra "report"

        assert session.study is not None
        study, data, robot = session.study, session.data, session.robot
        figures, _ = draw_figures(data, robot)
        scores, _ = tracking.Tracking(count=self.count).measure(session, progress)
        virtual = any(e.meta.virtual for e in data.entries)
        errors, facts = list[HoldError](), dict[str, Any]()
        if virtual:
            errors, facts = delivery.Delivery(goals=self.goals).measure(session, progress)
            facts = {"config": facts["config"]}
            figures["offsets"] = delivery.draw_offsets(errors)
        joints = tracking.joint_sets(robot)
        source = "VIRTUAL robot" if virtual else "real robot"
        figures["joints"] = tracking.draw_joints(scores, robot, source)
        parts = list(dict.fromkeys(s.part for s in scores))
        outcomes = StudyOutcomes.read(session.cells, study)
        own = self.paper_study(study)
        supervised = Table2Row("training", RECIPES["labels"], SUPERVISED, None)
        tables = [table_beside_paper(count_as_paper(data)), claim_table(scores, errors, joints[0])]
        tables += [tracking.by_payload(scores, part, joints) for part in parts]
        tables += (
            [f(errors) for f in (delivery.paper_table, delivery.offset_table)] if virtual else []
        )
        tables += [table_2(outcomes, own, supervised), table_2(outcomes, study)]
        tables += [replace(tracking.by_joint(scores, part, robot), shown=False) for part in parts]
        heading = f"The GAPONet paper's figures and tables ({source})"
        sentence = f"The paper's network was trained by {RECIPES[self.recipe]}, {own.budget} control steps."
        return session.result("paper", heading, tables, figures, [sentence], **facts)


@dataclass(frozen=True)
class Table2Row:
    """A row of Table 2: comparison, setting, model word (experiments/variant.py), printed row."""

    comparison: str
    setting: str
    word: str
    printed: Printed | None


def table_2_rows(study: Study) -> list[Table2Row]:
    """Return the rows of Table 2 that the dataset allows.

    They are of the paper's network if the study's models do not observe the payload, and of ours otherwise.
    """
    allowed = {"payload input": len({e.meta.payload_mass for e in study.data.entries}) > 1,
               "control rate": len(control_rates(study.data)) > 1}  # fmt: skip
    own = not study.config.model.payload_input
    kind = PAPER_MODEL if own else "gaponet"
    allowed_rows: list[Table2Row] = []
    for comparison, rows in TABLE_2.items():
        if not allowed.get(comparison, True) or not (own or comparison in OUR_SETTINGS):
            continue
        for setting, change, printed in rows:
            changes = change if own else OUR_SETTINGS[comparison].get(change, change)
            if changes is not None:
                allowed_rows.append(
                    Table2Row(
                        comparison, setting, f"{kind}:{changes}" if changes else kind, printed
                    )
                )
    return allowed_rows


def claim_table(
    scores: ListOf[Score], errors: ListOf[HoldError], joints: tracking.JointSet
) -> ResultTable:
    """The paper's claims, and the same reduction of the error by each model here, %."""
    learned = [m for m in LEARNED if m in methods(scores)]
    rows: list[tuple[Any, ...]] = []

    def reductions(
        measured: ListOf[Any], base: float, value: Callable[[Any], float]
    ) -> list[MeanStd]:
        return [
            over_seeds(select(measured, m), lambda one: reduction(value(one), base))
            for m in learned
        ]

    for part in dict.fromkeys(s.part for s in scores):
        of_part, base = [s for s in scores if s.part == part], tracking.BASELINE[part]
        for name, mass in (
            ("Q_dis, all payloads", None),
            ("Q_dis, heaviest payload", payloads(of_part)[-1]),
        ):
            group = select(of_part, payload=mass)
            error = tracking.q_dis(group, base, joints[1]).mean
            values = reductions(group, error, lambda s: float(s.q_dis[joints[1]].mean()))
            rows.append((f"{part}: {name}, less than {title(base)}", CLAIMS[name], *values))
    heavy = payloads(errors)[-1:]
    for a, axis in enumerate(AXES if heavy and "mlp" in methods(errors) else ()):
        error = delivery.mean_offset(errors, "mlp", heavy[0], a)
        along: Callable[[HoldError], float] = lambda e, a=a: float(e.offset[a])  # type: ignore[misc]  # noqa: E731
        values = reductions(select(errors, payload=heavy[0]), error, along)
        rows.append(
            (
                f"delivery: {axis} at {heavy[0]:g} kg, less than {title('mlp')}",
                CLAIMS[axis],
                *values,
            )
        )
    caption = (
        f"Per cent less error, mean ± std over seeds; Q_dis of {joints[0]}. The paper says Q_dis once of simulator and "
        "robot (alignment) and once of target and robot (compensation)."
    )
    return ResultTable(
        "claims",
        ("claim", "the paper, %", *(f"{title(m)}, %" for m in learned)),
        tuple(rows),
        caption,
        0,
    )


def table_2(outcomes: StudyOutcomes, study: Study, *extra: Table2Row) -> ResultTable:
    """Table 2 of the paper with the rows of one network, and the paper's row behind each."""
    masses = sorted({e.meta.payload_mass for e in study.data.entries})
    columns = (
        "setting",
        "Obs Dim",
        *(f"{m:g} kg" for m in masses),
        "eight joints",
        "of nominal",
        "the paper",
    )
    rows = []
    for row in (*table_2_rows(study), *extra):
        if runs := outcomes.of_model(row.word):
            printed = row.printed
            nominal = summarize(
                [outcomes.baselines(row.word)["nominal"]], "known", "mpjae", scale=1
            ).mean
            rows.append((
                f"{row.comparison}: {row.setting}",
                study.variant(row.word).config.model.observation_dim(len(study.robot.operated)),
                *(summarize(runs, "known", "by_payload", f"{m:g}", "mpjae") for m in masses),
                summarize(runs, "known", "mpjae_no_wrist"),
                MeanStd.from_values([run["known"]["mpjae"] / nominal for run in runs]),
                printed and f"{printed.obs_dim}: {' '.join(f'{v * 1e3:.0f}' for v in printed.mpjae)}",
            ))  # fmt: skip
    kind = "gaponet" if study.config.model.payload_input else PAPER_MODEL
    caption = (
        f"{title(kind)}: MPJAE in mrad of test motions in open-loop rollouts of whole motions, ± std over seeds. Eight "
        "joints: without wrists, all payloads. The paper: Obs Dim, then mrad at 0, 1, 2 and 3 kg. Its action "
        "duration is there twice: correction held, sensors held."
    )
    return ResultTable(f"table2_{kind}", columns, tuple(rows), caption)

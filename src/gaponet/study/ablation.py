"""Table 2 of the paper and switches of our own: what each choice of the operator is worth, one changed at a time.

A setting that is the default is the default's own cells, trained once, in whatever row it stands.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gaponet.plot.charts import dots
from gaponet.plot.table import Spread, Table, compared_by_seed
from gaponet.study.found import Found, spread
from gaponet.study.pool import Cell
from gaponet.study.result import Result
from gaponet.study.study import Study, rates_of
from gaponet.study.variant import parse_variant
from gaponet.training.config import TrainConfig

DEFAULT = "gaponet"
COLD = "warm_start.rounds=0"

WIDE = "branch_hidden=128,128:trunk_hidden=64,64:sensor_hidden=256,256"
PAPER_SIZE = "coupling=full:branch_hidden=256,256,256:trunk_hidden=128,128,128:sensor_hidden=256,256"

# Table 2(a) of the paper, smallest and largest error over its rows, unit not known here, nor any other of its numbers.
# The paper's own model ("Ours") is the row without payload and with H = 4.
PAPER = {"payload_input=on": (0.016, 0.019), "payload_input=off": (0.012, 0.015)}

FACTORS: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = (
    ("payload input", (("in", "payload_input=on"), ("out", "payload_input=off"))),
    ("history H", tuple((f"{h}", f"history={h}") for h in (2, 4, 6, 8))),
    ("correction held", tuple((f"{k} period{'s' * (k > 1)}", f"delta_hold={k}") for k in (1, 3, 5))),
    ("sensors held", tuple((f"{k} period{'s' * (k > 1)}", f"sensor_hold={k}") for k in (1, 3, 5))),
    ("sensor target", (("S′ − S", "sensor_target=delta"), ("S′", "sensor_target=absolute"))),
    ("sensors", tuple((s, f"sensors={s}") for s in ("predicted", "off", "oracle", "learned"))),
    ("branch", tuple((s, f"branch={s}") for s in ("unstacked", "stacked"))),
    ("basis functions p", tuple((f"{p}", f"num_basis={p}") for p in (4, 16, 64))),
    ("probes m", tuple((f"{m}", f"num_probes={m}") for m in (10, 20, 40))),
    ("network", (("narrow", ""), ("twice as wide", WIDE), ("the paper's, full coupling", PAPER_SIZE))),
    ("warm start", (("on", ""), ("off, PPO alone", COLD))),
    ("correction limit", tuple((f"{d:g} rad", f"delta_max={d:g}") for d in (0.1, 0.3, 0.6))),
)


Seeds = dict[str, dict[int, float]]  # word → seed → MPJAE of nominal


@dataclass(frozen=True)
class Setting:
    """A line of the table."""

    factor: str
    setting: str
    word: str
    """The word that study.variant reads; DEFAULT where the setting is the default's."""
    paper: tuple[float, float] | None = None


def rows(study: Study) -> tuple[list[Setting], list[str]]:
    """All lines that the dataset allows, and why others are missing."""
    config, factors, missing = study.config, list(FACTORS), []
    if len({e.meta.payload_mass for e in study.data.entries}) < 2:
        factors.pop(0)
        missing.append("Payload input was not compared: the dataset holds one payload.")
    rates = rates_of(study.data)
    if len(rates) > 1:
        slow, fast = f"{rates[0]:g}", f"{rates[-1]:g}"
        window = round(config.model.history * rates[-1] / rates[0])
        factors.insert(1, ("control rate", (
            (f"{slow} Hz", f"rates={slow}"), (f"{fast} Hz, equal H", f"rates={fast}"),
            (f"{fast} Hz, equal window", f"rates={fast}:history={window}"),
        )))  # fmt: skip
    else:
        missing.append(f"Control rates were not compared: the dataset holds {rates[0]:g} Hz alone.")
    found = []
    for factor, settings in factors:
        for setting, change in settings:
            found.append(Setting(factor, setting, _word(change, config), PAPER.get(change)))
    return found, missing


def _word(change: str, config: TrainConfig) -> str:
    """The change as a word, or DEFAULT where it changes nothing."""
    word = f"{DEFAULT}:{change}" if change else DEFAULT
    same = parse_variant(word, config).config == parse_variant(DEFAULT, config).config
    return DEFAULT if same else word


@dataclass(frozen=True)
class Ablation:
    """Table 2 of the paper and our own switches: what each choice of the operator is worth, one changed at a time.

    The same command again goes on where it was. About an hour and a half on two cores; --quick in under five minutes.
    """

    bound_seeds: int = 1
    """Seeds of oracle and learned sensors, for which the simulator itself is asked: ten times as long. 0, or --quick,
    leaves them out."""
    holdout_units: tuple[str, ...] = ()
    """Units never trained on; shown in a column of their own."""

    def cells(self, study: Study) -> list[Cell]:
        """One for each distinct setting and seed; fewer seeds where the simulator itself answers."""
        words = list(dict.fromkeys([DEFAULT, *(r.word for r in rows(study)[0])]))
        bound = [w for w in words if study.variant(w).config.model.asks_simulator]
        made = study.cells([w for w in words if w not in bound])
        seeds = 0 if study.rehearsal else min(self.bound_seeds, study.seeds)
        return made + (study.cells(bound, seeds) if bound and seeds else [])

    def result(self, study: Study, found: Found) -> Result:
        lines, missing = rows(study)
        if study.rehearsal or not self.bound_seeds:
            missing.append("Oracle and learned sensors were left out (--bound-seeds 0, --quick).")
        seeds = {
            word: {run["seed"]: run["known"]["mpjae"] / nominal for run in runs}
            for (word, _), runs in found.runs.items()
            for nominal in (found.base("nominal", "known", "mpjae", word=word, scale=1).mean,)
        }
        default = Spread.of([1.0])
        worth = {w: default if w == DEFAULT else _paired(seeds, w, DEFAULT) for w in seeds}
        figure = dots(
            [(r.factor, r.setting, worth[r.word], r.word == DEFAULT) for r in lines
             if r.word in worth and DEFAULT in seeds],
            "MPJAE of the default's with the same seed", f"What each choice is worth\n{study.who}",
        )  # fmt: skip
        table = _table(lines, found, seeds, worth)
        said = [*_sentences(lines, seeds, worth), *missing]
        return found.result(study, "ablation", "Ablation of the operator", [table], {"ablation": figure}, said)


def _table(lines: list[Setting], found: Found, seeds: Seeds, worth: Mapping[str, Spread]) -> Table:
    new = any("new" in f for part in found.runs.values() for f in part)
    table: list[tuple[Any, ...]] = []
    for row in lines:
        cells = found.of_word(row.word)
        table.append((
            f"{row.factor}: {row.setting}{' (default)' if row.word == DEFAULT else ''}",
            spread(cells, "known", "mpjae"), Spread.of(seeds[row.word].values()) if cells else None,
            worth[row.word] if cells and row.word != DEFAULT else None, spread(cells, "known", "q_dis"),
            *([spread(cells, "new", "mpjae")] * new), cells[0]["parameters"] if cells else None,
            spread(cells, "seconds", scale=1 / 60).mean if cells else None,
            f"{row.paper[0]:g} to {row.paper[1]:g}" if row.paper else None,
        ))  # fmt: skip
    columns = ("choice", "MPJAE, mrad", "of nominal", "of default, by seed", "Q_dis, mrad·s",
               *(["new unit, mrad"] * new), "weights", "minutes", "paper")  # fmt: skip
    caption = (
        "MPJAE: mean over joints and held-out motions of the whole-motion free run, mean ± std over seeds; of nominal: "
        "on the same motions at the same rate; of default: the ratio of both with the same seed, which does not "
        "contain what a seed does to both. All with the same training budget. paper: range of its Table 2(a), unit "
        "not known here; blank where no number of it is. Oracle and learned sensors ask the simulator itself, which "
        "no robot can."
    )
    return Table("table2", columns, tuple(table), caption)


def _paired(seeds: Seeds, word: str, other: str) -> Spread:
    """The ratio of two settings, seed by seed: both have drawn the same states and start weights."""
    a, b = seeds[word], seeds.get(other, {})
    return Spread.of([a[seed] / b[seed] for seed in a if seed in b])


def _sentences(lines: list[Setting], seeds: Seeds, worth: Mapping[str, Spread]) -> list[str]:
    """The best and the worst of each choice against the default, and where the paper found otherwise."""
    if DEFAULT not in seeds:
        return []
    out = [f"The default leaves {Spread.of(seeds[DEFAULT].values()).mean:.2f} of the nominal error."]
    for factor in dict.fromkeys(r.factor for r in lines):
        by = {r.setting: worth[r.word] for r in lines if r.factor == factor and r.word in seeds and r.word != DEFAULT}
        if by:
            ends = dict.fromkeys([min(by, key=lambda s: by[s].mean), max(by, key=lambda s: by[s].mean)])
            out.append(f"{factor}: {'; '.join(compared_by_seed(s, by[s], 'the default') for s in ends)}.")
    return [*out, *_against_paper(lines, seeds)]


def _against_paper(lines: list[Setting], seeds: Seeds) -> list[str]:
    """Pairs of settings that the paper orders, beside our order."""
    known = [(r, r.paper) for r in lines if r.paper and r.word in seeds]
    out = []
    for i, (a, first) in enumerate(known):
        for b, second in known[i + 1 :]:
            if a.factor != b.factor:
                continue
            (low, less), (high, more) = sorted([(a, first), (b, second)], key=lambda pair: pair[1])
            change = _paired(seeds, high.word, low.word)
            if abs(change.mean - 1) <= 2 * change.error:
                verdict = "finds no difference beyond the seeds'"
            else:
                verdict = "agrees" if change.mean > 1 else "disagrees"
            out.append(
                f"{a.factor}: the paper has less error with '{low.setting}' ({less[0]:g} to {less[1]:g}) than with "
                f"'{high.setting}' ({more[0]:g} to {more[1]:g}); this run {verdict} "
                f"({_left(seeds, low):.2f} against {_left(seeds, high):.2f} of nominal)."
            )
    return out


def _left(seeds: Seeds, row: Setting) -> float:
    return Spread.of(seeds[row.word].values()).mean

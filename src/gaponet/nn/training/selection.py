"""Choice of the network by validation: each kind is trained with a part of the budget, and the
best gets the rest.

Trees need no more than their part. If they are best, the best network gets the rest, and validation
decides again.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gaponet.base.errors import ModelError, UsageError
from gaponet.base.files import FOLDER_MARKER, whole_folder, write_json
from gaponet.base.structure import read_json
from gaponet.nn.artifact import GapModel
from gaponet.nn.config import ModelKind
from gaponet.nn.training.checkpoint import CHECKPOINT
from gaponet.nn.trees import trees_available

# Trees are a candidate if scikit-learn is installed.
CANDIDATES: tuple[ModelKind, ...] = ("gaponet", "shared_mlp", "mlp", "trees")
SHARE = 0.2  # of the budget, for each candidate
FOLDER = "candidates"
ERRORS = "candidates.json"
# Arguments: kind, run, share of the budget, share spent, resume.
Train = Callable[[ModelKind, Path, float, float, bool], GapModel]


def train_best(out: Path, resume: bool, train: Train) -> GapModel:
    """Train each candidate in OUT/candidates, copy the run with the least validation error to OUT,
    and go on with it.

    OUT/candidates.json has the validation error of each candidate, rad.

    Raises:
        UsageError: OUT holds a run and resume is false, or no run and resume is true.
    """
    present = _kind(out)
    begun = (out / FOLDER).is_dir()
    _require_begun_if_resumed(out, resume, begun or present is not None)
    if present and not begun:
        return train(present, out, 1.0, 0.0, True)
    kinds = [kind for kind in CANDIDATES if kind != "trees" or trees_available()]
    known = candidate_errors(out)
    errors, interrupted = _train_candidates(out, kinds, train)
    if interrupted:
        best_so_far = interrupted
        if errors:
            best_so_far = _best(errors)
        _copy(out, best_so_far)
        return GapModel.load(out)
    best = _best(errors)
    if _kind(out) != best or best not in known:
        # OUT holds nothing, another candidate, or this one as it was when it was interrupted. Else
        # OUT holds the best candidate and may have gone on with it.
        _copy(out, best)
    return _go_on_with_best(out, errors, SHARE * (len(kinds) - 1), train)


def _require_begun_if_resumed(out: Path, resume: bool, begun: bool) -> None:
    """Refuse to resume nothing, or to begin anew where a run is."""
    if resume and not begun:
        raise UsageError(
            f"{out}: nothing to resume; train without --resume, or choose another --out"
        )
    if begun and not resume:
        raise UsageError(f"{out}: holds a run already; add --resume, or choose another --out")


def _go_on_with_best(
    out: Path, errors: dict[ModelKind, float], spent: float, train: Train
) -> GapModel:
    """Train the best candidate, which OUT holds, with the rest of the budget.

    If that is the trees, the best network gets the rest, and the better of the two is the result.

    Args:
        errors: Validation errors of all candidates, rad.
        spent: Share of the budget that the other candidates took.
    """
    best = _best(errors)
    if best != "trees":
        return train(best, out, 1 - spent, spent, True)
    best_network = _best({kind: error for kind, error in errors.items() if kind != "trees"})
    model = train(best_network, out / FOLDER / best_network, 1 - spent, spent, True)
    if _validation_error(model) < errors["trees"]:
        _copy(out, best_network)
    return GapModel.load(out)


def _train_candidates(
    out: Path, kinds: list[ModelKind], train: Train
) -> tuple[dict[ModelKind, float], ModelKind | None]:
    """Train the candidates that have no validation error yet.

    Returns:
        Validation errors, rad, and the kind whose training was interrupted, or None.
    """
    errors = candidate_errors(out)
    for i, kind in enumerate(kinds):
        if kind in errors:
            continue
        run = out / FOLDER / kind
        was_interrupted = (run / CHECKPOINT).is_file()
        model = train(kind, run, SHARE, i * SHARE, was_interrupted)
        if model.card["interrupted"]:
            return errors, kind
        errors[kind] = _validation_error(model)
        write_json(out / ERRORS, errors)
    return errors, None


def _best(errors: dict[ModelKind, float]) -> ModelKind:
    """Return the kind with the least validation error."""
    return min(errors, key=errors.__getitem__)


def _validation_error(model: GapModel) -> float:
    return float(model.card["val_mpjae"]["model"])


def candidate_errors(run: Path) -> dict[ModelKind, float]:
    """Return the validation error of each candidate of a run, rad; empty if one kind was given."""
    if not (run / ERRORS).is_file():
        return {}
    return read_json(dict[ModelKind, float], run / ERRORS, ModelError)


def _kind(run: Path) -> ModelKind | None:
    """Return the kind of network of a run; None if no run is there."""
    if not (run / CHECKPOINT).is_file():
        return None
    config = read_json(dict[str, Any], run / "config.json", ModelError)
    kind: ModelKind = config["model"]["kind"]
    return kind


def _copy(out: Path, kind: ModelKind) -> None:
    """Put the run of a candidate in the place of OUT's own, all of it or nothing."""
    source = out / FOLDER / kind
    markers = shutil.ignore_patterns(FOLDER_MARKER + "*")
    with whole_folder(out, "run", last=CHECKPOINT) as place:
        shutil.copytree(source, place, dirs_exist_ok=True, ignore=markers)

"""A part that is done is not done again, and comes back as it was."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from gaponet.experiments.played.kept import KeptParts, revived


@dataclass(frozen=True)
class Row:
    name: str
    seed: int | None
    value: float
    where: np.ndarray


def test_a_part_is_made_once_for_the_same_facts(tmp_path):
    made = []

    def make():
        made.append(1)
        return {"rows": [Row("a", None, np.nan, np.arange(3.0)), Row("b", 1, 0.25, np.zeros(2, np.float32))]}

    kept = KeptParts(tmp_path / "parts", "robot", np.arange(4.0))
    first, again = kept("gaponet", 0, make=make), kept("gaponet", 0, make=make)
    assert len(made) == 1
    assert first == again
    KeptParts(tmp_path / "parts", "robot", np.arange(4.0) + 1e-6)("gaponet", 0, make=make)
    kept("gaponet", 1, make=make)
    assert len(made) == 3

    a, b = (revived(Row, r) for r in again["rows"])
    assert (a.name, a.seed, b.seed, b.value) == ("a", None, 1, 0.25)
    assert np.isnan(a.value)
    np.testing.assert_array_equal(a.where, [0.0, 1.0, 2.0])


def test_what_failed_is_not_kept(tmp_path):
    def fails():
        raise KeyboardInterrupt

    kept = KeptParts(tmp_path)
    with suppress(KeyboardInterrupt):
        kept("x", make=fails)
    assert kept("x", make=lambda: {"ok": True}) == {"ok": True}
    assert [f.suffix for f in tmp_path.iterdir()] == [".json"]

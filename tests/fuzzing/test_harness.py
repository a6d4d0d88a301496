"""The fuzzer sees what may never happen when it happens."""

import os
import random
import signal
import time
from pathlib import Path

import pytest

from fuzzing import harness
from fuzzing.harness import AbsurdError, Target, run
from fuzzing.mutate import mutate
from gaponet.base.errors import LogError


def refuse(source: Path, out: Path) -> None:
    if (source / "a.csv").read_bytes() != b"time\n1\n2\n":
        raise LogError("a.csv: changed; do not")


def only_when_changed(then):
    """A reader with a fault that the untouched file does not show."""

    def use(source: Path, out: Path) -> None:
        try:
            refuse(source, out)
        except (LogError, OSError):
            then(source, out)

    return use


def fail(error: Exception, *words: str) -> None:
    error.args = words or error.args
    raise error


def absurd(source: Path, out: Path) -> None:
    raise AbsurdError("1e30 rad")


FAULTS = {
    "traceback": lambda source, out: [][0],
    "traceback: not one line": lambda source, out: fail(LogError(""), "bad\nfile"),
    "absurd": absurd,
    "memory": lambda source, out: bytearray(harness.MEMORY + (1 << 28)),
    "outside": lambda source, out: (source.parent / "mine.txt").write_text("x"),
    "died": lambda source, out: os.kill(os.getpid(), signal.SIGKILL),
    "hang": lambda source, out: time.sleep(60),
}


def target(use, name="t"):
    return Target(name, lambda: {"a.csv": b"time\n1\n2\n"}, use)


@pytest.mark.parametrize("kind", FAULTS)
def test_each_kind_of_fault_is_seen_and_its_mutant_named(kind, monkeypatch):
    monkeypatch.setattr(harness, "HANG_S", 0.1)
    result = run([target(only_when_changed(FAULTS[kind]))], 3)
    assert result.mutants == 3
    assert {f.kind for f in result.failures} == {kind.partition(":")[0]}
    assert len(result.failures) + result.taken == 3  # a change may change nothing


def test_a_clear_refusal_is_no_fault_and_used_up_workers_are_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr(harness, "RENEW", 4)

    def use(source: Path, out: Path) -> None:
        out.mkdir()
        (out / "kept").write_text("x")
        if (source / "a.csv").is_file():
            refuse(source, out)

    result = run([target(use)], 30, workers=2, keep=tmp_path / "keep")
    assert result.failures == []
    assert (result.mutants, result.refused + result.taken) == (30, 30)
    assert not (tmp_path / "keep").exists()


def test_a_mutant_is_made_again_from_its_number(tmp_path):
    files = {"a.csv": b"time,x\n1,2\n3,4\n", "b.json": b'{"a": [1, 2, {"c": null}]}'}
    again = [mutate(files, random.Random("0 t 5")) for _ in range(2)]
    assert again[0] == again[1]
    assert sum(mutate(files, random.Random(f"0 t {n}")) != files for n in range(100)) > 90


def test_failed_mutants_are_kept_to_be_looked_at(tmp_path):
    result = run([target(only_when_changed(absurd))], 2, keep=tmp_path)
    kept = sorted(p.name for p in tmp_path.iterdir())
    assert kept == sorted(f"absurd-t-{f.number}" for f in result.failures)
    assert (tmp_path / kept[0] / "WHY.txt").read_text() == "1e30 rad"

"""Curves elsewhere say what progress.jsonl says."""

import sys
from types import SimpleNamespace

import pytest

from gaponet.base.errors import UsageError
from gaponet.nn.training.run_folder import Loggers

LINE = {
    "stage": "ppo",
    "steps": 640,
    "seconds": 2.5,
    "reward": float("nan"),
    "val_mpjae": 0.004,
    "nominal_mpjae": 0.01,
}


def test_event_files_hold_the_numbers_of_progress(tmp_path):
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    log = Loggers(("tensorboard",), tmp_path, {})
    log.write(LINE)
    log.close()
    read = events.EventAccumulator(str(tmp_path / "tensorboard"))
    read.Reload()
    assert set(read.Tags()["scalars"]) == {"seconds", "val_mpjae", "nominal_mpjae"}
    (point,) = read.Scalars("val_mpjae")
    assert (point.step, point.value) == (640, pytest.approx(0.004))


def test_wandb_gets_the_same(tmp_path, monkeypatch):
    got = []
    run = SimpleNamespace(
        log=lambda numbers, step: got.append((numbers, step)), finish=lambda: got.append("end")
    )
    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=lambda **how: run))
    log = Loggers(("wandb",), tmp_path, {})
    log.write(LINE)
    log.close()
    assert got == [({"seconds": 2.5, "val_mpjae": 0.004, "nominal_mpjae": 0.01}, 640), "end"]


@pytest.mark.parametrize(
    ("kind", "module"), [("tensorboard", "torch.utils.tensorboard"), ("wandb", "wandb")]
)
def test_a_missing_package_is_named(tmp_path, monkeypatch, kind, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match=rf"{kind}$"):
        Loggers((kind,), tmp_path, {})

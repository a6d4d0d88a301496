"""Live targets in real time between processes: half a minute of a sender's whims, then three ways to end a run."""

from __future__ import annotations

import json
import os

import pytest

pytest.importorskip("cyclonedds", reason="pip install 'gaponet[dds]'")
pytest.importorskip("zmq", reason="pip install 'gaponet[zmq]'")

from hw.control.live import play

pytestmark = pytest.mark.faults


def test_whims_are_survived_and_every_way_to_go_wrong_for_good_ends_in_damping():
    found = play(0.5, 20 + os.getpid() % 150, ways=("freeze", "nan", "restart"))
    long = found["long"]
    print(json.dumps({name: long[name] for name in ("targets", "late_ms", "commands", "to_damping_s")}))
    assert found["wrong"] == []
    assert long["survived"] > 5
    assert long["targets"]["taken"] > 1000

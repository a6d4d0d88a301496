"""Live targets in real time between processes: half a minute of a sender's whims, and its death."""

from __future__ import annotations

import json
import os

import pytest

pytest.importorskip("cyclonedds", reason="pip install 'gaponet[dds]'")
pytest.importorskip("zmq", reason="pip install 'gaponet[zmq]'")

from hw.control.live import play

pytestmark = pytest.mark.faults


def test_whims_are_survived_and_the_senders_death_ends_in_damping():
    result = play(0.5, 20 + os.getpid() % 150)
    print(json.dumps({name: result[name] for name in ("targets", "late_ms", "commands", "to_damping_s")}))
    assert result["wrong"] == []
    assert result["survived"] > 5
    assert result["targets"]["taken"] > 1000

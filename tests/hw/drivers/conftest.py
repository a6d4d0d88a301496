"""An SO-101 on a servo bus without time: its servos, the wire and the driver."""

from __future__ import annotations

import pytest
from servos import Servos, Wire

from gaponet.hw.drivers.so101 import SO101Driver
from gaponet.robot.spec import RobotSpec

SILENCE_S = 0.001  # on a wire without time whatever comes is there


@pytest.fixture
def servos() -> Servos:
    return Servos()


@pytest.fixture
def wire(servos: Servos, monkeypatch: pytest.MonkeyPatch) -> Wire:
    serial = pytest.importorskip("serial", reason="pip install 'gaponet[so101]'")
    wire = Wire(servos)
    monkeypatch.setattr(serial, "Serial", lambda *_, **__: wire)
    return wire


@pytest.fixture
def driver(so101: RobotSpec, wire: Wire) -> SO101Driver:
    driver = SO101Driver(so101, timeout=SILENCE_S)
    driver.connect()
    return driver

"""Fixtures shared by all tests."""

import gc
import os
import sys
from collections.abc import Generator
from pathlib import Path

import pytest

if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
    os.environ.setdefault(
        "MUJOCO_GL", "egl"
    )  # before mujoco is imported; tests that render skip where it fails

from arm import write_arm

from gaponet.data.importer import ImportRequest, import_logs
from gaponet.data.store import Dataset
from gaponet.hw.control.clock import SimulatedClock
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model

CLOCK_SEED = "GAPONET_CLOCK_SEED"  # environment variable: repeats the starts of simulated clocks
SimulatedClock.seed = int(os.environ.get(CLOCK_SEED, SimulatedClock.seed))
SHARED = Path(os.environ.get("GAPONET_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Say with a failure at which time the simulated clocks of this process began."""
    report = yield
    if report.failed:
        repeat = f"{CLOCK_SEED}={SimulatedClock.seed} repeats the starts of simulated clocks"
        report.sections.append(("clocks", repeat))
    return report


@pytest.fixture(scope="session", autouse=True)
def no_waiting_for_the_disk() -> Generator[None]:
    """Files of tests need not survive a power failure: a write takes 5 ms less."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(scope="module", autouse=True)
def no_old_garbage() -> None:
    """What is alive when a file begins is no garbage, and is not looked at again.

    A controller collects garbage before each run, and would look at every module for 0.3 s.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture
def tmp_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of the test's own, without the test's name, as pytest's has it.

    Messages name paths: a word that a test expects in one may not stand in its path.
    """
    return tmp_path_factory.mktemp("t")


@pytest.fixture(scope="session")
def so101() -> RobotSpec:
    return load_robot("so101")


@pytest.fixture
def arm(tmp_path: Path) -> RobotSpec:
    """The two-joint arm of tests/arm.py as a user's robot folder."""
    return write_arm(tmp_path / "robots" / "arm")


def public(name: str) -> Path:
    """Return a folder of the public recordings, or skip the test."""
    if not (SHARED / name).is_dir():
        pytest.skip(f"no {name} in {SHARED}; set GAPONET_DATA to the folder that holds it")
    return SHARED / name


@pytest.fixture(scope="session")
def sage_so101() -> Path:
    """The public SO-101 logs: 40 motions of one unit, no payload."""
    return public("sage_so101")


@pytest.fixture(scope="session")
def iit_z1() -> Path:
    """A public recording of a Z1 arm: one chirp."""
    return public("iit_z1")


@pytest.fixture(scope="session")
def paper_network() -> Path:
    """The weights that the paper's authors published, and pairs of inputs and outputs of their
    code.
    """
    return public("paper_network")


@pytest.fixture(scope="session")
def real_dataset(
    sage_so101: Path, so101: RobotSpec, tmp_path_factory: pytest.TempPathFactory
) -> Dataset:
    """The public SO-101 logs, imported once; read only."""
    model = build_model(so101)
    out = tmp_path_factory.mktemp("real") / "so101"
    gravity = lambda qpos, mass, side: static_torque(model, qpos)  # noqa: E731
    return import_logs(
        sage_so101,
        so101,
        out,
        ImportRequest(unit_id="lab", payload_mass=0.0),
        gravity=gravity,
        simulator="nominal",
    ).dataset

"""Executors: a killed worker costs time only; Ray is imported on request."""

import os
import pickle
import shutil
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from importlib.util import find_spec

import pytest
from arm import write_arm
from jobs import dies_at_first

from gaponet.base.errors import UsageError, WorkerError
from gaponet.base.executor import open_pool
from gaponet.cli.main import main
from gaponet.robot.spec import load_robot
from gaponet.sim.model import model_hash


def carried_out(pool, folder, numbers):
    """Outcomes of the jobs, and how many attempts each took."""
    outcomes = {o.job[1]: o for o in pool.run(dies_at_first, ((folder, n) for n in numbers))}
    return outcomes, {n: len(list(folder.glob(f"{n}-*"))) for n in numbers}


def test_the_job_of_a_killed_worker_is_repeated_and_no_other_job(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    with open_pool("local", 2) as pool:
        outcomes, attempts = carried_out(pool, tmp_path, range(8))
        assert list(pool.map(abs, (-3, 2, -1))) == [3, 2, 1]
    assert attempts == {0: 2, 1: 1, 2: 2, 3: 1, 4: 2, 5: 3, 6: 2, 7: 1}
    for n in (0, 1, 2, 3, 4, 6):
        assert outcomes[n].result() == (n**2, "1")
    with pytest.raises(WorkerError, match="memory"):
        outcomes[5].result()
    with pytest.raises(UsageError, match="seven") as refused:
        outcomes[7].result()
    assert "dies_at_first" in refused.value.__notes__[0]
    assert os.environ["OMP_NUM_THREADS"] == "7"


@pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")
def test_ray_repeats_the_job_of_a_killed_worker(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # jobs.py
    with open_pool("ray", 2) as pool:
        outcomes, attempts = carried_out(pool, tmp_path, (0, 1, 7))
    assert attempts == {0: 2, 1: 1, 7: 1}
    assert [outcomes[n].result() for n in (0, 1)] == [(0, "1"), (1, "1")]
    with pytest.raises(UsageError, match="seven"):
        outcomes[7].result()


def test_executors_of_the_standard_library_are_accepted():
    for executor in (ThreadPoolExecutor(2), ProcessPoolExecutor(2)):
        with executor, open_pool(executor, 0) as pool:
            assert list(pool.map(abs, range(-9, 0))) == [*range(9, 0, -1)]


@pytest.mark.parametrize("where", ["dask", "submitit:cluster=local", "slurm", "local:2", object()])
def test_an_unknown_executor_is_refused_with_the_alternatives(where):
    answer = (
        r"--executor .*: choose local, ray or ray:ADDRESS; from Python, give a "
        r"concurrent\.futures\.Executor"
    )
    with pytest.raises(UsageError, match=answer), open_pool(where, 0):
        pass


def test_ray_is_imported_on_request_and_a_missing_ray_is_named(tmp_path, capsys, monkeypatch):
    code = (
        "import sys, gaponet.base.executor, gaponet.experiments.paper.jobs; print('ray' in "
        "sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == "False\n"
    monkeypatch.setitem(sys.modules, "ray", None)
    command = [
        "collect",
        "--robot",
        "so101",
        "--recipe",
        "arm",
        "--executor",
        "ray",
        "--out",
        str(tmp_path / "ray"),
    ]
    assert main(command) == 2
    assert capsys.readouterr().err.endswith(" ray\n")


def test_a_pickled_robot_brings_its_folder(tmp_path):
    robot = write_arm(tmp_path / "here")
    sent = pickle.dumps(robot)
    assert pickle.loads(sent).folder == robot.folder
    shutil.rmtree(robot.folder)
    there = pickle.loads(sent)
    assert there.folder != robot.folder
    assert pickle.loads(sent).folder == there.folder
    assert model_hash(there) == model_hash(load_robot(there.folder))
    assert there.name == robot.name

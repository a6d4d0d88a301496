"""Collecting: complete, virtual on every line, the same on any number of processes and after being
killed.
"""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import fields, replace

import numpy as np
import pytest
from arm import write_arm

from gaponet.base.errors import DatasetError, UsageError
from gaponet.data.store import Dataset
from gaponet.motion.library import Library
from gaponet.motion.recipe import takes
from gaponet.robot.spec import load_robot
from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model, model_hash
from gaponet.virtual.collect import Recipe, collect, load_recipe
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.physics import Physics
from gaponet.virtual.play import equivalent_torque, library

RECIPE = Recipe(
    "test",
    payloads=(0.0, 0.2),
    units=("virtual-2",),
    motions=("steps-elbow", "tour-all-0"),
    rates=(50.0, 25.0),
    repetitions=2,
)


def hashes(folder):
    """What a dataset holds, in the order of its journal: id → hash of the samples."""
    return {entry.id: entry.hash for entry in Dataset(folder).entries}


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("robots") / "arm")


@pytest.fixture(scope="module")
def fleet(spec):
    return load_fleet("easy", spec)


@pytest.fixture(scope="module")
def whole(spec, fleet, tmp_path_factory):
    """The recipe, collected in one go in this process."""
    out = tmp_path_factory.mktemp("collected") / "whole"
    done = collect(spec, fleet, RECIPE, out, seed=5, nproc=1)
    return out, done


def test_every_take_is_there_once(whole):
    out, done = whole
    dataset = Dataset(out)
    assert done.written == len(dataset) == 2 * 2 * 2 * 2
    assert done.hours == pytest.approx(dataset.hours())
    played = set()
    for entry in dataset.entries:
        meta = entry.meta
        played.add((meta.motion, meta.unit_id, meta.payload_mass, entry.dt, meta.repetition))
    assert len(played) == 16


def test_every_recording_and_the_collection_say_virtual(whole):
    out, _ = whole
    for entry in Dataset(out).entries:
        assert entry.meta.virtual
        assert entry.meta.unit_id.startswith("virtual-")
        assert "virtual" in entry.meta.source
    assert json.loads((out / "collect.json").read_text())["virtual"] is True


def test_a_recording_has_every_channel(whole):
    out, _ = whole
    channels = {"ctrl", "qpos", "qvel", "qacc", "tau", "tau_eq", "temperature"}
    assert set(Dataset(out).entries[0].channels) == channels


def test_hidden_numbers_stay_out_of_the_dataset(whole):
    out, _ = whole
    text = (out / "sequences.jsonl").read_text() + (out / "collect.json").read_text()
    # The importer writes its own estimate of a delay.
    names = {f.name for f in fields(Physics)} - {"delay"}
    assert not [name for name in names if f'"{name}"' in text]


def test_a_row_is_the_state_before_its_command(whole, spec):
    """Row convention: the robot stands still under row 0's command, and no motion can come before
    its cause.
    """
    dataset = Dataset(whole[0])
    entry = next(e for e in dataset.entries if e.meta.motion == "steps-elbow" and e.dt == 0.02)
    s = dataset.read(entry)
    column = spec.index(["elbow"])[0]
    motion = Library(spec, 5, 0.2).make("steps-elbow")
    assert np.array_equal(s.ctrl, motion.sample(0.02).astype(np.float32))
    told = int(np.argmax(np.abs(s.ctrl[:, column] - s.ctrl[0, column]) > 1e-3))
    moved = int(np.argmax(np.abs(s.qpos[:, column] - s.qpos[0, column]) > 5e-3))
    assert np.abs(s.qvel[:5, column]).max() < 0.06  # noise
    assert told < moved < told + 15


def test_repetitions_differ_a_little(whole):
    dataset = Dataset(whole[0])
    same = []
    for entry in dataset.entries:
        if (entry.meta.motion, entry.dt, entry.meta.payload_mass) == ("tour-all-0", 0.02, 0.2):
            same.append(dataset.read(entry))
    first, second = same
    assert np.array_equal(first.ctrl, second.ctrl)
    assert not np.array_equal(first.qpos, second.qpos)
    assert np.abs(first.qpos - second.qpos).mean() < 0.01
    assert first.temperature[0, 0] != second.temperature[0, 0]


CHILD = """
import sys
import gaponet.virtual.collect
from gaponet.virtual.collect import Recipe, collect
from gaponet.robot.spec import load_robot
from gaponet.virtual.fleet import load_fleet
if __name__ == "__main__":
    # Four jobs: two are still being played when two are written.
    gaponet.virtual.collect.MIN_TAKES_PER_JOB = 2
    gaponet.virtual.collect.MAX_TAKES_PER_JOB = 2
    robot = load_robot(sys.argv[1])
    motions = ("steps-elbow", "tour-all-0")
    recipe = Recipe("test", (0.0,), ("virtual-2",), motions, (), (50.0, 25.0), 2)
    collect(robot, load_fleet("easy", robot), recipe, sys.argv[2], seed=5, nproc=2)
"""


def test_killed_at_a_random_moment_it_ends_with_the_same_dataset(whole, spec, tmp_path):
    """kill -9 while two processes record and write: nothing is lost, doubled or left lying about.

    The child records half of what `whole` holds, what has no payload.

    benchmarks/kills.py does it to every command.
    """
    recipe = replace(RECIPE, payloads=(0.0,))
    expected = {e.id: e.hash for e in Dataset(whole[0]).entries if e.meta.payload_mass == 0.0}
    out = tmp_path / "killed"
    script = tmp_path / "child.py"
    script.write_text(CHILD)
    command = [sys.executable, str(script), str(spec.mjcf.parent), str(out)]
    child = subprocess.Popen(command, start_new_session=True)
    _wait_for_a_line(out / "sequences.jsonl", child)
    time.sleep(np.random.default_rng().uniform(0, 0.05))  # any moment must do
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    # All of them where this process had to wait for its turn.
    assert 0 < len(Dataset(out)) <= len(expected)
    _wait_for_orphans(child.pid)
    begun = len(Dataset(out))
    done = collect(spec, load_fleet("easy", spec), recipe, out, seed=5, nproc=1)
    assert (done.present, done.written) == (begun, len(expected) - begun)
    assert list(hashes(out).items()) == list(expected.items())
    assert len(list((out / "sequences").glob("*.parquet"))) == len(expected)
    assert not list((out / "sequences").glob(".*"))
    dataset = Dataset(out)
    assert all(dataset.has_replay(entry, model_hash(spec)) for entry in dataset.entries)


def _wait_for_a_line(journal, child):
    """The child has written a recording, or has ended."""
    deadline = time.monotonic() + 600  # on a machine with much other work
    while time.monotonic() < deadline and child.poll() is None:
        if journal.is_file() and journal.read_text().count("\n") >= 1:
            return
        time.sleep(0.005)


def _wait_for_orphans(session):
    """Workers of a killed parent end by themselves within a second."""
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        try:
            os.killpg(session, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    pytest.fail("workers of a killed collect are still alive after 300 s")


def test_a_dataset_keeps_the_robot_with_the_gains_that_its_fleet_sets(spec, fleet, tmp_path):
    firm = replace(fleet, gain_scale=3.0)
    less = replace(RECIPE, motions=("steps-elbow",), rates=(50.0,), repetitions=1)
    collect(spec, firm, less, tmp_path, seed=5, nproc=1)
    kept = load_robot(tmp_path / "robot")
    assert kept.servo.kp.tolist() == list(Dataset(tmp_path).entries[0].meta.kp) == [60.0, 60.0]
    assert collect(kept, firm, less, tmp_path, seed=5, nproc=1).written == 0


def test_what_something_else_collected_is_not_mixed(whole, spec):
    out, _ = whole
    with pytest.raises(DatasetError, match="seed"):
        collect(spec, load_fleet("easy", spec), RECIPE, out, seed=6, nproc=1)
    with pytest.raises(DatasetError, match="shifted"):
        collect(spec, load_fleet("shifted", spec), RECIPE, out, seed=5, nproc=1)


def test_mistakes_in_a_recipe_are_named(spec, fleet, tmp_path):
    with pytest.raises(UsageError, match="big"):
        load_recipe("big")
    with pytest.raises(UsageError, match="reach"):
        collect(spec, fleet, replace(RECIPE, motions=("reach-*",)), tmp_path / "a", nproc=1)
    with pytest.raises(UsageError, match="virtual-9"):
        collect(spec, fleet, replace(RECIPE, units=("virtual-9",)), tmp_path / "a", nproc=1)
    for wrong in ({"repetitions": 0}, {"units": ()}, {"rates": (0.0,)}):
        with pytest.raises(UsageError, match=next(iter(wrong))):
            collect(spec, fleet, replace(RECIPE, **wrong), tmp_path / "a", nproc=1)
    file = tmp_path / "mine.toml"
    file.write_text('motions = ["*"]\npayloads = [0]\nunit = ["virtual-1"]\n')
    with pytest.raises(UsageError, match="missing"):
        load_recipe(file)
    file.write_text('motions = ["*"]\nunits = ["virtual-1"]\n')
    with pytest.raises(UsageError, match="missing"):
        load_recipe(file)


def test_a_recipe_may_play_motion_files(spec, fleet, tmp_path):
    (tmp_path / "swing.txt").write_text(
        "shoulder,elbow\n" + "".join(f"{0.001 * t},{-0.001 * t}\n" for t in range(100))
    )
    (tmp_path / "mine.toml").write_text(
        'files = ["swing.txt"]\npayloads = [0.1]\nunits = ["virtual-1"]\n'
    )
    collect(spec, fleet, load_recipe(tmp_path / "mine.toml"), tmp_path / "out", nproc=1)
    (entry,) = Dataset(tmp_path / "out").entries
    assert entry.meta.motion == "swing"
    (tmp_path / "swing.txt").write_text(
        "shoulder,elbow\n" + "".join(f"{0.002 * t},{-0.001 * t}\n" for t in range(100))
    )
    collect(spec, fleet, load_recipe(tmp_path / "mine.toml"), tmp_path / "new", nproc=1)
    played = []
    for folder in ("out", "new"):
        data = Dataset(tmp_path / folder)
        played.append(float(data.read(data.entries[0]).ctrl[:, 0].max()))
    assert played == pytest.approx([0.099, 0.198], abs=1e-6), "a file that was changed is read"


def test_motions_are_made_once_and_again_where_the_robot_changed(spec):
    recipe = load_recipe("demo")
    made = library(spec, 0, recipe, ())
    assert spec.qpos_range.shape == (2, 2)
    assert library(spec, 0, recipe, ()) is made
    spec.mjcf.write_text(spec.mjcf.read_text().replace('mass="0.3"', 'mass="0.4"'))
    assert library(spec, 0, recipe, ()) is not made
    made = library(spec, 0, recipe, ())
    assert library(spec.with_servo(kp=2 * spec.servo.kp), 0, recipe, ()) is not made


def test_the_whole_simlifter_recipe_is_as_large_as_the_paper_says():
    robot = load_robot("h1_2")
    recipe = load_recipe("simlifter")
    wanted = takes(recipe, Library(robot).names(recipe.variants))
    assert len(wanted) == len(set(wanted)) >= 11198
    assert {t.payload for t in wanted} == {0.0, 1.0, 2.0, 3.0}
    assert {t.rate for t in wanted} == {50.0, 100.0}
    levels = {"all" in t.motion.split("-") for t in wanted}
    assert levels == {True, False}


def test_a_still_recording_needs_its_static_torque(spec):
    model = build_model(spec, 0.2)
    qpos = np.repeat(np.array([[0.4, -0.2]]), 80, axis=0)
    tau, qacc = equivalent_torque(model, qpos, 0.02)
    assert np.allclose(tau, static_torque(model, qpos), atol=1e-6)
    assert np.abs(qacc).max() < 1e-6


def test_the_demo_recipe_can_be_played_by_h1_2():
    robot = load_robot("h1_2")
    recipe = load_recipe("demo")
    library = Library(robot)
    names = {t.motion for t in takes(recipe, library.names(recipe.variants))}
    assert len(names) == 16
    assert all(library.make(name).duration > 4 for name in sorted(names)[:2])

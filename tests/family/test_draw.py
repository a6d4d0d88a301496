"""Simulators drawn from a family: what they are, and labels in them."""

from dataclasses import replace

import numpy as np
import pytest
from arm import commands, record, recordings, write_arm

from gaponet.errors import UsageError
from gaponet.family.draw import Family, Members, load_family
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.model import build_model
from gaponet.training.inverse import MemberLabels, inverse_labels

WIDE = Family(kp=(0.4, 2.6), damping=(0.4, 2.5), frictionloss=(0.0, 4.0), armature=(0.4, 2.5), delay=(0.0, 0.01))


@pytest.fixture
def arm(tmp_path):
    return write_arm(tmp_path / "arm")


def one(**changes):
    """A single member: the nominal simulator but for these."""
    same = {name: np.ones((1, 2)) for name in ("kp", "damping", "frictionloss", "armature")}
    alone = {"mass": np.ones(1), "delay": np.zeros(1), "laden": np.ones(1, bool)}
    return Members(**same | alone | {k: np.full((1, 2) if k in same else 1, v) for k, v in changes.items()})


def batch(arm, members, payload=0.0):
    sim = BatchSim(members.robot(arm), members.conditions([Condition(payload, "both", arm.dt)] * len(members)), 1)
    members.put(sim, arm)
    return sim


def changed(arm, **factors):
    """The same simulator, compiled."""
    model, kp = build_model(arm), factors.pop("kp", 1.0)
    values = {name: x * getattr(model, f"dof_{name}") for name, x in factors.items()}
    return replace(arm, kp=kp * arm.kp, nominal=arm, **values)


def test_members_lie_in_the_family_and_differ():
    members = Members.draw(WIDE, 200, 3, seed=1)
    assert members.kp.min() >= 0.4
    assert members.kp.max() <= 2.6
    assert len(np.unique(members.kp[:, 0])) == 200
    assert members.frictionloss.min() < 0.2
    assert members.frictionloss.max() > 3.5
    assert (members.kp[::2] == members.kp[::2, :1]).all()
    assert (np.ptp(members.kp[1::2], axis=1) > 0).all()
    assert (members.mass == 1).all()
    assert members.laden.all()
    again = Members.draw(WIDE, 200, 3, seed=1)
    assert (again.kp == members.kp).all()
    assert (Members.draw(WIDE, 200, 3, seed=2).kp != members.kp).any()


def test_a_member_moves_as_the_same_simulator_compiled(arm):
    factors = {"kp": 2.0, "damping": 0.5, "frictionloss": 3.0, "armature": 2.0}
    drawn, compiled = batch(arm, one(**factors)), BatchSim(changed(arm, **factors), [Condition(0.0, "both", arm.dt)], 1)
    for sim in (drawn, compiled):
        sim.reset(slice(None), np.array([[0.3, -0.2]]), np.array([[0.0, 0.4]]))
        for _ in range(20):
            sim.step(np.array([[0.6, 0.1]]))
    np.testing.assert_allclose(drawn.qpos, compiled.qpos, atol=2e-4)
    assert np.abs(batch(arm, one()).qpos - drawn.qpos).max() > 0.01


def test_mass_and_payload_of_a_member(arm):
    members = Members.draw(replace(WIDE, mass=(2.0, 2.0), unladen=1.0), 1, 2, 0)
    sim = batch(arm, members, payload=0.2)
    mass = sim.batch.expand("body_mass")[0]
    assert mass.sum() == pytest.approx(2 * 0.5)  # no payload
    laden = batch(arm, one(mass=2.0), payload=0.2)
    assert laden.batch.expand("body_mass")[0].sum() == pytest.approx(2 * 0.5 + 0.2)


@pytest.mark.parametrize("changes", [{"kp": 0.5}, {"frictionloss": 3.0}, {"damping": 2.0, "kp": 1.5}, {"mass": 1.2}])
def test_labels_lead_a_stepped_member_along_the_recording(arm, changes):
    member, recording = one(**changes), record(arm, commands(150, 3), "m", payload=0.2, kp=0.6)
    labels, sim = MemberLabels([recording], arm, member, 0.3), batch(arm, member, payload=0.2)
    error = {}
    for corrected in (True, False):
        sim.reset(slice(None), recording.qpos[None, 20], recording.qvel[None, 20])
        missed = []
        for t in range(20, 130):
            sim.step(recording.ctrl[None, t] + corrected * labels[np.array([t])])
            missed.append(sim.qpos[0] - recording.qpos[t + 1])
        error[corrected] = np.abs(missed).mean()
    assert error[True] < 0.15 * error[False]


def test_labels_of_members_are_those_of_the_compiled_simulators(arm):
    sequences = recordings(arm, count=2, rows=80, kp=0.7)
    factors = {"kp": 1.7, "damping": 0.5, "frictionloss": 2.0, "armature": 0.6}
    labels = MemberLabels(sequences, arm, one(**factors, delay=0.008), 0.3)
    compiled = replace(changed(arm, **factors), delay=np.full(2, 0.008))
    told = np.concatenate([inverse_labels(s, compiled, 0.3) for s in sequences])
    np.testing.assert_allclose([labels[np.array([t])][0] for t in range(160)], told, atol=1e-5)


@pytest.mark.parametrize(
    ("text", "what"),
    [("kp = [2.0, 0.5]", "no range"), ("kp = [0.0, 1.0]", "factor of 0"), ("kd = [1.0, 2.0]", "not a known field"),
     ("kp = 2.0", "kp"), ("delay = [0.0, 5.0]", "delay")],
)  # fmt: skip
def test_a_file_that_is_no_family_is_refused_by_name(tmp_path, text, what):
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(UsageError, match=what) as refused:
        load_family(tmp_path / "mine.toml")
    assert "mine.toml" in str(refused.value)


def test_the_packages_family_is_found_by_name():
    assert load_family("wide").kp[0] < 1 < load_family("wide").kp[1]
    with pytest.raises(UsageError, match="wide"):
        load_family("narrow")

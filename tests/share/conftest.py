"""A dataset to push, and a place for it: a stand-in of the Hub."""

import hashlib
import json
from dataclasses import replace

import pytest
from logs import arm_sequence, late, wave

from gaponet.data.split import make_split, write_split
from gaponet.data.store import Dataset


def add(data, arm, names, **meta):
    """Append motions; of every two one has a payload, and none has the course of an earlier one."""
    for i, name in enumerate(names):
        ctrl = wave(60, 2, hertz=0.3 + 0.11 * i + 0.01 * len(data))
        sequence = arm_sequence(arm, ctrl, late(ctrl, 2), name, 0.1 * (i % 2), tau=2 * ctrl)
        data.append(replace(sequence, meta=replace(sequence.meta, **meta)))


def same(one, other):
    """Whether all samples of all channels, metadata and ids are equal, in any order."""
    bare = lambda data: {e.id: (e, e.meta) for e in data.entries}  # noqa: E731
    assert bare(one) == bare(other)
    for entry in one.entries:
        a = one.read(entry)
        b = other.read(other.find(entry.hash))
        assert a.meta == b.meta
        assert a.content_hash() == b.content_hash() == entry.hash
        assert all((getattr(a, name) == getattr(b, name)).all() for name in entry.channels)


@pytest.fixture
def dataset(arm, tmp_path):
    """Motions at two rates, one without torques, with a licence and a split."""
    data = Dataset.create(tmp_path / "arm_logs", arm)
    add(data, arm, [f"wave {i}" for i in range(4)], virtual=True)
    ctrl = wave(60, 2, hertz=0.9)
    data.append(replace(arm_sequence(arm, ctrl, late(ctrl, 1), "slow", 0.0), dt=0.05))
    data.set_provenance(licence="CC-BY-4.0")
    write_split(data, make_split(data, "motion"), "motion")
    return data


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """The stand-in of the Hub, where huggingface_hub now looks."""
    pytest.importorskip("huggingface_hub", reason="pip install 'gaponet[hub]'")
    from hub_server import FakeHub

    server = FakeHub()
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hf"))
    monkeypatch.setenv("HF_ENDPOINT", server.url)
    monkeypatch.setenv("HF_TOKEN", "hf_nobody")
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture
def place(hub):
    """An address on the stand-in of the Hub."""
    return "hf://me/arm"


@pytest.fixture
def forge(hub):
    """Change what was pushed as somebody does who knows how an index is made: hashes and sizes are
    right.

    The function that is given gets the index, and put(name, content) and read(name) of its files.
    """

    def forged(change, repo="datasets/me/arm"):
        files = dict(hub.files(repo))
        index = json.loads(files["gaponet.json"])

        def put(name, content):
            files[name] = content
            digest = hashlib.sha256(content).hexdigest()
            index["files"][name] = {"size": len(content), "sha256": digest}

        change(index, put, lambda name: files[name])
        files["gaponet.json"] = json.dumps(index).encode()
        hub.commit(repo, files)

    return forged

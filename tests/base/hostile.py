"""Files of a few bytes that demand gigabytes or endless time, and the commands that open them
(make hostile).
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from arm import XML, write_arm

from gaponet.base import sandbox
from gaponet.base.errors import LogError
from gaponet.base.sandbox import sandboxed

IMPORT = (
    "import",
    "{}/logs",
    "--robot",
    "{}/arm",
    "--unit-id",
    "a",
    "--payload-mass",
    "0",
    "--out",
    "{}/set",
)
IMPORT = (*IMPORT, "--position-unit", "rad", "--time-unit", "s")
CHECK = ("robot", "check", "{}/arm")


@dataclass(frozen=True)
class Case:
    """Function that writes files into a folder, and the command that opens them; {} stands for the
    folder.
    """

    make: Callable[[Path], None]
    words: tuple[str, ...]


def mjcf(old: str, new: str) -> Callable[[Path], None]:
    """Write the test arm with a replacement in its MJCF."""
    assert old in XML
    xml = XML.replace(old, new, 1)

    def make(folder: Path) -> None:
        write_arm(folder / "arm", xml=xml)

    return make


def asset(text: str) -> Callable[[Path], None]:
    return mjcf("<worldbody>", f"<asset>{text}</asset><worldbody>")


def before(text: str) -> Callable[[Path], None]:
    return mjcf("<worldbody>", f"{text}<worldbody>")


def network(nodes: Callable[[object], list[object]], folder: Path) -> None:
    """Write a run whose network has these nodes between x and delta."""
    import onnx
    import torch
    from onnx import TensorProto, helper
    from runs import random_run

    torch.manual_seed(0)
    random_run(folder / "run", write_arm(folder / "arm"))
    place = folder / "run" / "model"
    old = onnx.load(place / "model.onnx")
    width = old.graph.input[0].type.tensor_type.shape.dim[1].dim_value
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", width])
    delta = helper.make_tensor_value_info("delta", TensorProto.FLOAT, ["n", 2])
    zero = helper.make_node("MatMul", ["x", "w"], ["nothing"])
    weights = [helper.make_tensor("w", TensorProto.FLOAT, [width, 2], [0.0] * 2 * width)]
    graph = helper.make_graph(
        [zero, *nodes(weights), helper.make_node("Add", ["nothing", "odd"], ["delta"])],
        "g",
        [x],
        [delta],
        weights,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.save(model, place / "model.onnx")
    card = json.loads((place / "card.json").read_text())
    card.pop("sha256")
    (place / "card.json").write_text(json.dumps(card))


def loop(weights: list[object]) -> list[object]:
    """A loop of 2^62 iterations."""
    from onnx import TensorProto, helper

    weights.append(helper.make_tensor("often", TensorProto.INT64, [], [1 << 62]))
    weights.append(helper.make_tensor("go", TensorProto.BOOL, [], [True]))
    weights.append(helper.make_tensor("start", TensorProto.FLOAT, [], [0.0]))
    value = helper.make_tensor_value_info
    often = value("i", TensorProto.INT64, [])
    go = value("c", TensorProto.BOOL, [])
    number = TensorProto.FLOAT
    nodes = [
        helper.make_node("Identity", ["c"], ["c2"]),
        helper.make_node("Add", ["v", "v"], ["v2"]),
    ]
    after = [value("c2", TensorProto.BOOL, []), value("v2", number, [])]
    body = helper.make_graph(nodes, "body", [often, go, value("v", number, [])], after)
    return [helper.make_node("Loop", ["often", "go", "start"], ["odd"], body=body)]


def outer(weights: list[object]) -> list[object]:
    """A product of 50,000 × 50,000 from two vectors, with operators that every network has."""
    from onnx import TensorProto, helper, numpy_helper

    weights.append(numpy_helper.from_array(np.ones((50_000, 1), np.float32), "column"))
    weights.append(numpy_helper.from_array(np.ones((1, 50_000), np.float32), "row"))
    weights.append(helper.make_tensor("axes", TensorProto.INT64, [2], [0, 1]))
    return [
        helper.make_node("MatMul", ["column", "row"], ["many"]),
        helper.make_node("ReduceSum", ["many", "axes"], ["odd"], keepdims=0),
    ]


def logs(
    name: str, logs_toml: str = ""
) -> Callable[[Callable[[Path], None]], Callable[[Path], None]]:
    """Decorate a function that writes a log: the test arm is written beside it."""

    def wrapped(write: Callable[[Path], None]) -> Callable[[Path], None]:
        def make(folder: Path) -> None:
            write_arm(folder / "arm")
            (folder / "logs").mkdir()
            if logs_toml:
                (folder / "logs" / "logs.toml").write_text(logs_toml)
            write(folder / "logs" / name)

        return make

    return wrapped


@sandboxed(LogError, "numpy")
def parsed(file: Path, how: str) -> object:
    """Behave like a parser, in one way that parsers have."""
    match how:
        case "answers":
            return {"zeros": np.zeros((1000, 3)), "name": (file.name, np.arange(3))}
        case "refuses":
            raise LogError(f"{file}: no log")
        case "wants memory":
            return np.ones(1 << 28)
        case "never ends":
            while True:
                pass
        case "ends":
            os.kill(os.getpid(), signal.SIGSEGV)
        case "prints":
            os.write(1, b"a library says something")
        case "fails":
            raise ZeroDivisionError("what nobody thought of")
        case "writes":
            with open(file, "wb") as out:
                out.truncate(sandbox.MEMORY_BYTES + 1)
    return os.getpid()


JOINTS = ("ctrl.shoulder", "ctrl.elbow", "qpos.shoulder", "qpos.elbow")


@logs("a.parquet")
def parquet_rows(file: Path) -> None:
    """Write 150 million equal rows."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = 1 << 20
    table = pa.table({name: np.zeros(rows) for name in ("time", *JOINTS)})
    with pq.ParquetWriter(file, table.schema, compression="zstd", use_dictionary=True) as writer:
        for _ in range(143):
            writer.write_table(table, row_group_size=rows)


@logs("a.mat", 'rate = 50.0\nctrl = "q"\nqpos = "q"\njoints = ["shoulder", "elbow"]\n')
def mat_zeros(file: Path) -> None:
    """Write 4 GB of compressed zeros."""

    def element(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)

    rows = 120_000_000
    size = rows * 2 * 8
    head = (
        element(6, struct.pack("<II", 6, 0))
        + element(5, struct.pack("<ii", rows, 2))
        + element(1, b"q")
    )
    packer = zlib.compressobj(9)
    body = packer.compress(
        struct.pack("<II", 14, len(head) + 8 + size) + head + struct.pack("<II", 9, size)
    )
    block = bytes(1 << 20)
    body += (
        b"".join(packer.compress(block) for _ in range(size >> 20))
        + packer.compress(bytes(size % (1 << 20)))
        + packer.flush()
    )
    file.write_bytes(
        b"MATLAB 5.0 MAT-file".ljust(124)
        + struct.pack("<H", 0x0100)
        + b"IM"
        + struct.pack("<II", 15, len(body))
        + body
    )


@logs("a.h5", 'rate = 50.0\nctrl = "q"\nqpos = "q"\njoints = ["shoulder", "elbow"]\n')
def hdf5_chunk(file: Path) -> None:
    """Write ten rows in a compressed chunk of 3 GB."""
    import h5py

    # h5py creates no chunk larger than its data: this one is written by the low-level interface
    with h5py.File(file, "w") as root:
        space = h5py.h5s.create_simple((10, 2), (h5py.h5s.UNLIMITED, 2))
        how = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        how.set_chunk((190_000_000, 2))
        how.set_deflate(9)
        data = h5py.Dataset(h5py.h5d.create(root.id, b"q", h5py.h5t.IEEE_F64LE, space, how))
        packer = zlib.compressobj(9)
        body = b"".join(packer.compress(bytes(10_000_000)) for _ in range(304)) + packer.flush()
        data.id.write_direct_chunk((0, 0), body)


@logs("a.mcap")
def mcap_zeros(file: Path) -> None:
    """Write a bag with one chunk of 4 GB."""
    import pyarrow as pa
    from strange_logs import write_bag

    made = file.parent / "bag"
    write_bag(made, "mcap")
    whole = next(made.glob("*.mcap")).read_bytes()
    shutil.rmtree(made)
    sink = pa.BufferOutputStream()
    with pa.CompressedOutputStream(sink, "zstd") as out:
        for _ in range(64):
            out.write(bytes(64 << 20))
    packed = sink.getvalue().to_pybytes()
    record = (
        struct.pack("<QQQI", 0, 10**12, 4 << 30, 0)
        + struct.pack("<I", 4)
        + b"zstd"
        + struct.pack("<Q", len(packed))
        + packed
    )
    at = 8 + 9 + struct.unpack("<Q", whole[9:17])[0]
    file.write_bytes(whole[:at] + b"\x06" + struct.pack("<Q", len(record)) + record + whole[at:])


@logs("a.db3")
def db3_view(file: Path) -> None:
    """Write a bag whose messages are an endless query."""
    from strange_logs import write_bag

    made = file.parent / "bag"
    write_bag(made, "sqlite3")
    next(made.glob("*.db3")).replace(file)
    shutil.rmtree(made)
    with sqlite3.connect(file) as base:
        base.execute("ALTER TABLE messages RENAME TO old")
        base.execute(
            "CREATE VIEW messages AS WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM "
            "c) SELECT n AS id, topic_id, timestamp + n AS timestamp, zeroblob(100000000) AS data "
            "FROM c, old"
        )


def pickled(code: bytes) -> Callable[[Path], None]:
    return logs("a.pkl", 'joints = ["shoulder", "elbow"]\naction_scale = 0.25\n')(
        lambda file: file.write_bytes(code) and None
    )


DOUBLED = b"\x80\x04]\x94" + b"".join(
    b"h" + bytes([i]) + b"h" + bytes([i]) + b"\x86\x94" for i in range(60)
)


@logs("a.npz", 'rate = 50.0\nctrl = "q"\nqpos = "q"\njoints = ["shoulder", "elbow"]\n')
def npz_zeros(file: Path) -> None:
    """Write 4 GB of compressed zeros."""
    import zipfile

    head = (
        b"\x93NUMPY\x01\x00"
        + struct.pack("<H", 118)
        + b"{'descr': '<f8', 'fortran_order': False, 'shape': (268435456, 2), }".ljust(117)
        + b"\n"
    )
    with (
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as packed,
        packed.open("q.npy", "w", force_zip64=True) as part,
    ):
        part.write(head)
        for _ in range(64):
            part.write(bytes(64 << 20))


def sparse(name: str) -> Callable[[Path], None]:
    """Write a sparse text file of 40 GB."""

    def make(file: Path) -> None:
        with file.open("wb") as out:
            out.write(b"time,ctrl.shoulder,ctrl.elbow,qpos.shoulder,qpos.elbow\n0,0,0,0,0\n")
            out.truncate(40 << 30)

    return logs(name)(make)


BENCH = ("export", "{}/run", "--to", "torch")
PICKLE = (*IMPORT, "--allow-pickle")
CONE = asset('<mesh name="m" builtin="cone" params="100000000 1"/>')
NKEY = before('<size nkey="300000000"/>')
LONG = b"\x80\x04cbuiltins\nbytearray\n\x8a\x08" + struct.pack("<q", 5_900_000_000) + b"\x85R."
CASES = {
    "mjcf cone": Case(CONE, CHECK),
    "mjcf supersphere": Case(
        asset('<mesh name="m" builtin="supersphere" params="30000 1 1"/>'), CHECK
    ),
    "mjcf nuser_geom": Case(before('<size nuser_geom="300000000"/>'), CHECK),
    "mjcf nkey": Case(NKEY, CHECK),
    "mjcf iterations": Case(
        mjcf("<option ", '<option iterations="2000000000" tolerance="0" '), CHECK
    ),
    "onnx Loop": Case(lambda folder: network(loop, folder), BENCH),
    "onnx outer": Case(lambda folder: network(outer, folder), BENCH),
    "parquet rows": Case(parquet_rows, IMPORT),
    "mat zeros": Case(mat_zeros, IMPORT),
    "hdf5 chunk": Case(hdf5_chunk, IMPORT),
    "mcap zeros": Case(mcap_zeros, IMPORT),
    "db3 view": Case(db3_view, IMPORT),
    "npz zeros": Case(npz_zeros, IMPORT),
    "pickle bytearray": Case(pickled(LONG), PICKLE),
    "pickle repr": Case(pickled(DOUBLED + b"cnumpy\ndtype\nh\x3c\x85R."), PICKLE),
    "csv sparse": Case(sparse("a.csv"), IMPORT),
}

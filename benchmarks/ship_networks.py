"""Put the network of a run into the package, as src/gaponet/nn/trained/NAME, and the table into
docs/network.md.

    python benchmarks/ship_networks.py RUN NAME DATASET --title TITLE --address ADDRESS \\
        --data-licence LICENCE --limits SENTENCE

Copied from the run: model.onnx, card.json, split.json without names of recordings,
delay_offset.json. The errors of the card are measured here, with the network as it is shipped, on
the test motions of the run in DATASET. Nothing is shipped if a check fails: the simulator must be a
robot of the package, motions of the test must be unseen, files must name no path of this machine,
and all networks together must be at most MAX_TOTAL_BYTES.
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import onnx
import tyro
from shipping import (
    markdown_cards,
    measure_error,
    put_into_package,
    require_public,
    today,
    without_names,
    write_json_line,
    write_table,
)

from gaponet.base.errors import UsageError
from gaponet.data.split import SPLITS
from gaponet.evaluation.candidate import split_of_run
from gaponet.nn.artifact import CARD, WEIGHTS, GapModel, sha256
from gaponet.nn.network_card import HEADINGS, NetworkCard, network_cards
from gaponet.nn.onnx_export import MAX_DIFFERENCE_RAD
from gaponet.nn.onnx_network import OnnxNetwork
from gaponet.nn.packaged_networks import MAX_TOTAL_BYTES, catalogue
from gaponet.robot.card import PUBLISHED, Published, SourceOfData
from gaponet.robot.folder import PackagedRobot, load_stored_robot
from gaponet.sim.dataset_robot import open_dataset
from gaponet.sim.model import model_hash
from gaponet.sim.replay import replay

PAGE = Path(__file__).parents[1] / "docs" / "network.md"
FLOAT32_BYTES = 400_000  # a network up to this size keeps all digits of its weights
MAX_RECORDINGS = 8  # in which the stored network is compared with the trained one
MIN_SPARSE_ELEMENTS = 2048  # of a matrix that is stored sparsely; smaller ones need no index
MAX_SPARSE_DENSITY = 0.1  # share of its elements that are not zero
# Of a matrix that is stored as int16: the small first layers matter most for the output and little
# for the size.
MIN_INT16_ELEMENTS = 32_768
DROPPED = ("parity_rad", "seconds")  # of a card: facts of the machine, not of the network


@dataclass(frozen=True)
class Source:
    """What the run does not say about its network."""

    title: str
    """Name of the data set."""
    address: str
    """Where the data set is, or the command that makes it."""
    data_licence: str
    """SPDX identifier of the data set's licence."""
    limits: str
    """What the network is not for, a sentence."""
    licence: str = "Apache-2.0"
    """SPDX identifier of the network's licence."""


def ship(
    run: Annotated[Path, tyro.conf.Positional],
    name: Annotated[str, tyro.conf.Positional],
    dataset: Annotated[str, tyro.conf.Positional],
    source: Annotated[Source, tyro.conf.arg(name="")],
) -> None:
    """Put the network of a run into the package.

    Args:
        run: Run folder of gaponet train.
        name: Name in the package. A network of that name is replaced.
        dataset: The dataset of the run, for the errors on its test motions.
    """
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / name
        folder.mkdir()
        write_network(run, folder, dataset, source)
        total = put_into_package(folder, catalogue(), MAX_TOTAL_BYTES)
    write_table(PAGE, "networks", markdown_cards(network_cards(), HEADINGS))
    card = NetworkCard.read(catalogue().place / name)
    test = card.published.test
    print(f"{name}: {card.size_bytes:,} bytes, {total:,} of {MAX_TOTAL_BYTES:,} in all networks")
    print(f"differs by at most {card.published.largest_difference_rad:.1e} rad from {run}")
    print(
        f"test: nominal {test.nominal_mrad:.2f} → {test.model_mrad:.2f} mrad, "
        f"{test.recordings} recordings"
    )


def write_network(run: Path, folder: Path, dataset: str, source: Source) -> None:
    """Write a network as it is shipped.

    Args:
        folder: Empty folder, whose name is that of the network.

    Raises:
        GAPONetError: A check failed; the message says which.
    """
    model = GapModel.load(run)
    if model.card.get("interrupted", False):
        raise UsageError(f"{run}: its training was interrupted; finish it with --resume")
    packaged_robot(model).write(folder)
    shutil.copyfile(run / "delay_offset.json", folder / "delay_offset.json")
    split = split_of_run(run)
    write_json_line(folder / "split.json", {part: without_names(split[part]) for part in SPLITS})
    trained = (model.path / WEIGHTS).read_bytes()
    inputs = visited_inputs(model, run, dataset)
    content, difference = stored_form(trained, inputs)
    (folder / WEIGHTS).write_bytes(content)
    card = {key: value for key, value in model.card.items() if key not in DROPPED}
    card["sha256"] = {WEIGHTS: sha256(folder / WEIGHTS)}
    write_json_line(folder / CARD, card)
    published = Published(
        licence=source.licence,
        date=today(),
        data=SourceOfData(source.title, source.address, source.data_licence),
        test=measure_error(folder, *open_dataset(dataset, None, folder)),
        limits_of_use=source.limits,
        largest_difference_rad=difference,
    )
    write_json_line(folder / CARD, card | {PUBLISHED: asdict(published)})
    require_public(folder, run, as_text)
    require_same_outputs(folder, content, inputs)
    NetworkCard.read(folder)


def packaged_robot(model: GapModel) -> PackagedRobot:
    """Return the robot of the package that is the simulator of a model's training.

    Raises:
        UsageError: There is none: it was identified, or its figures were changed.
    """
    simulator = model.simulator()
    named = PackagedRobot(model.card["robot"], simulator.servo.gain_scale)
    found = model_hash(named.load())
    if found != model.card["simulator"]:
        raise UsageError(
            f"{model.path}: trained in simulator {model.card['simulator']}, the package's "
            f"{named.name} with gain_scale {named.gain_scale:g} is {found}; train in the nominal "
            "robot of the package"
        )
    return named


def visited_inputs(model: GapModel, run: Path, dataset: str) -> np.ndarray:
    """Return inputs x of the network in rollouts with it, (k, dim) float32, of test and training
    recordings.
    """
    data, _ = open_dataset(dataset, None, run)
    split = split_of_run(run)
    wanted = set()
    for part in ("test", "train"):
        wanted |= set(list(split[part].values())[: MAX_RECORDINGS // 2])
    entries = [entry for entry in data.entries if entry.hash in wanted]
    if not entries:
        raise UsageError(
            f"{dataset}: has no recording of {run}; give the dataset that it was trained on"
        )
    inputs: list[np.ndarray] = []

    def recording(x: np.ndarray) -> Any:
        inputs.append(np.array(x))
        return model.infer(x)

    observed = GapModel(model.path, model.card, model.config, recording)
    simulator = load_stored_robot(run, model.card["robot"])
    replay(data.sequences(entries), simulator, observed.corrector(simulator), lock_idle=True)
    return np.concatenate(inputs)


def with_small_matrices(content: bytes, *, int16: bool) -> bytes:
    """Return an ONNX file whose large matrices need less space.

    A matrix that selects features has few elements; only these are stored, and all outputs stay
    equal bit for bit.

    Args:
        content: ONNX file with float32 matrices.
        int16: Store other matrices of MIN_INT16_ELEMENTS and more as int16 with one float32 scale a
            row. Outputs then change: a weight by up to 1/65,534 of the largest one in its row.
            float16 would change it by up to 1/4,096 of itself, which changes outputs some eight
            times as much.
    """
    model = onnx.load_model_from_string(content)
    graph = model.graph
    decoding = []
    for tensor in list(graph.initializer):
        matrix = onnx.numpy_helper.to_array(tensor)
        if matrix.ndim != 2:
            continue
        few = np.count_nonzero(matrix) <= MAX_SPARSE_DENSITY * matrix.size
        if few and matrix.size >= MIN_SPARSE_ELEMENTS:
            graph.sparse_initializer.append(_sparse(tensor.name, matrix))
        elif int16 and matrix.size >= MIN_INT16_ELEMENTS:
            stored, nodes = _as_int16(tensor.name, matrix)
            graph.initializer.extend(stored)
            decoding += nodes
        else:
            continue
        graph.initializer.remove(tensor)
    nodes = [*decoding, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    return bytes(model.SerializeToString())


def _sparse(name: str, matrix: np.ndarray) -> Any:
    """Return a matrix as a sparse tensor of ONNX."""
    index = np.flatnonzero(matrix)
    values = onnx.numpy_helper.from_array(matrix.ravel()[index], name)
    indices = onnx.numpy_helper.from_array(index.astype(np.int64), f"{name}_index")
    return onnx.helper.make_sparse_tensor(values, indices, list(matrix.shape))


def _as_int16(name: str, matrix: np.ndarray) -> tuple[list[Any], list[Any]]:
    """Return a matrix as int16 steps with a scale for each row, and the nodes that compute it from
    these.
    """
    scale = np.abs(matrix).max(axis=1, keepdims=True) / np.iinfo(np.int16).max
    scale = np.where(scale > 0, scale, 1.0).astype(np.float32)
    steps = np.round(matrix / scale).astype(np.int16)
    stored = [
        onnx.numpy_helper.from_array(steps, f"{name}_steps"),
        onnx.numpy_helper.from_array(scale, f"{name}_scale"),
    ]
    nodes = [
        onnx.helper.make_node(
            "Cast", [f"{name}_steps"], [f"{name}_float"], to=onnx.TensorProto.FLOAT
        ),
        onnx.helper.make_node("Mul", [f"{name}_float", f"{name}_scale"], [name]),
    ]
    return stored, nodes


def stored_form(trained: bytes, inputs: np.ndarray) -> tuple[bytes, float]:
    """Return the ONNX file as it is shipped, and its largest difference from the trained one, rad.

    A small network keeps all digits, so that its outputs are equal bit for bit.

    Raises:
        UsageError: The difference is above MAX_DIFFERENCE_RAD.
    """
    before = OnnxNetwork(trained)(inputs)
    exact = with_small_matrices(trained, int16=False)
    if len(exact) <= FLOAT32_BYTES:
        if not np.array_equal(OnnxNetwork(exact)(inputs), before):
            raise UsageError(
                "outputs changed although no weight did; report this with the version of "
                "onnxruntime"
            )
        return exact, 0.0
    short = with_small_matrices(trained, int16=True)
    difference = float(np.abs(OnnxNetwork(short)(inputs) - before).max())
    if not difference <= MAX_DIFFERENCE_RAD:
        raise UsageError(
            f"with int16 weights outputs change by {difference:.1e} rad (limit "
            f"{MAX_DIFFERENCE_RAD:.0e}); train a network of at most {FLOAT32_BYTES:,} bytes"
        )
    return short, difference


def as_text(file: Path) -> str:
    """Return a file as text, an ONNX file without its weights."""
    if file.name != WEIGHTS:
        return file.read_text(encoding="utf-8")
    model = onnx.load(str(file))
    del model.graph.initializer[:]
    del model.graph.sparse_initializer[:]
    return str(model)


def require_same_outputs(folder: Path, content: bytes, inputs: np.ndarray) -> None:
    """Refuse a folder that does not load, or answers otherwise than its content, bit for bit."""
    stored = GapModel.load(folder)
    stored.simulator()
    if not np.array_equal(stored.infer(inputs), OnnxNetwork(content)(inputs)):
        raise UsageError(f"{folder}: answers otherwise than what was written; write it again")


if __name__ == "__main__":
    tyro.cli(ship)

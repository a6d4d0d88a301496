"""README.md of what was pushed: the Hub's own header, our card, and the command that brings it back."""

from __future__ import annotations

import json
from typing import Any

from gaponet.base.text import markdown
from gaponet.data.card import NOT_STATED
from gaponet.nn.artifact import GapModel
from gaponet.report.tables import totals

LICENCES = ("apache-2.0", "mit", "bsd-3-clause", "cc0-1.0", "cc-by-4.0", "cc-by-sa-4.0", "cc-by-nc-4.0")  # the Hub's


def dataset_readme(card: dict[str, Any], text: str, address: str, sets: list[str]) -> str:
    """A dataset card: the header by which the Hub shows LeRobot sets, and the numbers of data.card.

    Args:
        sets: Folders of the sets; "" where it is one.
    """
    virtual = ["virtual"] if card["virtual_sequences"] else []
    header: dict[str, Any] = {
        "task_categories": ["robotics"],
        "tags": ["LeRobot", "gaponet", "sim-to-real", card["robot"], *virtual],
        "configs": [
            {"config_name": part or "default", "data_files": f"{part}/data/*/*.parquet".lstrip("/")} for part in sets
        ],
    }
    licence = card["licence"]
    if licence.lower() in LICENCES:
        header["license"] = licence.lower()
    elif licence != NOT_STATED:
        header |= {"license": "other", "license_name": licence}
    back = ["## Use", "", f"    gaponet pull {address} DATASET", "",
            "Files are those of a LeRobotDataset v3.0, in rad, rad/s and N·m: LeRobot reads them too.", ""]  # fmt: skip
    return _headed(header, [*text.splitlines(), *back])


def run_readme(facts: dict[str, Any], address: str) -> str:
    """A model card: what the network corrects, what it was trained on, and its errors on motions that it never saw."""
    card, metrics = facts["card"], facts["metrics"]
    virtual = bool(card.get("virtual"))
    tags = ["gaponet", "sim-to-real", card["robot"], *(["virtual"] if virtual else [])]
    rates = ", ".join(f"{1 / dt:.2f}" for dt in card.get("dt", []))
    lines = [
        f"# {markdown(card['robot'])}: a model of its motor gap" + (", trained on VIRTUAL robots" if virtual else ""),
        "",
        f"- corrects the targets of {len(card['joint_names'])} joints: {markdown(', '.join(card['joint_names']))}",
        f"- trained {markdown(GapModel.how_trained(card))}, on {card.get('hours', 0):.2f} h of dataset "
        f"{markdown(str(card.get('dataset_hash', '')))}",
        f"- at {rates} Hz, in simulator {markdown(card['simulator'])}",
        f"- weights {facts['weights']}",
        "",
    ]
    if metrics:
        lines += [
            f"Whole motions in free run, {'never seen' if metrics['unseen'] else 'seen in training'}, "
            f"{metrics['sequences']} sequences:",
            "",
            totals(metrics["methods"], simulators=metrics.get("simulators")).markdown(),
            "",
        ]
    back = ["## Use", "", f"    gaponet pull {address} RUN", "    gaponet run --model RUN …", ""]
    return _headed({"library_name": "gaponet", "tags": tags}, [*lines, *back])


def _headed(header: dict[str, Any], lines: list[str]) -> str:
    """YAML between two rules, each value as JSON, which YAML is."""
    said = [f"{name}: {json.dumps(value, ensure_ascii=False)}" for name, value in header.items()]
    return "\n".join(["---", *said, "---", "", *lines])

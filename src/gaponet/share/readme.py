"""README.md of a push: the header for the Hub, the data card or model card, and the command that
pulls it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from gaponet.base.text import escape_markdown
from gaponet.data.card import NOT_STATED
from gaponet.evaluation.candidate import Origin
from gaponet.evaluation.tables import mrad, totals
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec

# Licences that the Hub knows by these identifiers.
LICENCES = (
    "apache-2.0",
    "mit",
    "bsd-3-clause",
    "cc0-1.0",
    "cc-by-4.0",
    "cc-by-sa-4.0",
    "cc-by-nc-4.0",
)


def dataset_readme(card: dict[str, Any], text: str, address: str, sets: list[str]) -> str:
    """Return a dataset card: the header with which the Hub shows LeRobot sets, and the text of the
    card.

    Args:
        sets: Folders of the sets, below the repository.
    """
    licence = card["licence"]
    configs = []
    for place in sets:
        name = place.strip("./") or "default"
        configs.append({"config_name": name, "data_files": f"{place}/data/*/*.parquet"})
    header: dict[str, Any] = {
        "task_categories": ["robotics"],
        "tags": _tags(card, "LeRobot"),
        "configs": configs,
    }
    if licence.lower() in LICENCES:
        header["license"] = licence.lower()
    elif licence != NOT_STATED:
        header |= {"license": "other", "license_name": licence}
    use = [
        f"    gaponet pull {address} DATASET",
        "",
        "LeRobot reads the files too: a LeRobotDataset v3.0 in SI units.",
    ]
    return _page(header, text.splitlines(), use)


@dataclass(frozen=True)
class ModelFacts:
    """What the user says for the header of a model card.

    Attributes:
        licence: SPDX identifier; "" if it was not said.
        trained_on: Dataset of the Hub, USER/NAME; "" if there is none.
    """

    licence: str = ""
    trained_on: str = ""

    def header(self, tags: list[str]) -> dict[str, Any]:
        """Return the header with which the Hub shows and finds a model."""
        licence = self.licence.lower() or "unknown"
        stated = {"license": licence}
        if licence not in (*LICENCES, "unknown"):
            stated = {"license": "other", "license_name": self.licence}
        return {
            **stated,
            "library_name": "gaponet",
            "tags": tags,
            "datasets": [self.trained_on] if self.trained_on else [],
            "metrics": ["mae"],  # of joint positions in rollouts
        }


def robot_readme(robot: RobotSpec, origin: Origin | None, address: str, facts: ModelFacts) -> str:
    """Return a model card: joints, data, and errors on the motions that validated the fit."""
    name = escape_markdown(robot.name)
    lines = [
        f"# {name}: an identified robot",
        "",
        f"- identified joints: {escape_markdown(', '.join(robot.operated))}",
        f"- {escape_markdown(robot.description)}",
    ]
    if origin is not None:
        errors = origin["val_mpjae"]
        lines += [
            f"- from {len(origin['parts']['train'])} recordings",
            f"- mean error on validation motions: {mrad(errors['nominal'])} mrad before, "
            f"{mrad(errors['identified'])} mrad identified",
        ]
    lines += [
        "",
        "These are the values of one robot at one time. Identify or adapt yours before you rely "
        "on them.",
    ]
    short = address.removeprefix("hf://")
    use = [
        "```python",
        "import gaponet as gp",
        "",
        f'robot = gp.load_robot("hf://{short}")',
        "```",
        "",
        f"    gaponet export hf://{short} --to mjcf --out my_{robot.name}",
    ]
    return _page(facts.header(_tags({"robot": robot.name})), lines, use)


def run_readme(found: dict[str, Any], address: str, facts: ModelFacts) -> str:
    """Return a model card: corrected joints, training data, and errors on the test motions.

    Args:
        found: What share.run reads of the run: card, metrics (None without an evaluation), weights.
    """
    card = found["card"]
    metrics = found["metrics"]
    heading = f"{escape_markdown(card['robot'])}: a model of its motor gap"
    if card.get("virtual"):
        heading += ", trained on VIRTUAL robots"
    joints = card["joint_names"]
    rates = ", ".join(f"{1 / dt:.2f}" for dt in card.get("dt", []))
    training = escape_markdown(GapModel.how_trained(card))
    dataset = escape_markdown(str(card.get("dataset_hash", "")))
    lines = [
        f"# {heading}",
        "",
        f"- corrects the targets of {len(joints)} joints: {escape_markdown(', '.join(joints))}",
        f"- trained {training}, on {card.get('hours', 0):.2f} h of dataset {dataset}",
        f"- at {rates} Hz, in simulator {escape_markdown(card['simulator'])}",
        f"- weights {found['weights']}",
    ]
    if metrics:
        seen = "never seen" if metrics["unseen"] else "seen in training"
        lines += ["", f"Rollouts of {metrics['sequences']} whole sequences, {seen}:", ""]
        lines += [totals(metrics["methods"], simulators=metrics.get("simulators")).markdown()]
    short = address.removeprefix("hf://")
    use = [f"    gaponet run --model hf://{short} …", f"    gaponet pull {address} RUN"]
    return _page(facts.header(_tags(card)), lines, use)


def _tags(card: dict[str, Any], *more: str) -> list[str]:
    tags = [*more, "gaponet", "sim-to-real", card["robot"]]
    if card.get("virtual_sequences") or card.get("virtual"):
        tags.append("virtual")
    return tags


def _page(header: dict[str, Any], lines: list[str], use: list[str]) -> str:
    """Return YAML between two rules and then the page.

    Each value is written as JSON, which is valid YAML.
    """
    fields = [f"{name}: {json.dumps(value, ensure_ascii=False)}" for name, value in header.items()]
    return "\n".join(["---", *fields, "---", "", *lines, "", "## Use", "", *use, ""])

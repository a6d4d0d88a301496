"""What is trained: a plain list. All methods of a block have equal data, inputs and training:
`method_trainings` makes them, and `_recipe` holds the training of a block.

Block "labels": supervised pre-training on labels, then PPO. Block "ppo": PPO from an untrained
network, the paper's recipe. Block "table2": the paper's network in its own form, one setting
changed in each row.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from gaponet.experiments.paper.options import Block, Method, PaperOptions
from gaponet.nn.config import ModelConfig, ModelKind
from gaponet.nn.training.config import PPOConfig, PretrainingConfig, TrainConfig

BLOCK_TITLES: dict[Block, str] = {
    "labels": "labels, then PPO",
    "ppo": "PPO alone",
    "table2": "Table 2",
}

# Blocks that compare the methods.
METHOD_BLOCKS: tuple[Block, ...] = ("labels", "ppo")

# Method → kind of network. The order is that of all tables.
NETWORKS: dict[Method, ModelKind] = {
    "MLP": "mlp",  # ASAP's form, the paper's baseline
    "shared MLP": "shared_mlp",  # the inputs and the number of weights of GAPONet
    "literal": "paper",  # equations 1 to 4 of the paper, with its widths
    "GAPONet": "gaponet",  # ours
}

PRETRAINING = PretrainingConfig(rounds=2, num_envs=128, steps=300, gradient_steps=800)
TABLE_2_MODEL = ModelConfig(kind="paper", payload_input=False)  # the paper's own row has no payload

# Row of Table 2 → what differs from TABLE_2_MODEL. Each row has a training of its own.
TABLE_2_CHANGES: dict[str, dict[str, object]] = {
    "payload out": {},
    "payload in": {"payload_input": True},
    "100 Hz": {},  # the recordings differ, see `table_2_trainings`
    "history 2": {"history": 2},
    "history 6": {"history": 6},
    "history 8": {"history": 8},
    "correction held 3": {"delta_hold": 3},
    "correction held 5": {"delta_hold": 5},
    "sensors held 3": {"sensor_hold": 3},
    "sensors held 5": {"sensor_hold": 5},
    "predict S(t+1)": {"sensor_target": "absolute"},
    "equation 1 as written": {"payload_input": True, "predictor_inputs": "equation_1"},
    "stepped probes": {"sensor_source": "fixed"},
    "without sensors": {"sensor_source": "none"},
}

# A quick run shows that everything works: every network takes steps, and its numbers mean nothing.
QUICK_PRETRAINING = PretrainingConfig(
    rounds=1, num_envs=16, steps=40, gradient_steps=150, batch_size=128, sensor_states=128
)
QUICK_PPO = PPOConfig(
    num_envs=16, num_steps=16, epochs=2, mini_batches=1, critic_warmup=1, explained=-1e9
)
QUICK_NO_VALIDATION = 1_000  # updates between validations: only the last one counts


@dataclass(frozen=True)
class Training:
    """One training.

    Attributes:
        block: Which comparison it belongs to.
        name: Method, or row of Table 2.
        seed: Seed of everything random.
        config: All settings.
        steps: Length, control steps; pre-training counts.
    """

    block: Block
    name: str
    seed: int
    config: TrainConfig
    steps: int

    @property
    def folder(self) -> str:
        """Name of its folder in OUT/trainings."""
        words = f"{self.block}-{self.name}-{self.seed}"
        return "".join(letter if letter.isalnum() or letter in "-+" else "_" for letter in words)


def block_title(block: Block, options: PaperOptions) -> str:
    """Return how the networks of a block are trained."""
    labels = QUICK_PRETRAINING if options.quick else PRETRAINING
    if block == "labels" and options.steps <= labels.rounds * labels.num_envs * labels.steps:
        return "labels alone"
    return BLOCK_TITLES[block]


def all_trainings(
    options: PaperOptions, rates: tuple[float, ...], payloads: tuple[float, ...]
) -> list[Training]:
    """Return all trainings, the most important first, so that an interrupted night has every
    method.

    Args:
        rates: Control rates of the dataset, Hz, ascending. The first one is used wherever the rate
            is not the question.
        payloads: Payloads of the dataset, kg.
    """
    trainings: list[Training] = []
    for block in METHOD_BLOCKS:
        if block not in options.blocks:
            continue
        for seed in range(options.seeds):
            trainings += method_trainings(options, block, seed, rates[:1])
    if "table2" in options.blocks:
        for seed in range(options.seeds):
            trainings += table_2_trainings(options, seed, rates, payloads)
    return trainings


def method_trainings(
    options: PaperOptions, block: Block, seed: int, rates: tuple[float, ...]
) -> list[Training]:
    """Return one training of each method: their settings differ in the kind of network alone."""
    config = _recipe(TrainConfig(rates=rates, seed=seed), block, options)
    trainings = []
    for name, kind in NETWORKS.items():
        if name in options.methods:
            model = replace(config.model, kind=kind)
            of_method = replace(config, model=model)
            trainings.append(Training(block, name, seed, of_method, options.steps))
    return trainings


def table_2_trainings(
    options: PaperOptions, seed: int, rates: tuple[float, ...], payloads: tuple[float, ...]
) -> list[Training]:
    """Return the rows of Table 2 that the dataset allows, all trained like block "labels"."""
    trainings = []
    for row, changes in TABLE_2_CHANGES.items():
        if row == "100 Hz" and len(rates) < 2:
            continue
        if row == "payload in" and len(payloads) < 2:
            continue
        row_rates = rates[-1:] if row == "100 Hz" else rates[:1]
        model = replace(TABLE_2_MODEL, **changes)  # type: ignore[arg-type]
        config = _recipe(TrainConfig(model=model, rates=row_rates, seed=seed), "labels", options)
        trainings.append(Training("table2", row, seed, config, options.steps))
    return trainings


def _recipe(config: TrainConfig, block: Block, options: PaperOptions) -> TrainConfig:
    """Return the settings with the training of a block: labels first, or without for "ppo"."""
    config = replace(config, threads=1, pretraining=PRETRAINING)
    if options.quick:
        config = replace(
            config,
            pretraining=QUICK_PRETRAINING,
            ppo=QUICK_PPO,
            validate_every=QUICK_NO_VALIDATION,
        )
    if block == "ppo":
        config = config.paper_recipe()
    return config

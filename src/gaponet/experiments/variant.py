"""A model with some settings changed, as one word: mlp, mlp:mlp_hidden=256,128, identified+gaponet:sensors=predicted.

[identified+]KIND[:FIELD=VALUE]…        a field of ModelConfig or TrainConfig; pretraining.rounds for one inside another
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from typing import Any, Literal, get_args, get_origin, get_type_hints

from gaponet.base.errors import UsageError
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.config import RENAMED_FIELDS, TrainConfig
from gaponet.report.methods import IDENTIFIED

KINDS: tuple[str, ...] = get_args(get_type_hints(ModelConfig)["kind"])
RESERVED = ("kind", "model", "seed", "threads")  # set by the word itself or by the comparison
SWITCH = {"on": True, "true": True, "yes": True, "off": False, "false": False, "no": False}


@dataclass(frozen=True)
class Variant:
    """One method of a comparison.

    Attributes:
        name: The word as the user wrote it.
        identified: True if it corrects the identified simulator.
    """

    name: str
    config: TrainConfig
    identified: bool = False

    @property
    def kind(self) -> str:
        """The kind of the model: gaponet, mlp, …"""
        return self.config.model.kind

    @property
    def changes(self) -> tuple[str, ...]:
        """The fields that the word changes, as FIELD=VALUE."""
        return tuple(self.name.split(":")[1:])


def parse_variant(text: str, base: TrainConfig) -> Variant:
    """Parse one word; settings that it does not name come from base.

    Raises:
        UsageError: No such kind or field, or a value of another type; the message names the existing ones.
    """
    kind, *settings = text.removeprefix(IDENTIFIED).split(":")
    if kind not in KINDS:
        raise UsageError(f"--models {text}: no model '{kind}'; there are {', '.join(KINDS)}, each also as "
                         f"{IDENTIFIED}KIND and with :FIELD=VALUE behind it")  # fmt: skip
    config = replace(base, model=replace(base.model, kind=kind))  # type: ignore[arg-type]
    for setting in settings:
        config = _set(config, setting, text)
    return Variant(text, config, text.startswith(IDENTIFIED))


def _set(config: TrainConfig, setting: str, text: str) -> TrainConfig:
    field, equals, value = setting.partition("=")
    part, dot, name = field.partition(".")
    field = RENAMED_FIELDS.get(part, part) + dot + name
    places = dict(_places(config))
    if not equals or field not in places:
        near = get_close_matches(field, places, 5, 0.4)
        raise UsageError(
            f"--models {text}: '{setting}' is not FIELD=VALUE; fields like that are {', '.join(near) or 'none'}; "
            "all stand in gaponet train --help, without the model. in front"
        )
    part, name = places[field]
    owner = getattr(config, part) if part else config
    change: dict[str, Any] = {name: _read(value, get_type_hints(type(owner))[name], f"--models {text}: {field}")}
    if part:
        change = {part: replace(owner, **change)}
    return replace(config, **change)


def _places(config: TrainConfig) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield (name as written, (part of the config or "", field)) of every setting."""
    for field in fields(config.model):
        if field.name not in RESERVED:
            yield field.name, ("model", field.name)
    for field in fields(config):
        if field.name in RESERVED:
            continue
        value = getattr(config, field.name)
        if is_dataclass(value):
            yield from ((f"{field.name}.{inner.name}", (field.name, inner.name)) for inner in fields(value))
        else:
            yield field.name, ("", field.name)


def _read(text: str, hint: Any, where: str) -> Any:
    if type(None) in get_args(hint):
        return None if text == "none" else _read(text, get_args(hint)[0], where)
    if get_origin(hint) is tuple:
        return tuple(_read(part, get_args(hint)[0], where) for part in text.split(",") if part)
    options = get_args(hint) if get_origin(hint) is Literal else tuple(SWITCH) if hint is bool else ()
    if options:
        if text not in options:
            raise UsageError(f"{where} is '{text}'; it is one of {', '.join(options)}")
        return SWITCH[text] if hint is bool else text
    try:
        return hint(text)
    except ValueError:
        raise UsageError(f"{where} is '{text}'; it must be {'a whole number' if hint is int else 'a number'}") from None

"""A model with some settings changed, as one word: mlp, mlp:mlp_hidden=256,128, identified+gaponet:sensors=predicted.

[identified+]KIND[:FIELD=VALUE]…        a field of ModelConfig or TrainConfig; pretraining.rounds for one inside another
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from typing import Any, get_args, get_origin, get_type_hints

from pydantic import TypeAdapter, ValidationError

from gaponet.base.errors import UsageError
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.config import TrainConfig
from gaponet.report.methods import IDENTIFIED

KINDS: tuple[str, ...] = get_args(get_type_hints(ModelConfig)["kind"])
RESERVED = ("kind", "model", "seed", "threads")  # set by the word itself or by the comparison


@dataclass(frozen=True)
class Variant:
    """One method of a comparison."""

    name: str  # the word as the user wrote it
    config: TrainConfig
    identified: bool = False  # True if it corrects the identified simulator

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
    places = dict(_places(config))
    if not equals or field not in places:
        near = get_close_matches(field, places, 5, 0.4)
        raise UsageError(
            f"--models {text}: '{setting}' is not FIELD=VALUE; fields like that are {', '.join(near) or 'none'}; "
            "all stand in gaponet train --help, without the model. in front"
        )
    part, name = places[field]
    owner = getattr(config, part) if part else config
    change: dict[str, Any] = {
        name: _read(value, get_type_hints(type(owner))[name], f"--models {text}: {field}")
    }
    if part:
        change = {part: replace(owner, **change)}
    return replace(config, **change)


def _places(config: TrainConfig) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield (name as written, (part of the config or "", field)) of every setting."""
    yield from (
        (field.name, ("model", field.name))
        for field in fields(config.model)
        if field.name not in RESERVED
    )
    for field in (field for field in fields(config) if field.name not in RESERVED):
        if is_dataclass(part := getattr(config, field.name)):
            yield from (
                (f"{field.name}.{inner.name}", (field.name, inner.name)) for inner in fields(part)
            )
        else:
            yield field.name, ("", field.name)


def _read(text: str, hint: Any, where: str) -> Any:
    value: Any = None if text == "none" and type(None) in get_args(hint) else text
    if get_origin(hint) is tuple:
        value = [part for part in text.split(",") if part]
    try:
        return TypeAdapter(hint).validate_python(value)
    except ValidationError as error:
        raise UsageError(f"{where} is '{text}': {error.errors()[0]['msg']}") from None

"""Options that several commands have, each said once; and how their help reaches tyro.

tyro makes the command line of a function: its parameters are the options, and its docstring is the
help. `like` and `join_lines` change that docstring before tyro reads it. `hide_nothing` and
`OPTIONAL` keep the word None out of the help.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from dataclasses import is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro
from docstring_parser import parse_from_object
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

Command = TypeVar("Command", bound=Callable[..., Any])

ATTRIBUTES = "Attributes:"  # heading in a docstring, as docstring_parser reads it
Folder = tyro.conf.Positional[Path]
Logs = Annotated[Folder, tyro.conf.arg(metavar="LOGS")]
Model = Annotated[Folder, tyro.conf.arg(metavar="MODEL")]
Flag = tyro.conf.FlagCreatePairsOff[bool]
Data = Annotated[
    Folder, tyro.conf.arg(help="Dataset folder, as gaponet import writes it.", metavar="DATASET")
]
Run = Annotated[Folder, tyro.conf.arg(help="Run folder of gaponet train.", metavar="RUN")]
Known = Annotated[
    Folder,
    tyro.conf.arg(
        help="Robot folder of gaponet identify, run folder of gaponet train, or name of a network "
        "of the package (gaponet robot networks).",
        metavar="ROBOT|RUN|NAME",
    ),
]
Motions = Annotated[tuple[str, ...], tyro.conf.arg(help="Use only these motions.")]
Robot = Annotated[
    str | None,
    tyro.conf.arg(
        help="Robot name or folder. Default: the robot that the dataset or the run stores.",
        metavar="ROBOT",
    ),
]
Unit = Annotated[str, tyro.conf.arg(aliases=["--unit-id"])]  # gaponet import calls it --unit-id
Json = Annotated[
    Flag, tyro.conf.arg(help="Print the result as one JSON object on stdout; tables go to stderr.")
]


def join_lines(command: Callable[..., Any]) -> None:
    """Join the lines of each option's explanation: tyro would show the line breaks.

    The explanation of an option stands in the docstring of the command or, where the command takes
    a dataclass, below the field.
    """
    command = inspect.unwrap(command)
    command.__doc__ = re.sub(r"\n {8,}", " ", inspect.getdoc(command) or "")
    for hint in get_type_hints(command).values():
        _join_lines_of_fields(hint)


def _join_lines_of_fields(hint: Any) -> None:
    """Write the explanations of a dataclass's fields into its docstring, each on one line.

    This changes the class, its bases and the dataclasses in its fields: tyro looks for a field in
    the docstring of the class, then in those of its bases. A second call changes nothing.

    Args:
        hint: Type of a parameter or a field; nothing happens if it is no dataclass.
    """
    if not (isinstance(hint, type) and is_dataclass(hint)):
        return
    for owner in hint.__mro__:
        if is_dataclass(owner):
            _list_fields_in_docstring(owner)
    for nested in get_type_hints(hint).values():
        _join_lines_of_fields(nested)


def _list_fields_in_docstring(owner: type) -> None:
    """Append the heading Attributes and a line for each explained field to a class's docstring."""
    explained = parse_from_object(owner).params  # from the source: docstrings below the fields
    about = inspect.cleandoc(owner.__doc__ or "")
    if not explained or ATTRIBUTES in about:
        return
    lines = []
    for field in explained:
        words = (field.description or "").split()
        lines.append(f"    {field.arg_name}: {' '.join(words)}")
    owner.__doc__ = "\n".join([about, "", ATTRIBUTES, *lines])


NOTHING = (None, (), "")
"""Defaults that say nothing: the option's explanation says what happens without it."""
NO_HINT = tyro.conf.arg(help_behavior_hint="")


def hide_nothing(command: Callable[..., Any]) -> None:
    """Leave out "(default: None)" and the like in the help of a command's options.

    This annotates parameters and, where the command takes a dataclass, its fields. A second call
    changes nothing.
    """
    command = inspect.unwrap(command)
    hints = get_type_hints(command, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        if parameter.default in NOTHING:
            command.__annotations__[name] = Annotated[hints[name], NO_HINT]
    for hint in get_type_hints(command).values():
        _hide_nothing_of_fields(hint)


def _hide_nothing_of_fields(hint: Any) -> None:
    """Annotate the fields of a dataclass and of the dataclasses in them.

    Args:
        hint: Type of a parameter or a field; nothing happens if it is no dataclass.
    """
    if not (isinstance(hint, type) and is_dataclass(hint)):
        return
    hints = get_type_hints(hint, include_extras=True)
    for owner in hint.__mro__:
        for name in vars(owner).get("__annotations__", {}):
            if vars(owner).get(name, NO_HINT) in NOTHING:
                owner.__annotations__[name] = Annotated[hints[name], NO_HINT]
    for nested in get_type_hints(hint).values():
        _hide_nothing_of_fields(nested)


OPTIONAL = ConstructorRegistry()
"""How tyro reads an option that may be None: as one of its other types. tyro itself would show
"{None}|STR" and read the word None as no value."""


@OPTIONAL.primitive_rule
def _read_optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    kinds = get_args(info.type)
    if get_origin(info.type) not in (Union, UnionType) or NoneType not in kinds:
        return None
    others = tuple(kind for kind in kinds if kind is not NoneType)
    one_of_them: Any = Union[others]  # noqa: UP007
    value = PrimitiveTypeInfo.make(one_of_them, info.markers)
    spec = ConstructorRegistry.get_primitive_spec(value)
    if not isinstance(spec, PrimitiveConstructorSpec):
        return None
    of_value = spec

    def is_instance(given: Any) -> Any:
        return given is None or of_value.is_instance(given)

    def words(given: Any) -> list[str]:
        return [] if given is None else of_value.str_from_instance(given)

    return replace(of_value, is_instance=is_instance, str_from_instance=words)


def like(function: Callable[..., Any]) -> Callable[[Command], Command]:
    """Decorator of a command: options that it does not explain itself mean what this function's
    arguments do.
    """

    def decorate(command: Command) -> Command:
        _, _, after_heading = (inspect.getdoc(function) or "").partition("Args:\n")
        arguments, _, _ = after_heading.partition("\n\n")
        about, _, explained = (inspect.getdoc(command) or "").partition("Args:\n")
        # Of two explanations of one option the last counts: the command's own.
        command.__doc__ = f"{about.rstrip()}\n\nArgs:\n{arguments}\n{explained}"
        return command

    return decorate


def actions(**functions: Callable[..., Any]) -> Callable[[Command], Command]:
    """Decorator of a command with actions, such as gaponet robot check: each runs while the
    command line is parsed.

    Args:
        functions: Name of the action → function.
    """
    kinds = []
    for name, function in functions.items():
        join_lines(function)
        kinds.append(Annotated[None, tyro.conf.subcommand(name, constructor=function)])

    def decorate(command: Command) -> Command:
        one_of_them: Any = Union[tuple(kinds)]  # noqa: UP007
        flat = tyro.conf.arg(name="")
        command.__annotations__["action"] = Annotated[
            one_of_them, tyro.conf.OmitSubcommandPrefixes, flat
        ]
        return command

    return decorate

"""Command-line entry points: parsing, error messages and exit codes."""

from __future__ import annotations

import io
import logging
import os
import re
import select
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import MISSING, Field, fields, is_dataclass, make_dataclass, replace
from enum import IntEnum
from functools import reduce
from importlib import metadata
from operator import or_
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    Protocol,
    get_args,
    get_type_hints,
    runtime_checkable,
)

from egosim_jax.runtime import interrupts, preemption
from egosim_jax.runtime.failures import system_failure, undecoded_text
from egosim_jax.runtime.options import meant, show_options
from egosim_jax.runtime.phases import show_phases
from egosim_jax.runtime.terminal import check_utf8, printable
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo


class ExitCode(IntEnum):
    """Exit codes of every command, for scripts to act on."""

    DONE = 0
    FAILED = 1
    USAGE = 2
    """Wrong option or invalid input: the same command fails again."""
    PARTIAL = 3
    """Some items failed; the others are done."""
    HUNG = 70
    """Training made no progress within its timeout."""
    RESUBMIT = preemption.CODE
    """Training was interrupted and saved: run the same command again."""
    INTERRUPTED = interrupts.CODE
    """Ctrl-C; the message says how to continue if there are results."""


class CommandExit(Exception):  # noqa: N818 - an early exit need not be an error
    """Early end of a command, with the message to print and the exit code."""

    def __init__(self, message: str, code: ExitCode):
        super().__init__(message)
        self.code = code


class ProcessExit(CommandExit):
    """Early end of one process of a run, which the others learn from its end."""


HelpGroups = Mapping[str, tuple[str, ...]]
"""Fields of a command by the title of their group in `--help`.

Fields without a group come first: the few that users change.
"""


Writes = Literal["folder", "file", "folder or .zip file"]
"""Kind of --out that a command writes: its attribute `writes`, by default a folder."""


@runtime_checkable
class Command(Protocol):
    """Dataclass of a parsed command line; it may have `help_groups`."""

    def run(self) -> int:
        """Run the command and return the exit code."""
        ...


def subcommands(kinds: Mapping[str, type]) -> Any:
    """Return the union of commands by name, for `main` and `group`."""
    import tyro

    named = [Annotated[kind, tyro.conf.subcommand(name)] for name, kind in kinds.items()]
    return reduce(or_, named)


def group(
    name: str,
    about: str,
    kinds: Mapping[str, type],
    *,
    run: Callable[[Any], int] = lambda chosen: chosen.command.run(),
) -> type:
    """Return a command of subcommands; `run` gets the command with the chosen one."""
    fields = [("command", subcommands(kinds))]
    made = {"run": run, "__doc__": about}
    return make_dataclass(name, fields, frozen=True, kw_only=True, namespace=made)


def main(
    commands: Any,
    *,
    program: str,
    description: str,
    args: Sequence[str] | None,
    context: Callable[[], AbstractContextManager[None]] = nullcontext,
    others: Sequence[str] = (),
) -> int:
    """Parse a command line into one of the dataclasses `commands`, run it, return its exit code.

    The command runs inside the context manager that `context` makes after parsing. `others` are
    subcommands that other programs parse, for the suggestion after a typo. Results go to stdout,
    progress and errors to stderr. A wrong option or invalid input prints one message; a traceback
    means a bug.
    """

    given = list(sys.argv[1:] if args is None else args)
    logging.getLogger("absl").setLevel(logging.CRITICAL)  # Orbax raises its errors too

    def run() -> int:
        if given == ["--version"]:
            print(f"{program} {metadata.version('egosim-jax')}")
            return ExitCode.DONE
        _refuse_undecoded(given)
        about = f"{description} --version prints the version."
        command = parse(commands, given, program=program, about=about, others=others)
        _refuse_empty(command)
        _refuse_undecoded_places(command)
        _refuse_file(command)
        with context(), show_phases(), show_options(command):
            code = command.run()
        if args is None:
            interrupts.ignore()  # the process ends: there is nothing to continue
        return code

    return run_with_exit_codes(run)


def _refuse_undecoded(given: Sequence[str]) -> None:
    """Raise `InputError` for an argument that is not text: no report could name such a path."""
    for argument in given:
        check_utf8(argument)


def _refuse_undecoded_places(command: Any) -> None:
    """Raise `InputError` for a path that leads to a name that is not UTF-8.

    So do relative paths in such a folder, and links.
    """
    for field in fields(command):
        value = getattr(command, field.name)
        if is_dataclass(value):
            _refuse_undecoded_places(value)
        for path in value if isinstance(value, tuple) else (value,):
            if isinstance(path, Path):
                check_utf8(os.path.realpath(path))


def _options(command: Any) -> Iterator[tuple[Any, Field[Any], Any]]:
    """Yield the fields of a command and of all dataclasses in it: owner, field and value."""
    for field in fields(command):
        value = getattr(command, field.name)
        if is_dataclass(value):
            yield from _options(value)
        else:
            yield command, field, value


def _refuse_empty(command: Any) -> None:
    """Raise `InputError` for an option that takes several values, and was given without one."""
    for _, field, value in _options(command):
        if value == () and field.default != () and field.default_factory is MISSING:
            name = field.name.replace("_", "-")
            raise InputError(f"--{name} has no value: give one or more, or omit it. (--{name})")


def _refuse_file(command: Any) -> None:
    """Raise `InputError` if --out, or a folder above it, is a file where a folder has to be."""
    for owner, field, value in _options(command):
        if field.name == "out" and isinstance(value, Path):
            writes: Writes = getattr(owner, "writes", "folder")
            may_be_file = writes == "file" or (writes != "folder" and value.suffix == ".zip")
            for path in value.parents if may_be_file else (value, *value.parents):
                if os.path.exists(path) and not os.path.isdir(path):
                    problem = (
                        f"--out must be a {writes}, new or of the same run"
                        if path == value
                        else f"{value} cannot be written"
                    )
                    raise InputError(f"{path} is a file: {problem}. Choose another path. (--out)")


def parse(
    commands: Any,
    args: Sequence[str],
    *,
    program: str,
    about: str = "",
    others: Sequence[str] = (),
) -> Command:
    """Return the command of a command line (`main`).

    The chosen subcommand is parsed alone, because tyro suggests options of all that it knows.
    """
    import tyro

    def read(kind: Any, args: Sequence[str], **options: Any) -> Any:
        config = (tyro.conf.OmitSubcommandPrefixes,)
        return tyro.cli(kind, args=args, config=config, registry=_rules(args), **options)

    completing = any(arg.startswith("--tyro-") for arg in args)
    path = [] if completing else _path(commands, args, program, others)
    if not path:
        return read(commands, args, prog=program, description=about)
    *groups, kind = path
    chosen = kind.__metadata__[0]
    command = read(
        kind.__origin__,
        args[len(path) :],
        prog=" ".join([program, *args[: len(path)]]),
        description=chosen.description,
        default=chosen.default,
    )
    for around in reversed(groups):
        command = around.__origin__(command=command)
    return command


def _path(commands: Any, args: Sequence[str], program: str, others: Sequence[str]) -> list[Any]:
    """Return the subcommands that the first arguments name, if the last has no further ones.

    Raises `InputError` with a suggestion for an unknown name.
    """
    path: list[Any] = []
    for name in args:
        by_name = {kind.__metadata__[0].name: kind for kind in get_args(commands)}
        if not by_name or name.startswith("-"):
            break
        if name not in by_name:
            names = [*by_name, *(() if path else others)]
            words = " ".join([program, *args[: len(path)]])
            raise InputError(
                f"{words} has no command {name!r}.{meant(name, names)} All: {', '.join(names)}."
            )
        path.append(by_name[name])
        commands = get_type_hints(path[-1].__origin__, include_extras=True).get("command")
        if commands is None:
            return path
    return []


def _rules(args: Sequence[str]) -> ConstructorRegistry:
    """Return tyro's rule for our dataclasses: the help has a box for each of the `help_groups`.

    In a completion script a description is one line, so only its first line is kept there.
    """
    import tyro
    from tyro.constructors import (
        MISSING_NONPROP,
        ConstructorRegistry,
        StructConstructorSpec,
        StructFieldSpec,
    )

    registry = ConstructorRegistry()
    completing = any(arg.startswith("--tyro-") for arg in args)
    open_types: list[Any] = []

    def described(field: StructFieldSpec) -> StructFieldSpec:
        text = field.helptext() if callable(field.helptext) else field.helptext
        if field.default is None and "None" not in (text or ""):  # never written as None
            shown = tyro.conf.arg(help_behavior_hint="")
            kind: Any = Annotated[field.type, tyro.conf.DisallowNone, shown]
            field = replace(field, type=kind)
        if text is None:
            return field
        text = re.sub(r"\n\s*\n", "\n", text.strip())  # else tyro leaves two lines empty
        return replace(field, helptext=text.partition("\n")[0] if completing else text)

    @registry.struct_rule
    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        if (members := getattr(info.type, "help_members", None)) is not None:
            return StructConstructorSpec(instantiate=dict, fields=members)
        if not is_dataclass(info.type) or info.type in open_types:
            return None
        open_types.append(info.type)
        spec = ConstructorRegistry.get_struct_spec(info)
        open_types.pop()
        if not isinstance(spec, StructConstructorSpec):
            return None
        groups: Mapping[str, tuple[str, ...]] = getattr(info.type, "help_groups", {})
        fields = {field.name: described(field) for field in spec.fields}
        if "command" in fields:  # no prefix for a subcommand's options and their titles
            kind = Annotated[fields["command"].type, tyro.conf.arg(name="")]
            fields["command"] = replace(fields["command"], type=kind)
        boxes = []
        for title, names in groups.items():
            box = type(title, (), {"help_members": tuple(fields.pop(name) for name in names)})
            kind: Any = Annotated[box, tyro.conf.OmitArgPrefixes]
            boxes.append(StructFieldSpec(name=title, type=kind, default=MISSING_NONPROP))

        def make(**values: Any) -> Any:
            for title in groups:
                values |= values.pop(title)
            return spec.instantiate(**values)

        make.__doc__ = info.type.__doc__  # the first lines of the help
        nested = [field for field in fields.values() if is_dataclass(field.default)]
        single = [field for field in fields.values() if not is_dataclass(field.default)]
        return StructConstructorSpec(instantiate=make, fields=(*single, *boxes, *nested))

    return registry


def run_with_exit_codes(run: Callable[[], int]) -> int:
    """Run a command, printing exceptions as messages and returning their exit codes."""
    interrupts.begin()
    _escape_output()
    try:
        return run()
    except InputError as error:
        print(f"error: {printable(error)}", file=sys.stderr)
        return ExitCode.USAGE
    except CommandExit as early:
        print(printable(early), file=sys.stderr)
        return early.code
    except KeyboardInterrupt:
        interrupts.print_interrupted()
        return ExitCode.INTERRUPTED
    except Exception as error:
        if undecoded := undecoded_text(error):
            print(f"error: {printable(undecoded)}", file=sys.stderr)
            return ExitCode.USAGE
        if isinstance(error, BrokenPipeError) and _reader_ended():
            return ExitCode.FAILED
        if (reason := system_failure(error)) is not None:
            print(f"error: {printable(reason)}", file=sys.stderr)
        else:  # a bug: show where
            print(printable(traceback.format_exc()), end="", file=sys.stderr)
        return ExitCode.FAILED
    finally:
        _reader_ended()  # also after --help, which exits


def _escape_output() -> None:
    """Write what the encoding of stdout lacks as escapes, as Python does on stderr."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


def _reader_ended() -> bool:
    """Return True if the reader of stdout has exited, such as `head`; discard further output."""
    try:
        number = sys.stdout.fileno()
    except (
        AttributeError,
        OSError,
        ValueError,
    ):  # closed, or replaced by another object
        return False
    pipe = select.poll()
    pipe.register(number, 0)
    if not any(event & select.POLLERR for _, event in pipe.poll(0)):
        return False
    os.dup2(os.open(os.devnull, os.O_WRONLY), number)
    return True

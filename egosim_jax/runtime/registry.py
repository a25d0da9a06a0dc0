"""Parts by name that other packages may add: pipelines, solvers, metrics, recipes, readers.

A name is a built-in one, MODULE:NAME of any module that can be imported, or an entry point of an
installed package, in the group of the registry:

    [project.entry-points."egosim_jax.solvers"]
    heun = "my_package.solvers:Heun"
"""

from __future__ import annotations

import difflib
import importlib
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, is_dataclass
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

from egosim_jax.types import InputError

T = TypeVar("T")
C = TypeVar("C", bound=type)


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Parts of one kind by name, imported when they are used."""

    kind: str
    """Kind of the parts, for messages."""
    option: str
    """Option that names a part, for messages."""
    group: str
    """Group of the entry points."""
    built_in: Mapping[str, str] = field(default_factory=dict)
    """MODULE:NAME of the parts of this package, by name."""
    registered: dict[str, Any] = field(default_factory=dict)
    """Parts that `register` added, by name."""

    def register(self, name: str) -> Callable[[C], C]:
        """Return a decorator that registers a class under a name; the last one wins."""

        def add(part: C) -> C:
            self.registered[name] = part
            return part

        return add

    def names(self) -> tuple[str, ...]:
        """Return all names, sorted; parts of other modules also have a MODULE:NAME."""
        return tuple(sorted({*self.built_in, *self.registered, *self._entry_points()}))

    def get(self, name: str) -> T:
        """Return a part: what its module registers under the name, or has as attribute.

        Raises `InputError` with the closest name if the name is unknown.
        """
        if name in self.registered:
            return self.registered[name]
        known = {**self._entry_points(), **self.built_in}
        module, _, attribute = known.get(name, name).rpartition(":")
        title = f"{self.kind.capitalize()} {attribute[:80]!r}"
        if module.startswith("."):
            raise InputError(
                f"{title}: module {module[:80]!r} is relative; give its full name. ({self.option})"
            )
        if not module:
            close = difflib.get_close_matches(name, self.names(), n=1, cutoff=0)
            meant = f" Did you mean {close[0]!r}?" if close else ""
            raise InputError(
                f"There is no {self.kind} {name[:80]!r}.{meant} Known: "
                f"{', '.join((*self.names(), 'MODULE:NAME'))}. ({self.option})"
            )
        try:
            imported = importlib.import_module(module)
        except ModuleNotFoundError as error:
            raise InputError(
                f"{title}: module {error.name} cannot be imported. ({self.option})"
            ) from error
        part = self.registered.get(attribute, getattr(imported, attribute, None))
        if part is None:
            raise InputError(f"{title}: module {module} does not have it. ({self.option})")
        return part

    def parse(self, text: str) -> Any:
        """Return the part that a text such as `classical --motion.evidence 12` describes.

        A dataclass is made with the options, which are its fields; `NAME --help` lists them. A
        function without arguments is called.
        """
        try:
            name, *options = shlex.split(text) or [""]
        except ValueError as error:
            raise InputError(
                f"{self.kind.capitalize()} {text[:80]!r} is not a name with options: {error}. "
                f"({self.option})"
            ) from error
        part: Any = self.get(name)
        if isinstance(part, type) and is_dataclass(part):
            import tyro

            return tyro.cli(part, prog=f"{self.option} {name}", args=options)
        if options:
            raise InputError(f"{self.kind.capitalize()} {name!r} has no options. ({self.option})")
        return part() if callable(part) else part

    def _entry_points(self) -> dict[str, str]:
        return {point.name: point.value for point in entry_points(group=self.group)}

"""XML documents as trees, without document types, which can expand to gigabytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn
from xml.parsers import expat

from egosim_jax.io.bounded import quote_path, read_bytes, refusing
from egosim_jax.types import InputError

MAX_XML_BYTES = 16 << 20
"""Maximum size of an XML file in bytes."""


@dataclass
class Element:
    """Element of an XML document."""

    tag: str
    attributes: Mapping[str, str]
    children: list[Element] = field(default_factory=list)

    def find(self, tag: str) -> Element | None:
        """Return the first child of a tag."""
        return next((child for child in self.children if child.tag == tag), None)

    def all(self, tag: str) -> list[Element]:
        """Return the children of a tag."""
        return [child for child in self.children if child.tag == tag]


def parse_xml(path: Path) -> Element:
    """Return the root of an XML file without a document type."""
    name, stack = quote_path(path), [Element("", {})]

    def refuse(*_: Any) -> NoReturn:
        raise InputError(f"{name} has a document type, which no model needs: remove it.")

    def begin(tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes)
        stack[-1].children.append(element)
        stack.append(element)

    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler, parser.StartDoctypeDeclHandler = begin, refuse
    parser.EndElementHandler = lambda _: stack.pop()
    with refusing(f"{name} is not valid XML"):
        parser.Parse(read_bytes(path, limit=MAX_XML_BYTES), True)
    return stack[0].children[0]

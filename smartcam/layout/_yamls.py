"""YAML that others wrote, read within bounds: a few lines may stand for millions of values."""

from __future__ import annotations

import functools
from typing import Any

from smartcam import _extras
from smartcam.exceptions import ConfigurationError

MAX_YAML_TEXT = 1 << 23
"""Characters of a YAML document: a container of 1 MiB as hex takes a quarter."""

MAX_NODES = 500_000
"""Values of a YAML document, each alias and each merged mapping counted with all that it stands
for: 50,000 applications of a scenario. PyYAML reads this many in about 15 seconds."""

MAX_DEPTH = 50
"""Values of a YAML document that stand one in the other: ours have ten. PyYAML looks at all open
brackets for each token, and calls itself for each of them."""

MAX_BITS = 64
"""Bits of an integer at most: the largest that a container can hold.

Python takes seconds for the digits of much larger ones, or refuses.
"""

YAML_ALSO_RAISES = (ValueError, LookupError, AttributeError, OverflowError, RecursionError)
"""Exceptions that PyYAML raises beside its own, for a tag such as ``!!int`` without a value."""


class BadYamlError(ConfigurationError):
    """A document is no YAML, or goes beyond a bound.

    Attributes:
        line: where, from 1; None where that is not known.
    """

    def __init__(self, message: str, *, line: int | None = None) -> None:
        super().__init__(message)
        self.line = line


def load(text: str, *, what: str = "YAML") -> Any:
    """Return the data of a document; None for an empty one.

    ``what``: what needs PyYAML, for the error. Raises BadYamlError: it is no YAML, or goes beyond a
    bound; MissingExtraError: PyYAML is not installed.
    """
    root = compose(text, what=what)
    return None if root is None else construct(root)


def compose(text: str, *, what: str = "YAML") -> Any:
    """Return the node that a document is, which :func:`construct` makes data of; None: empty.

    Raises:
        BadYamlError: the text is no YAML, or goes beyond a bound.
        MissingExtraError: PyYAML is not installed.
    """
    yaml = yaml_module(what)
    if len(text) > MAX_YAML_TEXT:
        raise BadYamlError(f"{len(text)} characters, expected {MAX_YAML_TEXT} at most")
    try:
        return yaml.compose(text, _loader(yaml))
    except (yaml.YAMLError, *YAML_ALSO_RAISES) as exc:
        raise _told(exc) from exc


def construct(root: Any) -> Any:
    """Return the data of a node that :func:`compose` gave.

    Raises BadYamlError: its aliases stand for too much, or a value cannot be what its tag says.
    """
    yaml = yaml_module("YAML")
    loader = _loader(yaml)("")
    try:
        _count(root, {})
        return loader.construct_document(root)
    except (yaml.YAMLError, *YAML_ALSO_RAISES) as exc:
        raise _told(exc) from exc
    finally:
        loader.dispose()


def yaml_module(what: str) -> Any:
    """Return PyYAML; MissingExtraError: it is not installed."""
    return _extras.load("yaml", f"{what} needs")


def _told(exc: Exception) -> BadYamlError:
    if isinstance(exc, BadYamlError):
        return exc
    mark = getattr(exc, "problem_mark", None)
    text = getattr(exc, "problem", None) or (
        "nested too deep" if isinstance(exc, RecursionError) else str(exc)
    )
    return BadYamlError(text, line=None if mark is None else mark.line + 1)


def _count(node: Any, known: dict[int, int]) -> int:
    """Return the number of values that a node stands for, the aliases in it written out.

    Raises BadYamlError: too many, or it contains itself.
    """
    if node.id == "scalar":
        return 1
    found = known.get(id(node))
    if found == 0:
        raise BadYamlError("an alias of what it stands in", line=node.start_mark.line + 1)
    if found is None:
        known[id(node)] = 0  # under way
        children = (
            node.value if node.id == "sequence" else [one for row in node.value for one in row]
        )
        found = 1
        for child in children:
            found += _count(child, known)
            if found > MAX_NODES:
                raise BadYamlError(
                    f"expected {MAX_NODES} values at most, aliases counted with all that they "
                    "stand for",
                    line=child.start_mark.line + 1,
                )
        known[id(node)] = found
    return found


@functools.cache
def _loader(yaml: Any) -> Any:
    """Return PyYAML's safe loader with bounds."""

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        nodes = depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            self.nodes += 1
            if self.nodes > MAX_NODES:
                mark = self.peek_event().start_mark
                raise BadYamlError(f"expected {MAX_NODES} values at most", line=mark.line + 1)
            self.depth += 1
            if self.depth > MAX_DEPTH:
                raise self.too_deep()
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

        def fetch_flow_collection_start(self, token_class: Any) -> None:
            if self.flow_level >= MAX_DEPTH:
                raise self.too_deep()
            super().fetch_flow_collection_start(token_class)

        def add_indent(self, column: int) -> bool:
            if len(self.indents) > MAX_DEPTH:
                raise self.too_deep()
            added: bool = super().add_indent(column)
            return added

        def too_deep(self) -> BadYamlError:
            text = f"nested too deep: expected {MAX_DEPTH} values in each other at most"
            return BadYamlError(text, line=self.get_mark().line + 1)

        def construct_yaml_int(self, node: Any) -> int:
            text = self.construct_scalar(node)
            number = super().construct_yaml_int(node) if len(text) <= _MAX_DIGITS else None
            if number is None or number.bit_length() > MAX_BITS:
                raise BadYamlError(
                    f"the number {text[:20]}... of {len(text)} characters, expected {MAX_BITS} "
                    "bits at most",
                    line=node.start_mark.line + 1,
                )
            return int(number)

    Loader.add_constructor("tag:yaml.org,2002:int", Loader.construct_yaml_int)
    return Loader


_MAX_DIGITS = 200  # with underscores between them

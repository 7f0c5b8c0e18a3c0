"""Read YAML within limits, since a few lines with aliases may stand for millions of values."""

from __future__ import annotations

import functools
from typing import Any

from smartcam import _extras
from smartcam.exceptions import ConfigurationError

MAX_YAML_TEXT_CHARACTERS = 1 << 23
"""A YAML document has at most this many characters: a container of 1 MiB in hex takes a quarter."""

MAX_NODES = 500_000
"""Largest number of values of a YAML document, in which each alias and each merged mapping counts
with all its values: that is 50,000 applications of a scenario. PyYAML reads this many in about 15
seconds."""

MAX_DEPTH = 50
"""Largest depth of nested values of a YAML document; smartcam's files have ten levels. PyYAML
examines all open brackets for each token, and recurses for each of them."""

MAX_BITS = 64
"""Largest number of bits of an integer, as in a container.

Python takes seconds for the digits of much larger ones, or refuses.
"""

YAML_ALSO_RAISES = (ValueError, LookupError, AttributeError, OverflowError, RecursionError)
"""Exceptions that PyYAML raises in addition to its own, for a tag such as ``!!int`` without a
value."""


class BadYamlError(ConfigurationError):
    """A document is no YAML, or exceeds a bound.

    Attributes:
        line: line of the fault, from 1; None if it is not known.
    """

    def __init__(self, message: str, *, line: int | None = None) -> None:
        super().__init__(message)
        self.line = line


def load(text: str, *, label: str = "YAML") -> Any:
    """Return the data of a document; None for an empty one.

    ``label``: the feature that needs PyYAML, for the error. Raises BadYamlError if it is no YAML,
    or exceeds a bound; MissingExtraError if PyYAML is not installed.
    """
    root = compose(text, label=label)
    return None if root is None else construct(root)


def compose(text: str, *, label: str = "YAML") -> Any:
    """Return the node of a document, for :func:`construct`; None if it is empty.

    Raises:
        BadYamlError: the text is no YAML, or exceeds a bound.
        MissingExtraError: PyYAML is not installed.
    """
    yaml = yaml_module(label)
    if len(text) > MAX_YAML_TEXT_CHARACTERS:
        raise BadYamlError(f"{len(text)} characters, expected {MAX_YAML_TEXT_CHARACTERS} at most")
    try:
        return yaml.compose(text, _loader(yaml))
    except (yaml.YAMLError, *YAML_ALSO_RAISES) as exc:
        raise _as_bad_yaml(exc) from exc


def construct(root: Any) -> Any:
    """Return the data of a node from :func:`compose`.

    Raises BadYamlError if its aliases stand for too much, or a value does not match its tag.
    """
    yaml = yaml_module("YAML")
    loader = _loader(yaml)("")
    try:
        _count_values(root, {})
        return loader.construct_document(root)
    except (yaml.YAMLError, *YAML_ALSO_RAISES) as exc:
        raise _as_bad_yaml(exc) from exc
    finally:
        loader.dispose()


def yaml_module(label: str) -> Any:
    """Return PyYAML; raise MissingExtraError if it is not installed."""
    return _extras.load("yaml", f"{label} needs")


def _as_bad_yaml(exc: Exception) -> BadYamlError:
    if isinstance(exc, BadYamlError):
        return exc
    mark = getattr(exc, "problem_mark", None)
    text = getattr(exc, "problem", None) or (
        "nested too deep" if isinstance(exc, RecursionError) else str(exc)
    )
    return BadYamlError(text, line=None if mark is None else mark.line + 1)


def _count_values(node: Any, counts: dict[int, int]) -> int:
    """Return the number of values that a node stands for, with its aliases expanded.

    Raises BadYamlError if they are too many, or if the node contains itself.
    """
    if node.id == "scalar":
        return 1
    count = counts.get(id(node))
    if count == 0:
        raise BadYamlError(
            "an alias of a value that contains this alias", line=node.start_mark.line + 1
        )
    if count is None:
        counts[id(node)] = 0  # nodes that are being counted
        children = (
            node.value if node.id == "sequence" else [child for row in node.value for child in row]
        )
        count = 1
        for child in children:
            count += _count_values(child, counts)
            if count > MAX_NODES:
                raise BadYamlError(
                    f"expected {MAX_NODES} values at most, aliases counted with all that they "
                    "stand for",
                    line=child.start_mark.line + 1,
                )
        counts[id(node)] = count
    return count


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
                raise self.depth_error()
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

        def fetch_flow_collection_start(self, token_class: Any) -> None:
            if self.flow_level >= MAX_DEPTH:
                raise self.depth_error()
            super().fetch_flow_collection_start(token_class)

        def add_indent(self, column: int) -> bool:
            if len(self.indents) > MAX_DEPTH:
                raise self.depth_error()
            added: bool = super().add_indent(column)
            return added

        def depth_error(self) -> BadYamlError:
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

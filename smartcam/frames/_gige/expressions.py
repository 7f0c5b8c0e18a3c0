"""Parse formulas of GenICam descriptions, and evaluate them with numbers only.

A description comes from the camera, so its formulas are bounded in length and depth, cannot reach
anything of Python, and their integers stay within 64 bits.

Source: GenApi 2.0, section 2.8.13 (SwissKnife: operators and functions).
"""

from __future__ import annotations

import functools
import math
import operator
import re
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from smartcam.exceptions import MessageError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

Number: TypeAlias = "int | float"
Tree: TypeAlias = "tuple[str, tuple[Tree, ...]] | int | float | str"

MAX_FORMULA_CHARACTERS: Final = 8192
"""Largest number of characters of a formula."""

MAX_NAMES_SHOWN: Final = 20
"""Largest number of names of variables in an error."""

MAX_LEVELS: Final = 150
"""Largest depth of a formula's tree."""

_TOKEN: Final = re.compile(
    r"\s*(?:(?P<hex>0[xX][0-9a-fA-F]+)"
    r"|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_.]*)"
    r"|(?P<operator>\*\*|<<|>>|<=|>=|<>|!=|&&|\|\||[-+*/%&|^~<>=?:(),!]))"
)

_C_PRECEDENCE: Final = (
    ("||",),
    ("&&",),
    ("|",),
    ("^",),
    ("&",),
    ("=", "<>", "!="),
    ("<", ">", "<=", ">="),
    ("<<", ">>"),
    ("+", "-"),
    ("*", "/", "%"),
)
"""Binary operators by C's precedence, the lowest first; ``**`` has a higher precedence than all."""

_EMVA_PRECEDENCE: Final = (
    ("||", "&&", "=", "<>", "!=", "<", ">", "<=", ">="),
    ("+", "-"),
    ("*", "/", "%"),
    ("**",),
    ("<<", ">>"),
    ("&", "|", "^"),
)
"""Binary operators by the precedence of EMVA's GenApi, the lowest first, measured by its results
(genicam 1.6.0)."""


_TIGHTER_THAN_NOT: Final = frozenset({"&", "|", "^", "<<", ">>", "**"})
"""Operators after which EMVA's GenApi misreads ``~``."""


def _level_by_operator(levels: tuple[tuple[str, ...], ...]) -> dict[str, int]:
    return {symbol: level for level, symbols in enumerate(levels) for symbol in symbols}


_C_LEVELS = _level_by_operator(_C_PRECEDENCE)
_EMVA_LEVELS = _level_by_operator(_EMVA_PRECEDENCE)


def _wrap_to_64_bits(value: Number) -> int:
    """Return an integer wrapped to 64 bits with a sign."""
    unsigned = int(value) & 0xFFFFFFFFFFFFFFFF
    return unsigned - (1 << 64) if unsigned >> 63 else unsigned


def _divide(left: Number, right: Number) -> Number:
    # integers are divided towards zero, as in C
    if isinstance(left, int) and isinstance(right, int):
        quotient = abs(left) // abs(right)
        return quotient if (left < 0) == (right < 0) else -quotient
    return left / right


def _remainder(left: Number, right: Number) -> Number:
    if isinstance(left, int) and isinstance(right, int):
        remainder = abs(left) % abs(right)
        return -remainder if left < 0 else remainder
    return math.fmod(left, right)


def _power(left: Number, right: Number) -> Number:
    if isinstance(left, int) and isinstance(right, int) and right >= 0:
        if abs(left) > 1 and right * math.log2(abs(left)) >= 63:
            raise OverflowError("a power past 64 bits")
        return int(left**right)
    power = float(left) ** float(right)
    if isinstance(power, complex):
        raise ValueError("a root of a negative number")  # noqa: TRY004 - like math's functions
    return float(power)


def _round(value: Number, places: Number = 0) -> Number:
    scale = 10.0 ** max(-15, min(int(places), 15))
    return math.copysign(math.floor(abs(value) * scale + 0.5) / scale, value)


_BINARY: Final[Mapping[str, Callable[[Number, Number], Number]]] = {
    "|": lambda left, right: int(left) | int(right),
    "^": lambda left, right: int(left) ^ int(right),
    "&": lambda left, right: int(left) & int(right),
    "<<": lambda left, right: int(left) << (int(right) & 63),
    ">>": lambda left, right: int(left) >> (int(right) & 63),
    "=": operator.eq,
    "<>": operator.ne,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
    "<=": operator.le,
    ">=": operator.ge,
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": _divide,
    "%": _remainder,
    "**": _power,
}

_UNARY: Final[Mapping[str, Callable[[Number], Number]]] = {
    "-": operator.neg,
    "+": operator.pos,
    "~": lambda value: ~int(value),
    "!": lambda value: int(not value),
}

_FUNCTIONS: Final[Mapping[str, tuple[int, Callable[..., Any]]]] = {
    "ABS": (1, abs),
    "ACOS": (1, math.acos),
    "ASIN": (1, math.asin),
    "ATAN": (1, math.atan),
    "CEIL": (1, math.ceil),
    "COS": (1, math.cos),
    "EXP": (1, math.exp),
    "FLOOR": (1, math.floor),
    "LG": (1, math.log10),
    "LN": (1, math.log),
    "NEG": (1, operator.neg),
    "ROUND": (2, _round),
    "SGN": (1, lambda value: (value > 0) - (value < 0)),
    "SIN": (1, math.sin),
    "SQRT": (1, math.sqrt),
    "TAN": (1, math.tan),
    "TRUNC": (1, math.trunc),
}
"""Functions of formulas by name: the largest number of arguments, and the Python function."""

_CONSTANTS: Final = {"E": math.e, "PI": math.pi}


def evaluate(formula: str, variables: Mapping[str, Number], *, integers: bool) -> Number:
    """Evaluate a formula.

    EMVA's GenApi, with which makers test their descriptions, gives operators another precedence
    than C; other programs use C's. If the two give different values, the maker's intention is
    unknown.

    Args:
        formula: text of the formula in the description.
        variables: value of each name in it.
        integers: whether all numbers are integers, as in an ``IntSwissKnife``.

    Raises:
        MessageError: the formula is not valid, has an unknown name, or has no value: it divides by
            zero, a number exceeds its bounds, or the two readings give different values.
    """
    tree, emva_tree = _parse_both_ways(formula)
    value = _evaluate_tree(formula, tree, variables, integers)
    if emva_tree != tree:
        second = _evaluate_tree(formula, emva_tree, variables, integers)
        if second != value:
            raise MessageError(
                f"formula {formula[:80]!r}: expected one value, got {value:g} in C's order of "
                f"operators and {second:g} in that of EMVA's GenApi"
            )
    return value


def _evaluate_tree(
    formula: str, tree: Tree, variables: Mapping[str, Number], integers: bool
) -> Number:
    try:
        value = _value(tree, variables, integers)
        if not math.isfinite(value):
            raise OverflowError("not a finite number")
    except RecursionError as exc:
        raise MessageError(f"formula {formula[:80]!r}: too many levels") from exc
    except (ArithmeticError, ValueError) as exc:
        raise MessageError(f"formula {formula[:80]!r}: no value: {exc}") from exc
    return value


def _value(tree: Tree, variables: Mapping[str, Number], integers: bool) -> Number:
    if isinstance(tree, str):
        value = variables.get(tree, _CONSTANTS.get(tree))
        if value is None:
            raise MessageError(
                f"formula: unknown name {tree[:80]!r}; known are "
                f"{', '.join([*variables][:MAX_NAMES_SHOWN]) or 'none'}"
            )
        return _to_number_type(value, integers)
    if not isinstance(tree, tuple):
        return _to_number_type(tree, integers)
    symbol, operands = tree
    if symbol == "?":
        return _value(
            operands[1 if _value(operands[0], variables, integers) else 2], variables, integers
        )
    first = _value(operands[0], variables, integers)
    if symbol in ("||", "&&"):
        if bool(first) == (symbol == "||"):
            return int(bool(first))
        return int(bool(_value(operands[1], variables, integers)))
    values = [first, *(_value(operand, variables, integers) for operand in operands[1:])]
    if symbol in _FUNCTIONS:
        return _to_number_type(_FUNCTIONS[symbol][1](*values), integers)
    return _to_number_type(
        _UNARY[symbol](*values) if len(values) == 1 else _BINARY[symbol](*values), integers
    )


def _to_number_type(value: Number, integers: bool) -> Number:
    return _wrap_to_64_bits(value) if integers else float(value)


@functools.lru_cache(maxsize=1024)
def _parse_both_ways(formula: str) -> tuple[Tree, Tree]:
    """Return two trees of a formula: by C's precedence, and as EMVA's GenApi reads it."""
    try:
        return _FormulaParser(formula).parse(), _EmvaParser(formula).parse()
    except RecursionError as exc:
        raise MessageError(f"formula {formula[:80]!r}: too many levels") from exc


class _FormulaParser:
    """Parser of formulas with C's precedence."""

    levels = _C_LEVELS

    def __init__(self, formula: str) -> None:
        if len(formula) > MAX_FORMULA_CHARACTERS:
            raise MessageError(
                f"formula: expected at most {MAX_FORMULA_CHARACTERS} characters, got {len(formula)}"
            )
        self._formula = formula
        self._tokens = self._tokenize(formula)
        self._index = self._depth = 0

    def parse(self) -> Tree:
        tree = self._conditional()
        if self._index < len(self._tokens):
            raise self._syntax_error("an operator or the end")
        return tree

    def _tokenize(self, formula: str) -> list[tuple[str, str]]:
        tokens, index = [], 0
        end = len(formula.rstrip())
        while index < end:
            token = _TOKEN.match(formula, index)
            if token is None:
                raise MessageError(
                    f"formula {formula[:80]!r}: unexpected {formula[index]!r} at {index}"
                )
            kind = str(token.lastgroup)
            tokens.append((kind, token[kind]))
            index = token.end()
        return tokens

    def _syntax_error(self, expected: str) -> MessageError:
        actual = (
            repr(self._tokens[self._index][1]) if self._index < len(self._tokens) else "its end"
        )
        return MessageError(f"formula {self._formula[:80]!r}: expected {expected}, got {actual}")

    def _accept(self, *symbols: str) -> str | None:
        """Consume the next token if it is one of these operators; else return None."""
        if self._index < len(self._tokens):
            kind, symbol = self._tokens[self._index]
            if kind == "operator" and symbol in symbols:
                self._index += 1
                return symbol
        return None

    def _expect(self, symbol: str) -> None:
        if self._accept(symbol) is None:
            raise self._syntax_error(repr(symbol))

    def _conditional(self) -> Tree:
        self._depth += 1
        if self._depth > MAX_LEVELS:
            raise MessageError(f"formula: expected at most {MAX_LEVELS} levels")
        tree = self._operation(0)
        if self._accept("?"):
            first = self._conditional()
            self._expect(":")
            tree = ("?", (tree, first, self._conditional()))
        self._depth -= 1
        return tree

    def _operation(self, level: int) -> Tree:
        tree = self._unary()
        depth = 0
        while self._index < len(self._tokens):
            kind, symbol = self._tokens[self._index]
            own_level = self.levels.get(symbol, -1) if kind == "operator" else -1
            if own_level < level:
                break
            depth += 1
            if depth > MAX_LEVELS:
                raise MessageError(f"formula: expected at most {MAX_LEVELS} operators in a row")
            self._index += 1
            self._depth += 1
            tree = (symbol, (tree, self._operation(own_level + 1)))
            self._depth -= 1
        return tree

    def _unary(self) -> Tree:
        self._depth += 1
        if self._depth > MAX_LEVELS:
            raise MessageError(f"formula: expected at most {MAX_LEVELS} levels")
        symbol = self._accept("-", "+", "~", "!")
        tree = (symbol, (self._unary(),)) if symbol else self._power()
        self._depth -= 1
        return tree

    def _power(self) -> Tree:
        tree = self._atom()
        if self._accept("**"):
            tree = ("**", (tree, self._unary()))
        return tree

    def _atom(self) -> Tree:
        if self._accept("("):
            tree = self._conditional()
            self._expect(")")
            return tree
        if self._index == len(self._tokens) or self._tokens[self._index][0] == "operator":
            raise self._syntax_error("a number, a name or '('")
        kind, token = self._tokens[self._index]
        self._index += 1
        if kind == "hex":
            return int(token, 16)
        if kind == "number":
            return int(token) if token.isdigit() and len(token) <= 20 else float(token)
        if token in _FUNCTIONS and self._accept("("):
            return self._call(token)
        return token

    def _call(self, name: str) -> Tree:
        arguments = [self._conditional()]
        while self._accept(","):
            arguments.append(self._conditional())
        self._expect(")")
        if len(arguments) > _FUNCTIONS[name][0]:
            raise MessageError(f"formula: {name} has {len(arguments)} arguments")
        return (name, tuple(arguments))


class _EmvaParser(_FormulaParser):
    """Parser of formulas that reads them like EMVA's GenApi.

    A minus before a name or a number has a higher precedence than any operator. A minus before a
    parenthesis or a function applies to everything after it, and is misread except at the start. In
    nested conditionals the first condition decides.
    """

    levels = _EMVA_LEVELS

    def _conditional(self) -> Tree:
        self._depth += 1
        if self._depth > MAX_LEVELS:
            raise MessageError(f"formula: expected at most {MAX_LEVELS} levels")
        tree = self._operation(0)
        for _ in range(MAX_LEVELS):
            if not self._accept("?"):
                break
            first = self._conditional()
            self._expect(":")
            tree = ("?", (tree, first, self._operation(0)))
        self._depth -= 1
        return tree

    def _unary(self) -> Tree:
        index = self._index
        before = self._tokens[index - 1][1] if index else "("
        if before in _TIGHTER_THAN_NOT and self._accept("~"):
            raise self._misread_error(before, "~")
        if self._accept("-"):
            if self._index < len(self._tokens) and self._starts_group(self._index):
                if index:
                    raise self._misread_error(before, "-(")
                self._depth += 1
                if self._depth > MAX_LEVELS:
                    raise MessageError(f"formula: expected at most {MAX_LEVELS} levels")
                tree: Tree = ("-", (self._operation(0),))
                self._depth -= 1
                return tree
            self._index = index
        return super()._unary()

    def _misread_error(self, before: str, symbol: str) -> MessageError:
        return MessageError(
            f"formula {self._formula[:80]!r}: expected a value after {before}, got {symbol}, which "
            "EMVA's GenApi misreads there"
        )

    def _starts_group(self, index: int) -> bool:
        """Return True if a parenthesis or a function begins at a token."""
        following = self._tokens[index + 1] if index + 1 < len(self._tokens) else ("", "")
        return self._tokens[index][1] == "(" or following == ("operator", "(")

    def _power(self) -> Tree:
        return self._atom()

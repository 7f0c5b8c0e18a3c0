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

_LEVELS_OF_C: Final = (
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
"""Binary operators by C's precedence, the lowest first; ``**`` binds tighter than all."""

_LEVELS_OF_EMVA: Final = (
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


def _strength(levels: tuple[tuple[str, ...], ...]) -> dict[str, int]:
    return {sign: level for level, signs in enumerate(levels) for sign in signs}


_OF_C, _OF_EMVA = _strength(_LEVELS_OF_C), _strength(_LEVELS_OF_EMVA)


def _wrapped(value: Number) -> int:
    """Return an integer wrapped to 64 bits with a sign."""
    unsigned = int(value) & 0xFFFFFFFFFFFFFFFF
    return unsigned - (1 << 64) if unsigned >> 63 else unsigned


def _divided(left: Number, right: Number) -> Number:
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


def _rounded(value: Number, places: Number = 0) -> Number:
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
    "/": _divided,
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
    "ROUND": (2, _rounded),
    "SGN": (1, lambda value: (value > 0) - (value < 0)),
    "SIN": (1, math.sin),
    "SQRT": (1, math.sqrt),
    "TAN": (1, math.tan),
    "TRUNC": (1, math.trunc),
}
"""Functions of formulas by name: the largest number of arguments, and the Python function."""

_CONSTANTS: Final = {"E": math.e, "PI": math.pi}


def evaluate(formula: str, variables: Mapping[str, Number], *, integral: bool) -> Number:
    """Evaluate a formula.

    EMVA's GenApi, with which makers test their descriptions, gives operators another precedence
    than C; other programs use C's. If the two give different values, the maker's intention is
    unknown.

    Args:
        formula: text of the formula in the description.
        variables: value of each name in it.
        integral: whether all numbers are integers, as in an ``IntSwissKnife``.

    Raises:
        MessageError: the formula is not valid, has an unknown name, or has no value: it divides by
            zero, a number exceeds its bounds, or the two readings give different values.
    """
    tree, other = _parsed(formula)
    value = _worked_out(formula, tree, variables, integral)
    if other != tree:
        second = _worked_out(formula, other, variables, integral)
        if second != value:
            raise MessageError(
                f"formula {formula[:80]!r}: expected one value, got {value:g} in C's order of "
                f"operators and {second:g} in that of EMVA's GenApi"
            )
    return value


def _worked_out(
    formula: str, tree: Tree, variables: Mapping[str, Number], integral: bool
) -> Number:
    try:
        value = _value(tree, variables, integral)
        if not math.isfinite(value):
            raise OverflowError("not a finite number")
    except RecursionError as exc:
        raise MessageError(f"formula {formula[:80]!r}: too many levels") from exc
    except (ArithmeticError, ValueError) as exc:
        raise MessageError(f"formula {formula[:80]!r}: no value: {exc}") from exc
    return value


def _value(tree: Tree, variables: Mapping[str, Number], integral: bool) -> Number:
    if isinstance(tree, str):
        value = variables.get(tree, _CONSTANTS.get(tree))
        if value is None:
            raise MessageError(
                f"formula: unknown name {tree[:80]!r}; known are "
                f"{', '.join([*variables][:MAX_NAMES_SHOWN]) or 'none'}"
            )
        return _bounded(value, integral)
    if not isinstance(tree, tuple):
        return _bounded(tree, integral)
    sign, parts = tree
    if sign == "?":
        return _value(parts[1 if _value(parts[0], variables, integral) else 2], variables, integral)
    first = _value(parts[0], variables, integral)
    if sign in ("||", "&&"):
        if bool(first) == (sign == "||"):
            return int(bool(first))
        return int(bool(_value(parts[1], variables, integral)))
    values = [first, *(_value(part, variables, integral) for part in parts[1:])]
    if sign in _FUNCTIONS:
        return _bounded(_FUNCTIONS[sign][1](*values), integral)
    return _bounded(_UNARY[sign](*values) if len(values) == 1 else _BINARY[sign](*values), integral)


def _bounded(value: Number, integral: bool) -> Number:
    return _wrapped(value) if integral else float(value)


@functools.lru_cache(maxsize=1024)
def _parsed(formula: str) -> tuple[Tree, Tree]:
    """Return the tree of a formula by C's precedence, and that by EMVA's GenApi."""
    try:
        return _FormulaParser(formula).parsed(), _EmvaParser(formula).parsed()
    except RecursionError as exc:
        raise MessageError(f"formula {formula[:80]!r}: too many levels") from exc


class _FormulaParser:
    """Parser of formulas with C's precedence."""

    strength = _OF_C

    def __init__(self, formula: str) -> None:
        if len(formula) > MAX_FORMULA_CHARACTERS:
            raise MessageError(
                f"formula: expected at most {MAX_FORMULA_CHARACTERS} characters, got {len(formula)}"
            )
        self._formula = formula
        self._tokens = self._cut(formula)
        self._at = self._depth = 0

    def parsed(self) -> Tree:
        tree = self._choice()
        if self._at < len(self._tokens):
            raise self._syntax_error("an operator or the end")
        return tree

    def _cut(self, formula: str) -> list[tuple[str, str]]:
        tokens, at = [], 0
        end = len(formula.rstrip())
        while at < end:
            token = _TOKEN.match(formula, at)
            if token is None:
                raise MessageError(f"formula {formula[:80]!r}: unexpected {formula[at]!r} at {at}")
            kind = str(token.lastgroup)
            tokens.append((kind, token[kind]))
            at = token.end()
        return tokens

    def _syntax_error(self, expected: str) -> MessageError:
        actual = repr(self._tokens[self._at][1]) if self._at < len(self._tokens) else "its end"
        return MessageError(f"formula {self._formula[:80]!r}: expected {expected}, got {actual}")

    def _next(self, *signs: str) -> str | None:
        """Consume one of these operators if it is next."""
        if self._at < len(self._tokens):
            kind, sign = self._tokens[self._at]
            if kind == "operator" and sign in signs:
                self._at += 1
                return sign
        return None

    def _expect(self, sign: str) -> None:
        if self._next(sign) is None:
            raise self._syntax_error(repr(sign))

    def _choice(self) -> Tree:
        self._depth += 1
        if self._depth > MAX_LEVELS:
            raise MessageError(f"formula: expected at most {MAX_LEVELS} levels")
        tree = self._operation(0)
        if self._next("?"):
            first = self._choice()
            self._expect(":")
            tree = ("?", (tree, first, self._choice()))
        self._depth -= 1
        return tree

    def _operation(self, level: int) -> Tree:
        tree = self._unary()
        depth = 0
        while self._at < len(self._tokens):
            kind, sign = self._tokens[self._at]
            strength = self.strength.get(sign, -1) if kind == "operator" else -1
            if strength < level:
                break
            depth += 1
            if depth > MAX_LEVELS:
                raise MessageError(f"formula: expected at most {MAX_LEVELS} operators in a row")
            self._at += 1
            self._depth += 1
            tree = (sign, (tree, self._operation(strength + 1)))
            self._depth -= 1
        return tree

    def _unary(self) -> Tree:
        self._depth += 1
        if self._depth > MAX_LEVELS:
            raise MessageError(f"formula: expected at most {MAX_LEVELS} levels")
        sign = self._next("-", "+", "~", "!")
        tree = (sign, (self._unary(),)) if sign else self._power()
        self._depth -= 1
        return tree

    def _power(self) -> Tree:
        tree = self._atom()
        if self._next("**"):
            tree = ("**", (tree, self._unary()))
        return tree

    def _atom(self) -> Tree:
        if self._next("("):
            tree = self._choice()
            self._expect(")")
            return tree
        if self._at == len(self._tokens) or self._tokens[self._at][0] == "operator":
            raise self._syntax_error("a number, a name or '('")
        kind, token = self._tokens[self._at]
        self._at += 1
        if kind == "hex":
            return int(token, 16)
        if kind == "number":
            return int(token) if token.isdigit() and len(token) <= 20 else float(token)
        if token in _FUNCTIONS and self._next("("):
            return self._call(token)
        return token

    def _call(self, name: str) -> Tree:
        parts = [self._choice()]
        while self._next(","):
            parts.append(self._choice())
        self._expect(")")
        if len(parts) > _FUNCTIONS[name][0]:
            raise MessageError(f"formula: {name} has {len(parts)} arguments")
        return (name, tuple(parts))


class _EmvaParser(_FormulaParser):
    """Parser of formulas that reads them like EMVA's GenApi.

    A sign before a name or a number binds tighter than any operator. A minus before a parenthesis
    or a function applies to everything after it, and is misread except at the start. In nested
    choices the first condition decides.
    """

    strength = _OF_EMVA

    def _choice(self) -> Tree:
        self._depth += 1
        if self._depth > MAX_LEVELS:
            raise MessageError(f"formula: expected at most {MAX_LEVELS} levels")
        tree = self._operation(0)
        for _ in range(MAX_LEVELS):
            if not self._next("?"):
                break
            first = self._choice()
            self._expect(":")
            tree = ("?", (tree, first, self._operation(0)))
        self._depth -= 1
        return tree

    def _unary(self) -> Tree:
        at = self._at
        before = self._tokens[at - 1][1] if at else "("
        if before in _TIGHTER_THAN_NOT and self._next("~"):
            raise self._misread_error(before, "~")
        if self._next("-"):
            if self._at < len(self._tokens) and self._is_whole(self._at):
                if at:
                    raise self._misread_error(before, "-(")
                self._depth += 1
                if self._depth > MAX_LEVELS:
                    raise MessageError(f"formula: expected at most {MAX_LEVELS} levels")
                tree: Tree = ("-", (self._operation(0),))
                self._depth -= 1
                return tree
            self._at = at
        return super()._unary()

    def _misread_error(self, before: str, sign: str) -> MessageError:
        return MessageError(
            f"formula {self._formula[:80]!r}: expected a value after {before}, got {sign}, which "
            "EMVA's GenApi misreads there"
        )

    def _is_whole(self, at: int) -> bool:
        """Return True if a parenthesis or a function begins at a token."""
        following = self._tokens[at + 1] if at + 1 < len(self._tokens) else ("", "")
        return self._tokens[at][1] == "(" or following == ("operator", "(")

    def _power(self) -> Tree:
        return self._atom()

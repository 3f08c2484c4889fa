"""Expressions in ``x`` of non-linear couplings (``nlFunPos``), with exact derivatives.

The grammar, in the syntax of muParser, whose ``^`` binds tighter than a sign and to the right::

    sum     = product { ("+" | "-") product }
    product = signed { ("*" | "/") signed }
    signed  = { "+" | "-" } power
    power   = atom [ "^" { "+" | "-" } power ]
    atom    = number | "x" | constant | function "(" sum { "," sum } ")" | "(" sum ")"

Nothing else is understood, and nothing is ever handed to Python's ``eval``. Values come with the
derivative by the chain rule (forward mode).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import reduce
from typing import Final

import numpy as np

from rtee.errors import ExpressionError
from rtee.types import FloatArray

MAX_LENGTH: Final = 4000
MAX_DEPTH: Final = 50

_TOKEN = re.compile(
    r"\s*(?:(\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?)|([A-Za-z_]\w*)|(\S))"
)
_CONSTANTS: Final = {"_pi": math.pi, "pi": math.pi, "_e": math.e, "e": math.e}

Dual = tuple[float, float]
_Value = Callable[[float], float]
_Pair = Callable[[float], Dual]

# name: (value, derivative), after the usual rules of differentiation
_FUNCTIONS: Final[dict[str, tuple[_Value, _Value]]] = {
    "sin": (math.sin, math.cos),
    "cos": (math.cos, lambda a: -math.sin(a)),
    "tan": (math.tan, lambda a: 1.0 + math.tan(a) ** 2),
    "asin": (math.asin, lambda a: 1.0 / math.sqrt(1.0 - a * a)),
    "acos": (math.acos, lambda a: -1.0 / math.sqrt(1.0 - a * a)),
    "atan": (math.atan, lambda a: 1.0 / (1.0 + a * a)),
    "sinh": (math.sinh, math.cosh),
    "cosh": (math.cosh, math.sinh),
    "tanh": (math.tanh, lambda a: 1.0 - math.tanh(a) ** 2),
    "asinh": (math.asinh, lambda a: 1.0 / math.sqrt(a * a + 1.0)),
    "acosh": (math.acosh, lambda a: 1.0 / math.sqrt(a * a - 1.0)),
    "atanh": (math.atanh, lambda a: 1.0 / (1.0 - a * a)),
    "exp": (math.exp, math.exp),
    "ln": (math.log, lambda a: 1.0 / a),
    "log": (math.log, lambda a: 1.0 / a),
    "log2": (math.log2, lambda a: 1.0 / (a * math.log(2.0))),
    "log10": (math.log10, lambda a: 1.0 / (a * math.log(10.0))),
    "sqrt": (math.sqrt, lambda a: 0.5 / math.sqrt(a)),
    "abs": (abs, lambda a: math.copysign(1.0, a) if a else 0.0),
}
_CHOICES: Final = {"min": min, "max": max}


class _Node:
    """A part of an expression: its value, and its value with its derivative."""

    __slots__ = ("constant", "pair", "value")

    def __init__(self, value: _Value, pair: _Pair, constant: bool) -> None:
        self.value = value
        self.pair = pair
        self.constant = constant


class Expression:
    """A function of one variable, read from text.

    Attributes:
        text: The text it was read from.
    """

    def __init__(self, text: str) -> None:
        """Read an expression.

        Raises:
            ExpressionError: The text is outside the grammar; ``column`` points at the place.
        """
        self.text = text
        self._node = _Parser(text).parse()

    def __call__(self, x: float) -> float:
        """Return the value at ``x``; ``nan`` where it is not defined."""
        try:
            return self._node.value(x)
        except (ArithmeticError, ValueError):
            return math.nan

    def dual(self, x: float) -> Dual:
        """Return the value and the derivative at ``x``; ``nan`` where they are not defined."""
        try:
            return self._node.pair(x)
        except (ArithmeticError, ValueError):
            return math.nan, math.nan

    def derivative(self, x: float) -> float:
        """Return the derivative at ``x``; ``nan`` where it is not defined."""
        return self.dual(x)[1]

    def values(self, x: FloatArray) -> FloatArray:
        """Return the values at many points, in the shape of ``x``."""
        return np.array([self(v) for v in x.ravel().tolist()]).reshape(x.shape)

    def __repr__(self) -> str:
        return f"Expression({self.text!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Expression) and other.text == self.text

    def __hash__(self) -> int:
        return hash(self.text)


class _Parser:
    """Recursive descent over the grammar in the module's docstring."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.depth = 0
        self.tokens: list[tuple[str, str, int]] = []
        self.at = 0

    def parse(self) -> _Node:
        if len(self.text) > MAX_LENGTH:
            raise ExpressionError(f"the expression is longer than {MAX_LENGTH} characters")
        self.tokens = self._split()
        if not self.tokens:
            raise ExpressionError("the expression is empty")
        node = self._sum()
        if self.at < len(self.tokens):
            raise self._unexpected()
        return node

    def _split(self) -> list[tuple[str, str, int]]:
        tokens = []
        for match in _TOKEN.finditer(self.text.rstrip()):
            number, name, symbol = match.groups()
            if number:
                tokens.append(("number", number, match.start(1)))
            elif name:
                tokens.append(("name", name, match.start(2)))
            else:
                tokens.append(("symbol", symbol, match.start(3)))
        return tokens

    def _peek(self) -> str:
        return self.tokens[self.at][1] if self.at < len(self.tokens) else ""

    def _take(self, *symbols: str) -> str:
        """Consume the next token if it is one of the symbols."""
        token = self._peek()
        if token and token in symbols:
            self.at += 1
            return token
        return ""

    def _unexpected(self) -> ExpressionError:
        if self.at < len(self.tokens):
            _, token, column = self.tokens[self.at]
            return ExpressionError(
                f"unexpected '{token[:20]}' at column {column + 1} of '{_short(self.text)}'",
                column=column,
            )
        return ExpressionError(
            f"'{_short(self.text)}' ends where a value or ')' should follow",
            column=len(self.text),
        )

    def _sum(self) -> _Node:
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise ExpressionError(f"the expression is nested deeper than {MAX_DEPTH}")
        terms = [self._product()]
        while sign := self._take("+", "-"):
            term = self._product()
            terms.append(_negated(term) if sign == "-" else term)
        self.depth -= 1
        return _sum_of(terms)

    def _product(self) -> _Node:
        factors = [self._signed()]
        while sign := self._take("*", "/"):
            factor = self._signed()
            factors.append(_inverted(factor) if sign == "/" else factor)
        return _product_of(factors)

    def _signed(self) -> _Node:
        negative = self._signs()
        node = self._power()
        return _negated(node) if negative else node

    def _signs(self) -> bool:
        negative = False
        while sign := self._take("+", "-"):
            negative ^= sign == "-"
        return negative

    def _power(self) -> _Node:
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise ExpressionError(f"the expression is nested deeper than {MAX_DEPTH}")
        node = self._atom()
        if self._take("^"):
            negative = self._signs()
            exponent = self._power()
            node = _power_of(node, _negated(exponent) if negative else exponent)
        self.depth -= 1
        return node

    def _atom(self) -> _Node:
        if self.at >= len(self.tokens):
            raise self._unexpected()
        kind, token, column = self.tokens[self.at]
        if kind == "number":
            self.at += 1
            return _constant(self._finite(token, column))
        if kind == "name":
            self.at += 1
            return self._named(token, column)
        if self._take("("):
            node = self._sum()
            self._close()
            return node
        raise self._unexpected()

    def _finite(self, token: str, column: int) -> float:
        value = float(token)
        if math.isinf(value):
            raise ExpressionError(
                f"the number '{token[:20]}' at column {column + 1} is too large", column=column
            )
        return value

    def _named(self, name: str, column: int) -> _Node:
        if name == "x":
            return _Node(lambda x: x, lambda x: (x, 1.0), constant=False)
        if name in _CONSTANTS:
            return _constant(_CONSTANTS[name])
        if name not in _FUNCTIONS and name not in _CHOICES:
            known = ", ".join([*sorted(_FUNCTIONS), *_CHOICES, *_CONSTANTS])
            raise ExpressionError(
                f"unknown '{name[:40]}' at column {column + 1}; there are x, {known}",
                column=column,
            )
        if not self._take("("):
            raise self._unexpected()
        arguments = [self._sum()]
        while name in _CHOICES and self._take(","):
            arguments.append(self._sum())
        self._close()
        if name in _CHOICES:
            return _choice(_CHOICES[name], arguments)
        return _function(*_FUNCTIONS[name], arguments[0])

    def _close(self) -> None:
        if not self._take(")"):
            raise self._unexpected()


def _short(text: str) -> str:
    return text if len(text) <= 60 else text[:59] + "…"


def _constant(value: float) -> _Node:
    return _Node(lambda _x: value, lambda _x: (value, 0.0), constant=True)


def _folded(node: _Node) -> _Node:
    """Return a constant for a part that does not depend on ``x``."""
    if not node.constant:
        return node
    try:
        return _constant(node.value(0.0))
    except (ArithmeticError, ValueError) as error:
        raise ExpressionError(f"a constant part of the expression has no value: {error}") from None


def _negated(node: _Node) -> _Node:
    value, pair = node.value, node.pair

    def dual(x: float) -> Dual:
        a, da = pair(x)
        return -a, -da

    return _folded(_Node(lambda x: -value(x), dual, node.constant))


def _inverted(node: _Node) -> _Node:
    value, pair = node.value, node.pair

    def dual(x: float) -> Dual:
        a, da = pair(x)
        return 1.0 / a, -da / (a * a)

    return _folded(_Node(lambda x: 1.0 / value(x), dual, node.constant))


def _sum_of(terms: list[_Node]) -> _Node:
    if len(terms) == 1:
        return terms[0]
    values = [term.value for term in terms]
    pairs = [term.pair for term in terms]

    def dual(x: float) -> Dual:
        found = [pair(x) for pair in pairs]
        return math.fsum(a for a, _ in found), math.fsum(da for _, da in found)

    return _folded(
        _Node(lambda x: math.fsum([value(x) for value in values]), dual, _all_constant(terms))
    )


def _product_of(factors: list[_Node]) -> _Node:
    if len(factors) == 1:
        return factors[0]
    values = [factor.value for factor in factors]
    pairs = [factor.pair for factor in factors]

    def value_of(x: float) -> float:
        product = 1.0
        for value in values:
            product *= value(x)
        return product

    def dual(x: float) -> Dual:
        product, slope = 1.0, 0.0
        for pair in pairs:
            a, da = pair(x)
            slope = slope * a + product * da
            product *= a
        return product, slope

    return _folded(_Node(value_of, dual, _all_constant(factors)))


def _power_of(base: _Node, exponent: _Node) -> _Node:
    base_value, base_pair = base.value, base.pair
    if exponent.constant:
        power = exponent.value(0.0)

        def value_of(x: float) -> float:
            return math.pow(base_value(x), power)

        def dual(x: float) -> Dual:
            a, da = base_pair(x)
            slope = power * math.pow(a, power - 1.0) if power else 0.0
            return math.pow(a, power), slope * da

        return _folded(_Node(value_of, dual, base.constant))

    exponent_value, exponent_pair = exponent.value, exponent.pair

    def value_at(x: float) -> float:
        return math.pow(base_value(x), exponent_value(x))

    def dual_at(x: float) -> Dual:
        a, da = base_pair(x)
        b, db = exponent_pair(x)
        value = math.pow(a, b)
        slope = value * math.log(a) * db if db else 0.0
        if da:
            slope += b * math.pow(a, b - 1.0) * da
        return value, slope

    return _Node(value_at, dual_at, constant=False)


def _function(function: _Value, derivative: _Value, argument: _Node) -> _Node:
    value, pair = argument.value, argument.pair

    def dual(x: float) -> Dual:
        a, da = pair(x)
        return function(a), derivative(a) * da

    return _folded(_Node(lambda x: function(value(x)), dual, argument.constant))


def _choice(choose: Callable[[Dual, Dual], Dual], arguments: list[_Node]) -> _Node:
    pairs = [argument.pair for argument in arguments]

    def dual(x: float) -> Dual:
        return reduce(choose, [pair(x) for pair in pairs])

    return _folded(_Node(lambda x: dual(x)[0], dual, _all_constant(arguments)))


def _all_constant(nodes: list[_Node]) -> bool:
    return all(node.constant for node in nodes)

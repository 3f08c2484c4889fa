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
from typing import Final

import numpy as np

from rtee.errors import ExpressionError
from rtee.hand.derivative import (
    CHOICES,
    CONSTANTS,
    FUNCTIONS,
    Dual,
    Node,
    choice,
    constant,
    function,
    inverted,
    negated,
    power_of,
    product_of,
    sum_of,
    variable,
)
from rtee.types import FloatArray

MAX_LENGTH: Final = 4000
MAX_DEPTH: Final = 50

_TOKEN = re.compile(
    r"\s*(?:(\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?)|([A-Za-z_]\w*)|(\S))"
)


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

    def parse(self) -> Node:
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

    def _sum(self) -> Node:
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise ExpressionError(f"the expression is nested deeper than {MAX_DEPTH}")
        terms = [self._product()]
        while sign := self._take("+", "-"):
            term = self._product()
            terms.append(negated(term) if sign == "-" else term)
        self.depth -= 1
        return sum_of(terms)

    def _product(self) -> Node:
        factors = [self._signed()]
        while sign := self._take("*", "/"):
            factor = self._signed()
            factors.append(inverted(factor) if sign == "/" else factor)
        return product_of(factors)

    def _signed(self) -> Node:
        negative = self._signs()
        node = self._power()
        return negated(node) if negative else node

    def _signs(self) -> bool:
        negative = False
        while sign := self._take("+", "-"):
            negative ^= sign == "-"
        return negative

    def _power(self) -> Node:
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise ExpressionError(f"the expression is nested deeper than {MAX_DEPTH}")
        node = self._atom()
        if self._take("^"):
            negative = self._signs()
            exponent = self._power()
            node = power_of(node, negated(exponent) if negative else exponent)
        self.depth -= 1
        return node

    def _atom(self) -> Node:
        if self.at >= len(self.tokens):
            raise self._unexpected()
        kind, token, column = self.tokens[self.at]
        if kind == "number":
            self.at += 1
            return constant(self._finite(token, column))
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

    def _named(self, name: str, column: int) -> Node:
        if name == "x":
            return variable()
        if name in CONSTANTS:
            return constant(CONSTANTS[name])
        if name not in FUNCTIONS and name not in CHOICES:
            known = ", ".join([*sorted(FUNCTIONS), *CHOICES, *CONSTANTS])
            raise ExpressionError(
                f"unknown '{name[:40]}' at column {column + 1}; there are x, {known}",
                column=column,
            )
        if not self._take("("):
            raise self._unexpected()
        arguments = [self._sum()]
        while name in CHOICES and self._take(","):
            arguments.append(self._sum())
        self._close()
        if name in CHOICES:
            return choice(CHOICES[name], arguments)
        return function(*FUNCTIONS[name], arguments[0])

    def _close(self) -> None:
        if not self._take(")"):
            raise self._unexpected()


def _short(text: str) -> str:
    return text if len(text) <= 60 else text[:59] + "…"

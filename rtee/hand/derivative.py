"""Functions of one variable with exact derivatives, put together from parts (forward mode)."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce
from typing import Final

from rtee.errors import ExpressionError

CONSTANTS: Final = {"_pi": math.pi, "pi": math.pi, "_e": math.e, "e": math.e}

MAX_POWER: Final = 100
"""Highest power of ``x`` in a polynomial."""

Dual = tuple[float, float]
Terms = dict[int, float]
_Value = Callable[[float], float]
_Pair = Callable[[float], Dual]

# name: (value, derivative), after the usual rules of differentiation
FUNCTIONS: Final[dict[str, tuple[_Value, _Value]]] = {
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
CHOICES: Final = {"min": min, "max": max}


class Node:
    """A part of an expression.

    Attributes:
        value: Its value at ``x``.
        pair: Its value and its derivative at ``x``.
        constant: Whether it does not depend on ``x``.
        terms: Its coefficients by power, if it is written as a sum of powers of ``x``.
    """

    __slots__ = ("constant", "pair", "terms", "value")

    def __init__(
        self, value: _Value, pair: _Pair, constant: bool, terms: Terms | None = None
    ) -> None:
        self.value = value
        self.pair = pair
        self.constant = constant
        self.terms = terms


def variable() -> Node:
    """Return ``x``."""
    return Node(lambda x: x, lambda x: (x, 1.0), constant=False, terms={1: 1.0})


def constant(value: float) -> Node:
    """Return a number."""
    return Node(lambda _x: value, lambda _x: (value, 0.0), constant=True, terms={0: value})


def negated(node: Node) -> Node:
    """Return ``-node``."""
    if node.terms is not None:
        return _polynomial({power: -factor for power, factor in node.terms.items()})
    value, pair = node.value, node.pair

    def dual(x: float) -> Dual:
        a, da = pair(x)
        return -a, -da

    return _folded(Node(lambda x: -value(x), dual, node.constant))


def inverted(node: Node) -> Node:
    """Return ``1 / node``."""
    value, pair = node.value, node.pair

    def dual(x: float) -> Dual:
        a, da = pair(x)
        return 1.0 / a, -da / (a * a)

    return _folded(Node(lambda x: 1.0 / value(x), dual, node.constant))


def sum_of(parts: list[Node]) -> Node:
    """Return the sum of parts."""
    if len(parts) == 1:
        return parts[0]
    if all(part.terms is not None for part in parts):
        total: Terms = {}
        for part in parts:
            for power, factor in (part.terms or {}).items():
                total[power] = total.get(power, 0.0) + factor
        return _polynomial(total)
    values = [part.value for part in parts]
    pairs = [part.pair for part in parts]

    def dual(x: float) -> Dual:
        found = [pair(x) for pair in pairs]
        return math.fsum(a for a, _ in found), math.fsum(da for _, da in found)

    return _folded(
        Node(lambda x: math.fsum([value(x) for value in values]), dual, _all_constant(parts))
    )


def product_of(factors: list[Node]) -> Node:
    """Return the product of factors."""
    if len(factors) == 1:
        return factors[0]
    if all(factor.terms is not None and len(factor.terms) == 1 for factor in factors):
        single = [next(iter((factor.terms or {}).items())) for factor in factors]
        return _polynomial({sum(p for p, _ in single): math.prod(f for _, f in single)})
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

    return _folded(Node(value_of, dual, _all_constant(factors)))


def power_of(base: Node, exponent: Node) -> Node:
    """Return ``base ^ exponent``."""
    if exponent.constant:
        return _constant_power(base, exponent.value(0.0))
    base_value, base_pair = base.value, base.pair
    exponent_value, exponent_pair = exponent.value, exponent.pair

    def value_of(x: float) -> float:
        return math.pow(base_value(x), exponent_value(x))

    def dual(x: float) -> Dual:
        a, da = base_pair(x)
        b, db = exponent_pair(x)
        value = math.pow(a, b)
        slope = value * math.log(a) * db if db else 0.0
        if da:
            slope += b * math.pow(a, b - 1.0) * da
        return value, slope

    return Node(value_of, dual, constant=False)


def function(value: _Value, derivative: _Value, argument: Node) -> Node:
    """Return a function of an argument."""
    inner, pair = argument.value, argument.pair

    def dual(x: float) -> Dual:
        a, da = pair(x)
        return value(a), derivative(a) * da

    return _folded(Node(lambda x: value(inner(x)), dual, argument.constant))


def choice(choose: Callable[[Dual, Dual], Dual], arguments: list[Node]) -> Node:
    """Return the least or greatest argument, with its derivative."""
    pairs = [argument.pair for argument in arguments]

    def dual(x: float) -> Dual:
        return reduce(choose, [pair(x) for pair in pairs])

    return _folded(Node(lambda x: dual(x)[0], dual, _all_constant(arguments)))


def _constant_power(base: Node, power: float) -> Node:
    whole = int(power) if power.is_integer() and 0 <= power <= MAX_POWER else None
    if whole is not None and base.terms is not None and list(base.terms.items()) == [(1, 1.0)]:
        return _polynomial({whole: 1.0})
    value, pair = base.value, base.pair

    def value_of(x: float) -> float:
        return math.pow(value(x), power)

    def dual(x: float) -> Dual:
        a, da = pair(x)
        slope = power * math.pow(a, power - 1.0) if power else 0.0
        return math.pow(a, power), slope * da

    return _folded(Node(value_of, dual, base.constant))


def _polynomial(terms: Terms) -> Node:
    """Return a sum of powers of ``x``, evaluated by Horner's rule."""
    degree = max(terms)
    if degree == 0:
        return constant(_finite(terms[0]))
    if degree > MAX_POWER:
        raise ExpressionError(f"a power of x is above {MAX_POWER}")
    factors = [_finite(terms.get(power, 0.0)) for power in range(degree, -1, -1)]

    def value_of(x: float) -> float:
        value = 0.0
        for factor in factors:
            value = value * x + factor
        return value

    def dual(x: float) -> Dual:
        value, slope = 0.0, 0.0
        for factor in factors:
            slope = slope * x + value
            value = value * x + factor
        return value, slope

    return Node(value_of, dual, constant=False, terms=terms)


def _folded(node: Node) -> Node:
    """Return a number for a part that does not depend on ``x``."""
    if not node.constant:
        return node
    try:
        return constant(_finite(node.value(0.0)))
    except (ArithmeticError, ValueError) as error:
        raise ExpressionError(f"a constant part of the expression has no value: {error}") from None


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ExpressionError("a constant part of the expression has no finite value")
    return value


def _all_constant(nodes: list[Node]) -> bool:
    return all(node.constant for node in nodes)

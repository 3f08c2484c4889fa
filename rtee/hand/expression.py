"""Expressions in ``x`` of non-linear couplings (``nlFunPos``), with exact derivatives.

The syntax is that of muParser: numbers, ``x``, the constants and functions below, ``+ - * / ^`` and
parentheses. ``^`` is Python's ``**``, which binds tighter than a sign and is right-associative. A
text of known tokens in a valid order is passed to Python's parser, and the resulting tree is
converted to functions node by node; nothing is compiled or executed as Python code. Derivatives are
computed with dual numbers (forward mode): each node returns its value and its derivative.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from rtee.errors import ExpressionError
from rtee.sample import FloatArray

MAX_LENGTH: Final = 4000
"""Longest text [characters]; the longest one in ``config/`` has 180."""

MAX_DEPTH: Final = 100
"""Largest nesting depth of operations: each level needs one or two of the 1000 frames of Python's
stack."""

MAX_POWER: Final = 100
"""Highest power of ``x`` in a polynomial, which is also the number of its coefficients."""

Dual = tuple[float, float]
_Function = Callable[[float], float]

CONSTANTS: Final = {"_pi": math.pi, "pi": math.pi, "_e": math.e, "e": math.e}

# name: (value, derivative), after the usual rules of differentiation
FUNCTIONS: Final[dict[str, tuple[_Function, _Function]]] = {
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

_CALLED: Final = FUNCTIONS.keys() | CHOICES.keys()
_NAMES: Final = _CALLED | CONSTANTS.keys() | {"x"}
_TOKEN: Final = re.compile(
    r"\s*(?:([0-9]+\.?[0-9]*(?:[eE][+-]?[0-9]+)?|\.[0-9]+(?:[eE][+-]?[0-9]+)?)|([A-Za-z_]\w*)|(\S))"
)


class Expression:
    """A function of one variable, read from text.

    Attributes:
        text: The text it was read from.
    """

    def __init__(self, text: str) -> None:
        """Read an expression.

        Raises:
            ExpressionError: if the text is outside the grammar; ``column`` points at the place.
        """
        self.text = text
        try:
            tree = ast.parse(_as_python(text), mode="eval").body
        except (SyntaxError, RecursionError, MemoryError):  # valid, but too deep for the parser
            raise _too_deep() from None
        self._node = _node(tree, 1)

    def __call__(self, x: float) -> float:
        """Return the value at ``x``; ``nan`` where it is not defined."""
        try:
            return self._node.value(x)
        except (ArithmeticError, ValueError):
            return math.nan

    def dual(self, x: float) -> Dual:
        """Return the value and the derivative at ``x``; ``nan`` where they are not defined."""
        try:
            return self._node.dual(x)
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


def _as_python(text: str) -> str:
    """Convert a text to Python's syntax; it then has only known tokens in a valid order."""
    if len(text) > MAX_LENGTH:
        raise ExpressionError(f"the expression is longer than {MAX_LENGTH} characters")
    words: list[str] = []
    opened: list[str] = []  # the token before each open parenthesis
    previous, value_follows = "", True
    for match in _TOKEN.finditer(text.rstrip()):
        number, name, symbol = match.groups(default="")
        token, column = match[match.lastindex or 0], match.start(match.lastindex or 0)
        if previous in _CALLED:
            # A function name must be followed by its argument.
            fits = symbol == "("
        elif value_follows:
            fits = symbol in ("", "+", "-", "(")
        elif symbol == ",":
            fits = bool(opened) and opened[-1] in CHOICES
        else:
            fits = symbol in ("+", "-", "*", "/", "^") or (symbol == ")" and bool(opened))
        if not fits:
            raise ExpressionError(
                f"unexpected '{token[:20]}' at column {column + 1} of '{_short(text)}'",
                column=column,
            )
        if name and name not in _NAMES:
            known = ", ".join([*sorted(FUNCTIONS), *CHOICES, *CONSTANTS])
            raise ExpressionError(
                f"unknown '{name[:40]}' at column {column + 1}; valid: x, {known}", column=column
            )
        # "1e999" is a valid token; every value made from it would be infinite or NaN.
        if number and math.isinf(float(number)):
            raise ExpressionError(
                f"the number '{number[:20]}' at column {column + 1} is too large", column=column
            )
        if symbol == "(":
            opened.append(previous)
        elif symbol == ")":
            opened.pop()
        previous, value_follows = token, symbol not in ("", ")")
        # As floats, since integers are unbounded in Python: their powers could take for ever.
        words.append(repr(float(number)) if number else token.replace("^", "**"))
    if not words:
        raise ExpressionError("the expression is empty")
    if value_follows or opened or previous in _CALLED:
        raise ExpressionError(
            f"'{_short(text)}' ends where a value or ')' should follow", column=len(text)
        )
    return " ".join(words)


def _short(text: str) -> str:
    return text if len(text) <= 60 else text[:59] + "…"


def _too_deep() -> ExpressionError:
    return ExpressionError(f"the expression is nested deeper than {MAX_DEPTH}")


class _Node(NamedTuple):
    """A part of an expression.

    Attributes:
        value: Its value at ``x``.
        dual: Its value and its derivative at ``x``.
        terms: Its coefficients by power, if it is written as a sum of powers of ``x``.
    """

    value: _Function
    dual: Callable[[float], Dual]
    terms: dict[int, float] | None = None

    @property
    def constant(self) -> bool:
        """Whether the expression is independent of ``x``."""
        return self.terms is not None and self.terms.keys() == {0}


_X: Final = _Node(lambda x: x, lambda x: (x, 1.0), {1: 1.0})


def _node(tree: ast.expr, depth: int) -> _Node:
    """Convert a syntax tree to a node; only the cases listed here are allowed."""
    if depth > MAX_DEPTH:
        raise _too_deep()
    inner = partial(_node, depth=depth + 1)
    match tree:
        case ast.Constant(value=float(number)):
            return _number(number)
        case ast.Name(id="x"):
            return _X
        case ast.Name(id=name):
            return _number(CONSTANTS[name])
        case ast.UnaryOp(op=ast.UAdd()):
            return inner(tree.operand)
        case ast.UnaryOp(op=ast.USub()):
            return _negated(inner(tree.operand))
        case ast.BinOp(op=ast.Pow()):
            return _power(inner(tree.left), inner(tree.right))
        case ast.BinOp(op=ast.Add() | ast.Sub()):
            terms = _chain(tree, (ast.Add, ast.Sub))
            return _sum([_negated(inner(t)) if minus else inner(t) for minus, t in terms])
        case ast.BinOp(op=ast.Mult() | ast.Div()):
            factors = _chain(tree, (ast.Mult, ast.Div))
            return _product([_inverted(inner(t)) if over else inner(t) for over, t in factors])
        case ast.Call(func=ast.Name(id=name), args=arguments) if name in CHOICES:
            return _choice(CHOICES[name], [inner(argument) for argument in arguments])
        case ast.Call(func=ast.Name(id=name), args=[argument]):
            return _applied(*FUNCTIONS[name], inner(argument))
    raise ExpressionError(f"unexpected {type(tree).__name__}")


def _chain(tree: ast.BinOp, kinds: tuple[type, type]) -> Iterator[tuple[bool, ast.expr]]:
    """Return the operands of a chain such as ``a - b + c``.

    Each is paired with whether the second kind of operator, such as ``-``, precedes it.
    """
    parts: list[tuple[bool, ast.expr]] = []
    node: ast.expr = tree
    # Python nests chains to the left. A part in parentheses has another column offset, since it
    # begins after the parenthesis.
    while (
        isinstance(node, ast.BinOp)
        and isinstance(node.op, kinds)
        and node.col_offset == tree.col_offset
    ):
        parts.append((isinstance(node.op, kinds[1]), node.right))
        node = node.left
    return reversed([*parts, (False, node)])


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ExpressionError("a constant part of the expression has no finite value")
    return value


def _number(value: float) -> _Node:
    return _Node(lambda _x: value, lambda _x: (value, 0.0), {0: _finite(value)})


def _combined(
    parts: list[_Node],
    value_of: Callable[[list[float]], float],
    slope_of: Callable[[list[float], list[float]], float],
) -> _Node:
    """Return a node made of parts; a number if no part depends on ``x``.

    Its value and its derivative come from those of the parts.
    """
    values, duals = [part.value for part in parts], [part.dual for part in parts]

    def value(x: float) -> float:
        return value_of([value(x) for value in values])

    def dual(x: float) -> Dual:
        found = [dual(x) for dual in duals]
        a, da = [a for a, _ in found], [da for _, da in found]
        return value_of(a), slope_of(a, da)

    if not all(part.constant for part in parts):
        return _Node(value, dual)
    try:
        return _number(value(0.0))
    except (ArithmeticError, ValueError) as error:
        raise ExpressionError(f"a constant part of the expression has no value: {error}") from None


def _polynomial(terms: dict[int, float]) -> _Node:
    """Return a sum of powers of ``x``, evaluated by Horner's rule."""
    degree = max(terms)
    if degree == 0:
        return _number(terms[0])
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
            # The slope first, since it needs the value of the previous step.
            slope = slope * x + value
            value = value * x + factor
        return value, slope

    return _Node(value_of, dual, terms)


def _sum(parts: list[_Node]) -> _Node:
    polynomials = [part.terms for part in parts if part.terms is not None]
    if len(polynomials) == len(parts):
        total: dict[int, float] = {}
        for terms in polynomials:
            for power, factor in terms.items():
                total[power] = total.get(power, 0.0) + factor
        return _polynomial(total)
    # fsum rounds only once, so that the result does not depend on the order of the terms.
    return _combined(parts, math.fsum, lambda _, da: math.fsum(da))


def _product(parts: list[_Node]) -> _Node:
    monomials = [part.terms for part in parts if part.terms is not None and len(part.terms) == 1]
    if len(monomials) == len(parts):
        power = sum(power for terms in monomials for power in terms)
        return _polynomial({power: math.prod(f for terms in monomials for f in terms.values())})
    return _combined(parts, math.prod, _product_slope)


def _product_slope(a: list[float], da: list[float]) -> float:
    product, slope = 1.0, 0.0
    for value, change in zip(a, da, strict=True):
        slope = slope * value + product * change
        product *= value
    return slope


def _negated(part: _Node) -> _Node:
    if part.terms is not None:
        return _polynomial({power: -factor for power, factor in part.terms.items()})
    return _combined([part], lambda a: -a[0], lambda _, da: -da[0])


def _inverted(part: _Node) -> _Node:
    return _combined([part], lambda a: 1.0 / a[0], lambda a, da: -da[0] / (a[0] * a[0]))


def _power(base: _Node, exponent: _Node) -> _Node:
    if exponent.constant:
        return _constant_power(base, exponent.value(0.0))
    return _combined([base, exponent], lambda a: math.pow(*a), _power_slope)


def _power_slope(a: list[float], da: list[float]) -> float:
    base, exponent = a
    slope = math.pow(base, exponent) * math.log(base) * da[1] if da[1] else 0.0
    # Skipped for a constant base, whose power may have no finite derivative, such as 0 to 0.5.
    return slope + exponent * math.pow(base, exponent - 1.0) * da[0] if da[0] else slope


def _constant_power(base: _Node, power: float) -> _Node:
    # Powers of x itself become coefficients; all other powers are evaluated.
    if base.terms == {1: 1.0} and power.is_integer() and 0 <= power <= MAX_POWER:
        return _polynomial({int(power): 1.0})

    def slope(a: list[float], da: list[float]) -> float:
        return (power * math.pow(a[0], power - 1.0) if power else 0.0) * da[0]

    # Not ``**``, which returns complex roots of negative numbers; math.pow raises an error.
    return _combined([base], lambda a: math.pow(a[0], power), slope)


def _applied(value: _Function, derivative: _Function, part: _Node) -> _Node:
    """Return a node that applies a function to a part."""
    return _combined([part], lambda a: value(a[0]), lambda a, da: derivative(a[0]) * da[0])


def _choice(choose: Callable[[Any], Any], parts: list[_Node]) -> _Node:
    """Return the least or greatest part, with its derivative."""

    def slope(a: list[float], da: list[float]) -> float:
        # min and max compare the values first, and for equal values the derivatives.
        chosen: Dual = choose(zip(a, da, strict=True))
        return chosen[1]

    return _combined(parts, choose, slope)

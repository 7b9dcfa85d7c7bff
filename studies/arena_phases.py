"""Which statement of a function decided what it returns: a scripted policy's phase. Needs no package."""

from __future__ import annotations

import ast
import inspect
import sys
import textwrap
from collections.abc import Callable
from types import CodeType, FrameType
from typing import Any


class Phases:
    """The return statements of a function, 0 to P − 1 in the order of lines, and which of them calls reached.

    The function is not changed: while it runs it is traced, and what returns is told by its line.

    :param function: a Python function whose source can be read.
    :param key: the assignments to this key, as ``value[key] = ...``, count in place of return statements.
    :raises ValueError: it has no such statement.
    """

    def __init__(self, function: Callable[..., Any], key: str | None = None) -> None:
        of_key = ("line", f"assignment to {key!r}")
        self._event, kind = ("return", "return statement") if key is None else of_key
        self._code: CodeType = inspect.unwrap(function).__code__
        lines, first = inspect.getsourcelines(self._code)
        tree = ast.parse(textwrap.dedent("".join(lines)))
        found = _decisive(tree.body[0], key)
        returns = sorted((node.lineno, node.end_lineno or node.lineno) for node in found)
        if not returns:
            raise ValueError(f"{function.__qualname__} has no {kind}")
        self.lines = [first + start - 1 for start, _ in returns]
        self._phase: dict[int, int] = {}
        for number, (start, end) in enumerate(returns):
            self._phase |= dict.fromkeys(range(first + start - 1, first + end), number)
        self._last: int | None = None

    def of(self, call: Callable[..., Any], *arguments: Any) -> tuple[Any, int]:
        """What ``call(*arguments)`` returns, and the phase in which the function, called last, returned.

        :raises LookupError: the function was not called.
        """
        before, self._last = sys.gettrace(), None
        sys.settrace(self._watch)
        try:
            value = call(*arguments)
        finally:
            sys.settrace(before)
        if self._last is None:
            raise LookupError(f"{self._code.co_qualname} was not called")
        return value, self._phase[self._last]

    def _watch(self, frame: FrameType, _: str, __: Any) -> Callable[..., Any] | None:
        return self._inside if frame.f_code is self._code else None

    def _inside(self, frame: FrameType, event: str, _: Any) -> Callable[..., Any]:
        if event == self._event and (event == "return" or frame.f_lineno in self._phase):
            self._last = frame.f_lineno
        return self._inside


def _decisive(node: ast.AST, key: str | None) -> list[ast.stmt]:
    """The return statements of a function, or its assignments to a key, without those of inner functions."""
    inner = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda, ast.ClassDef)
    children = [child for child in ast.iter_child_nodes(node) if not isinstance(child, inner)]
    own = [child for child in children if isinstance(child, ast.Return if key is None else ast.Assign)]
    if key is not None:
        assigned = [one for one in own if isinstance(one, ast.Assign)]
        own = [one for one in assigned if ast.unparse(one.targets[0]).endswith(f"[{key!r}]")]
    return [*own, *(found for child in children for found in _decisive(child, key))]

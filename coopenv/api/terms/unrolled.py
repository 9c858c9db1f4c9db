"""Loops over terms, written out before Warp reads a kernel.

Warp unrolls them as well, but has to generate the code of a kernel to know what `wp.static` of a loop's variable is. It
would do so in every process, only to find the kernel in its cache: a quarter of the time that an environment takes to
start.
"""

import ast
import copy
import inspect
from collections.abc import Callable
from textwrap import dedent
from typing import Any

import warp as wp


def unrolled(function: Callable[..., Any], **known: Any) -> str:
    """Return a function's source with loops over `range(wp.static(...))` written out.

    Args:
        function: a plain Python function.
        **known: what the expressions refer to, by name.
    """
    tree = ast.parse(dedent(inspect.getsource(function)))
    return ast.unparse(ast.fix_missing_locations(_Unroll({**known, "wp": wp}).visit(tree)))


class _Unroll(ast.NodeTransformer):
    """Repeats the bodies of loops, with numbers in place of the variable."""

    def __init__(self, known: dict[str, Any]) -> None:
        self._known = known

    def visit_For(self, node: ast.For) -> ast.For | list[ast.stmt]:
        self.generic_visit(node)
        match node:
            case ast.For(
                target=ast.Name(id=variable),
                iter=ast.Call(
                    func=ast.Name(id="range"), args=[ast.Call(func=ast.Attribute(attr="static"), args=[count])]
                ),
            ):
                turns = range(eval(compile(ast.Expression(count), "<range>", "eval"), self._known))
                return [_Numbered(variable, k).visit(copy.deepcopy(line)) for k in turns for line in node.body]
        return node


class _Numbered(ast.NodeTransformer):
    """Puts a number in place of a variable."""

    def __init__(self, variable: str, number: int) -> None:
        self._variable, self._number = variable, number

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return ast.Constant(self._number) if node.id == self._variable else node

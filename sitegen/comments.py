"""Comments behind attributes, which the pages of the API show as their docstrings."""

import ast
import re
import tokenize
from functools import cache
from pathlib import Path
from typing import Any

from griffe import Attribute, Docstring, Extension, ObjectNode, Visitor

DIRECTIVE = re.compile(r"(noqa|type:|pragma|fmt:|mypy:|ruff:)")


class TrailingComments(Extension):
    """Takes the comment at the end of an attribute's statement as its docstring where it has no other."""

    def on_attribute_instance(self, *, node: ast.AST | ObjectNode, attr: Attribute, agent: Any, **kwargs: Any) -> None:
        """Look behind an attribute of a class or module that has been read from its source."""
        if attr.docstring is not None or not isinstance(agent, Visitor) or not _is_declared(node):
            return
        line = getattr(node, "end_lineno", 0)
        if text := _comments(agent.filepath).get(line):
            attr.docstring = Docstring(
                text,
                lineno=line,
                endlineno=line,
                parent=attr,
                parser=agent.docstring_parser,
                parser_options=agent.docstring_options,
            )


def _is_declared(node: ast.AST | ObjectNode) -> bool:
    """Return whether a statement gives a name of the class or module itself, not of `self`."""
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return all(isinstance(target, ast.Name) for target in targets)


@cache
def _comments(path: Path) -> dict[int, str]:
    """Return the comments of a file by line, those left out that speak to tools."""
    with path.open("rb") as file:
        comments = [token for token in tokenize.tokenize(file.readline) if token.type == tokenize.COMMENT]
    texts = {token.start[0]: token.string.lstrip("#: ").rstrip() for token in comments}
    return {line: text for line, text in texts.items() if not DIRECTIVE.match(text)}

"""Loops over terms are written out before Warp reads a kernel."""

from __future__ import annotations

import ast
from pathlib import Path

import warp as wp

import coopenv
from coopenv.api.terms.binding import bound_terms
from coopenv.api.terms.kernels import endings_kernel, results_kernel
from coopenv.api.terms.unrolled import unrolled
from coopenv.world.precision import precision

LANE_KEEPING = Path(__file__).parents[3] / "examples" / "lane_keeping" / "lane_keeping.toml"
parts = ["a", "b", "c"]
none: list[str] = []


def sample(turns: int) -> list[tuple[object, ...]]:
    """Loop over what is known and what is not, within each other."""
    seen: list[tuple[object, ...]] = []
    for k in range(wp.static(len(parts))):
        seen.append((k, wp.static(parts[k])))
    for n in range(turns):
        seen.append((n,))
        for k in range(wp.static(len(none))):
            seen.append((n, wp.static(none[k])))
        for k in range(wp.static(len(parts) - 1)):
            seen.append((n, k, wp.static(parts[k])))
    return seen


def test_what_is_written_out_does_the_same() -> None:
    text = unrolled(sample, parts=parts, none=none)
    loops = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.For)]
    assert [ast.unparse(loop.iter) for loop in loops] == ["range(turns)"]
    known: dict[str, object] = {"wp": wp, "parts": parts, "none": none}
    exec(text, known)
    written_out = known["sample"]
    assert callable(written_out)
    for turns in (0, 1, 3):
        assert written_out(turns) == sample(turns)


def test_warp_need_not_generate_code_to_know_what_a_kernel_is() -> None:
    terms = bound_terms(coopenv.load_scenario(str(LANE_KEEPING)))
    kernels = [results_kernel(terms, precision("float32")), endings_kernel(terms.conditions, precision("float32"))]
    assert len(terms.conditions) > 0
    assert not any(kernel.adj.has_unresolved_static_expressions for kernel in kernels)

"""Plain data as TOML, read back by Python's parser."""

import tomllib
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from coopenv.cars.settings.toml import toml_text

SCALARS = st.one_of(
    st.booleans(), st.integers(-(2**60), 2**60), st.floats(allow_nan=False), st.text("aé\"\\\n\t ='#[]{}")
)
VALUES = st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=3), max_leaves=6)
TABLES = st.recursive(
    st.dictionaries(st.text('abc.- é"', min_size=1, max_size=5), VALUES, max_size=4),
    lambda inner: st.dictionaries(
        st.text("xyz", min_size=1, max_size=3),
        st.one_of(VALUES, inner, st.lists(inner, min_size=1, max_size=3)),
        max_size=4,
    ),
    max_leaves=8,
)


@given(TABLES)
def test_toml_reads_back_as_it_was(table: dict[str, Any]) -> None:
    assert tomllib.loads(toml_text(table)) == table


def test_values_that_are_none_are_left_out() -> None:
    assert tomllib.loads(toml_text({"a": None, "b": {"c": None, "d": (1, 2)}})) == {"b": {"d": [1, 2]}}

"""Names on NATS."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.cars.transport.base import matcher
from coopenv.cars.transport.nats import subject_of, subjects_of


def test_a_subject_is_the_topic_with_dots() -> None:
    assert subject_of("agent7/riccatiPoint") == "agent7.riccatiPoint"


@pytest.mark.parametrize(
    ("pattern", "subjects"),
    [
        ("agent7/riccatiPoint", ("agent7.riccatiPoint",)),
        ("fleet/*/x", ("fleet.*.x",)),
        ("fleet/a/**", ("fleet.a", "fleet.a.>")),
        ("fleet/**/x", ("fleet.>",)),
        ("**", (">",)),
    ],
)
def test_patterns_as_subjects(pattern: str, subjects: tuple[str, ...]) -> None:
    assert subjects_of(pattern) == subjects


def covers(subject: str, topic: str) -> bool:
    """Say what a NATS server delivers: `*` is a token, `>` at the end one or more."""
    wanted, tokens = subject.split("."), topic.split("/")
    for i, token in enumerate(wanted):
        if token == ">":
            return len(tokens) > i
        if i >= len(tokens) or token not in ("*", tokens[i]):
            return False
    return len(tokens) == len(wanted)


@given(
    pattern=st.lists(st.sampled_from(["a", "b", "*", "**"]), min_size=1, max_size=4),
    topic=st.lists(st.sampled_from(["a", "b"]), min_size=1, max_size=4),
)
def test_no_topic_is_missed_and_none_comes_twice(pattern: list[str], topic: list[str]) -> None:
    times = sum(covers(subject, "/".join(topic)) for subject in subjects_of("/".join(pattern)))
    assert times <= 1
    if matcher("/".join(pattern))("/".join(topic)):
        assert times == 1

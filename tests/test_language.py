"""The language of the documents, as far as a program can check it: short sentences, short pages, the field's words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
GENERATED = (DOCS / "environments", DOCS / "reference" / "api", DOCS / "interoperability.md")
"""Pages that programs write, and those that `mkdocstrings` fills."""
PAGES = {
    page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8")
    for page in sorted((*ROOT.glob("*.md"), *ROOT.glob("agents/*/card.md"), *DOCS.rglob("*.md")))
    if not any(page.is_relative_to(folder) for folder in GENERATED)
}

LONGEST_SENTENCE = 40
"""Words."""
MEAN_SENTENCE = 18.0
"""Words, the mean over all sentences of all pages."""
LONGEST_PAGE = 2500
"""Words, with code and tables, as `wc -w` counts them."""
ALL_PAGES = 40_800
"""Words of the pages in docs."""

REPLACED = {
    r"told|tells?|telling": "state, broadcast, send, show",
    r"hear|hears|heard|hearing|hearsay": "receive, inbox",
    r"liars?|culprits?|perjured|offences?|accused?|accuses": "lying sender, suspect, self-inconsistent, exclusion",
    r"believe|believes|believed|believing|disbeliev\w+|distrust\w*|believe_again": "estimate, trust, exclude, readmit",
    r"forgiv\w+": "inflate",
    r"somebody|nobody|everybody(?!=)": "the vehicle, the sender, no vehicle, all vehicles",
    r"barred_until|stand_alone|bend_variance|BEND_TIME|way_made|gramian_way|is_sound|wishes_of|vitals|briefing": (
        "excluded_until, LandmarkOnlySolution, linearisation_variance, progress, window_length, is_valid, reset_options"
    ),
    r"MovedWorld|peeled|taped|by hand": "CosimulatedWorld, ablated_stages, recorded, the command",
    r"made to measure|(nothing|all) (was|were) tuned on": "parametric, held-out",
    r"\"\"\"(?:what|who|whose|whom|how|those)": "a noun phrase or an imperative at the beginning of a docstring",
}
"""Words of which a page and a program have none, as regular expressions, and words that take their place."""
KEPT = ("liar_among_us", "Liar among us", "lane_liar", "ring_liar", '["heard"]', '"heard":')
"""Names that stay: of an environment and scenes of the leaderboard, and of a saved field."""
PROGRAMS = [
    file
    for folder, kinds in {"coopenv": "py", "examples": "py toml", "envs": "toml", "agents": "py toml md"}.items()
    for kind in kinds.split()
    for file in sorted((ROOT / folder).rglob(f"*.{kind}"))
]

FENCE = re.compile(r"^( *)(```+|~~~+)[^\n]*\n.*?^ *\2[ \t]*$", re.DOTALL | re.MULTILINE)
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")
CODE = re.compile(r"(`+)(.+?)\1", re.DOTALL)
MARK = re.compile(r"^(?:\s*(?:[-*+]|\d+\.)\s+|:\s+|#+ .*$|\s*(?:!!!|\?\?\?|===).*$|\s*<[^>]*>\s*$)", re.MULTILINE)
END = re.compile(
    r"(?<=[.!?])(?<!\b[A-Z]\.)(?<!\bal\.)(?<!\bcf\.)(?<!\bvs\.)[)\"*_]*\s+(?=[\"(*_]*[A-Z0-9]|coopenv |e95 )"
)
WORD = re.compile(r"\S*\w\S*")


def length(text: str) -> int:
    """Return the number of words, which are what stands between blanks and has a letter or a digit."""
    return len(WORD.findall(text))


def sentences(page: str) -> list[str]:
    """Return the sentences of a page's prose: without code, tables, headings and list marks; inline code is a word."""
    text = COMMENT.sub("", FENCE.sub("\n", page))
    text = "\n".join("" if line.lstrip().startswith("|") else line for line in text.splitlines())
    text = MARK.sub("\n\n", CODE.sub("Code", LINK.sub(r"\1", text)))
    blocks = [block for block in re.split(r"\n\s*\n", text) if not re.match(r"    \S", block.strip("\n"))]
    found = [sentence for block in blocks for sentence in END.split(" ".join(block.split()))]
    return [sentence for sentence in found if length(sentence) > 2]


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_short(name: str) -> None:
    assert len(PAGES[name].split()) <= LONGEST_PAGE


@pytest.mark.parametrize("name", PAGES)
def test_no_sentence_is_long(name: str) -> None:
    assert not [sentence for sentence in sentences(PAGES[name]) if length(sentence) > LONGEST_SENTENCE]


@pytest.mark.parametrize("name", PAGES)
def test_words_are_those_of_the_field(name: str) -> None:
    assert not replaced_words(PAGES[name])


def test_names_comments_and_strings_have_words_of_the_field() -> None:
    found = {file.relative_to(ROOT).as_posix(): replaced_words(file.read_text(encoding="utf-8")) for file in PROGRAMS}
    assert len(found) > 200 and not {name: words for name, words in found.items() if words}


LINES = ["heard = Queue()", "ToldState", "def tell_all(): ...", "# nobody hears", "LaneLiar", '"""How it is named."""']


@pytest.mark.parametrize("line", LINES)
def test_words_are_found_in_names(line: str) -> None:
    assert replaced_words(f"first\n{line}")


def replaced_words(text: str) -> list[str]:
    """Return the words of a text that are not of the field, also within names, and those that take their place."""
    for name in KEPT:
        text = text.replace(name, "")
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text)
    return [
        f"{word}: use {instead}"
        for pattern, instead in REPLACED.items()
        for word in re.findall(rf"(?<![a-z])(?:{pattern})(?![a-z])", text, re.IGNORECASE)
    ]


def test_sentences_are_short_in_the_mean() -> None:
    lengths = [length(sentence) for name in PAGES for sentence in sentences(PAGES[name])]
    assert sum(lengths) / len(lengths) < MEAN_SENTENCE


def test_all_pages_together_are_short() -> None:
    assert sum(len(text.split()) for name, text in PAGES.items() if name.startswith("docs/")) <= ALL_PAGES


def test_sentences_are_found() -> None:
    prose = "One two `a b c` three. Four A. Wong [five six](x.md) seven."
    page = f"# Title here now\n\n{prose}\n\n- Eight nine ten\n\n| a | b |\n"
    assert [length(sentence) for sentence in sentences(page)] == [4, 6, 3]

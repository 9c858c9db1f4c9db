"""The scenario of the examples: fixed places, the paper's observer, fast, and a bit of everything."""

from __future__ import annotations

from pathlib import Path

FOUR_WAY = str(Path(__file__).parents[2] / "examples" / "four_way.toml")
"""Four driven cars between four buildings; everybody sees landmarks ahead."""

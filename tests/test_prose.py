"""Turns of phrase that make readers stumble are kept out of library, docs and specs."""

from __future__ import annotations

import re
from pathlib import Path

import ddco_pyro

ROOT = Path(ddco_pyro.__file__).parents[1]

TURNS = (
    "of before", "whoever", "so it is", "told from", "nobody", "but for", "be it that", "tells? apart", "told apart",
    "of its own accord", "as it was", "as they were",
)  # fmt: skip

PLACES = {
    "ddco_pyro": "**/*.py",
    "ddco_pyro/drawing": "*.j2",
    "ddco_pyro/data": "*.j2",
    "docs": "**/*.md",
    "specs": "*.yaml",
    ".": "README.md",
}
FILES = [
    path
    for folder, pattern in PLACES.items()
    for path in sorted((ROOT / folder).glob(pattern))
    if not path.is_relative_to(ROOT / "docs" / "results") and path.name not in ("decisions.md", "glossary.md")
]


def found(path: Path) -> list[str]:
    """The turns of phrase in a file, which may run over the end of a line or a string."""
    text = re.sub(r'"?\n\s*(#\s*|f?")?', " ", path.read_text(encoding="utf-8"))
    turns = re.compile(rf"\b(?:{'|'.join(TURNS)})\b".replace(" ", r"\s+"), re.IGNORECASE)
    return [" ".join(match[0].split()) for match in turns.finditer(text)]


def test_a_sentence_is_read_once() -> None:
    assert {str(path.relative_to(ROOT)): turns for path in FILES if (turns := found(path))} == {}


def test_turns_are_found_over_the_end_of_a_line(tmp_path: Path) -> None:
    path = tmp_path / "some.py"
    path.write_text('"""Runs of\n    before."""\nprint("but "\n      "for", 1)  # nobody\n')
    assert found(path) == ["of before", "but for", "nobody"]

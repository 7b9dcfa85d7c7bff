"""Pages of text, tables and figures, as self-contained HTML and as Markdown; tables on the console, too."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, Self

import jinja2
import rich.table
import rich.text
from markupsafe import Markup

from ddco_pyro.drawing.timeline import Timelines


class Cell(str):
    """Text of a table's cell that HTML shows as a link, after a swatch of a colour, or as a mark."""

    link: str = ""
    colour: str = ""
    mark: bool = False

    def __new__(cls, text: str, *, link: str = "", colour: str = "", mark: bool = False) -> Self:
        """Text with its looks."""
        cell = super().__new__(cls, text)
        cell.link, cell.colour, cell.mark = link, colour, mark
        return cell


@dataclass(frozen=True)
class Table:
    """A table. Columns are right-aligned, those numbered in ``left`` left-aligned.

    >>> print(Table(["name", "value"], [["a", "1.5"]]).markdown())
    | name | value |
    |---|--:|
    | a | 1.5 |
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: Collection[int] = (0,)
    title: str | None = None

    def markdown(self) -> str:
        """The table in Markdown."""
        rule = "".join("---|" if column in self.left else "--:|" for column in range(len(self.head)))
        return "\n".join([_line(self.head), f"|{rule}", *map(_line, self.rows)])

    def console(self) -> rich.table.Table:
        """The table for a terminal; a cell that is too long continues on the next line."""
        table = rich.table.Table(title=self.title, show_edge=False)
        for column, name in enumerate(self.head):
            table.add_column(name, justify="left" if column in self.left else "right", overflow="fold")
        for row in self.rows:
            table.add_row(*map(rich.text.Text, row))
        return table

    def folded(self, shown: int, what: str) -> list[Block]:
        """The first rows; the others are folded, and ``what`` names them, such as ``demonstrations``."""
        first, rest = (Table(self.head, rows, self.left) for rows in (self.rows[:shown], self.rows[shown:]))
        if not rest.rows:
            return [first]
        return [first, Card(f"The other {len(rest.rows)} {what}", [rest], folded=True)]


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


@dataclass(frozen=True)
class Text:
    """A paragraph, ``note`` (small), ``verdict`` (large), ``code``, or ``heading`` inside a section."""

    text: str
    kind: str = "paragraph"


def note(text: str) -> Text:
    """A small paragraph, such as the meaning of a table's columns."""
    return Text(text, "note")


@dataclass(frozen=True)
class Facts:
    """Names and values in two columns, under an optional ``title`` and over an optional ``note``."""

    values: Mapping[str, str]
    title: str = ""
    note: str = ""


@dataclass(frozen=True)
class Columns:
    """Blocks side by side."""

    blocks: Sequence[Block]


@dataclass(frozen=True)
class Warned:
    """A warning and the usual remedy."""

    text: str
    advice: str


@dataclass(frozen=True)
class Drawing:
    """A drawing in SVG, a picture or a film, inside the page, and its caption."""

    content: Markup
    caption: str


@dataclass(frozen=True)
class Card:
    """Blocks side by side under a title, such as all about one option; or ``folded``, shown after a click."""

    title: str
    blocks: Sequence[Block]
    folded: bool = False


Block = Text | Table | Facts | Columns | Warned | Drawing | Card | Timelines


def footnote(text: str) -> Card:
    """The meaning of what stands above, which a click shows."""
    return Card("What this means", [note(text)], folded=True)


@dataclass(frozen=True)
class Section:
    """A titled part of a page; links reach it by ``name``. A click on the title shows what is ``folded``."""

    name: str
    title: str
    blocks: Sequence[Block]
    folded: bool = False


@dataclass(frozen=True)
class Page:
    """A title, a smaller ``subtitle``, blocks under it, and sections; sections that are None do not apply."""

    title: str
    blocks: Sequence[Block]
    sections: Sequence[Section | None]
    subtitle: str = ""

    @property
    def has_timelines(self) -> bool:
        """Whether the page needs the script of time lines."""
        blocks = chain.from_iterable(section.blocks for section in self.sections if section)
        return any(isinstance(block, Timelines) for block in blocks)

    def html(self) -> str:
        """One self-contained file. Text is escaped unless it is ``markupsafe.Markup``."""
        environment = jinja2.Environment(
            loader=jinja2.PackageLoader("ddco_pyro.drawing", "."),
            autoescape=True,
            undefined=jinja2.StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        return environment.get_template("page.html.j2").render(page=self, kind=_kind)

    def markdown(self) -> str:
        """Text and tables in Markdown, beginning with the blocks under the title."""
        parts = [_markdown(self.blocks)]
        parts += [f"## {own.title}\n\n{_markdown(own.blocks)}" for own in self.sections if own]
        return "\n\n".join(filter(None, parts)) + "\n"


def _kind(block: Any) -> str:
    return type(block).__name__


def _markdown(blocks: Sequence[Block]) -> str:
    flat = chain.from_iterable(block.blocks if isinstance(block, Card) else [block] for block in blocks)
    told = (block for block in flat if isinstance(block, Table | Text))
    shown = (block.text if isinstance(block, Text) else block.markdown() for block in told)
    return "\n\n".join(filter(None, shown))

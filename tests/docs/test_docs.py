"""What the documentation shows is so, its examples, commands and keys; turns that make readers stumble."""

import doctest
import re
import tomllib
from pathlib import Path

import pytest
import typer
import yaml

import ddco_pyro
from ddco_pyro.cli.app import app
from ddco_pyro.spec import spec_schema

ROOT = Path(ddco_pyro.__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("page", ["docs/model.md"])
def test_examples_give_what_is_shown(page: str) -> None:
    found = doctest.testfile(str(ROOT / page), module_relative=False)
    assert found.failed == 0
    assert found.attempted > 0


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_command_and_option_that_is_named_exists(page: Path) -> None:
    group = typer.main.get_command(app)
    for name, rest in re.findall(r"ddco-pyro ([a-z]+)\b([^`\n|]*)", page.read_text()):
        assert name in group.commands, name
        known = {option for one in group.commands[name].params for option in one.opts}
        assert set(re.findall(r"--[a-z-]+", rest)) <= known | {"--help", "--debug"}, rest


def test_the_site_is_generated_from_the_code() -> None:
    """The pages that ``make docs`` generates, where what it needs is installed."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("latex2mathml")
    hooks: dict[str, object] = {"__file__": str(ROOT / "docs" / "hooks.py")}
    exec(compile((ROOT / "docs" / "hooks.py").read_text(), "hooks.py", "exec"), hooks)
    spec, commands = hooks["spec_page"](), hooks["command_page"]()  # type: ignore[operator]
    for key in spec_schema()["properties"]:
        assert f"| `{key}` |" in spec
    for name, command in typer.main.get_command(app).commands.items():
        assert f"\n## {name}\n" in commands
        assert all(one.opts[0] in commands for one in command.params if one.param_type_name == "option")


def anchors(page: Path) -> set[str]:
    """Of the headings of a page, as GitHub and mkdocs write them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\s-]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


GENERATED = {"spec.md", "cli.md"}
"""Pages that are made while the site is built."""


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_leads_somewhere(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    links = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text)
    for link in links:
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        if "://" in link or name in GENERATED:
            continue
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


@pytest.mark.parametrize("page", ["README.md", "docs/install.md"])
def test_what_the_demo_installs_is_said(page: str) -> None:
    """As make and the check of OpenGL say it."""
    from ddco_tasks.opengl import PACKAGES

    (size,) = re.findall(r"^SIZE := (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for said in (size, f"sudo apt-get install {PACKAGES}"):
        assert said in (ROOT / page).read_text()


def test_every_make_target_that_is_named_exists() -> None:
    targets = set(re.findall(r"^([.a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        assert set(re.findall(r"(?:^|`)make ([.a-z-]+)", page.read_text(), re.MULTILINE)) <= targets, page


def test_the_citation_has_the_version_of_the_package() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert citation["references"][0]["year"] == 2017


TURNS = (
    "of before", "whoever", "so it is", "told from", "nobody", "but for", "be it that", "tells? apart",
    "told apart", "of its own accord", "as it was", "as they were",
)  # fmt: skip

FILES = [
    path
    for pattern in ("ddco_pyro/**/*.py", "ddco_pyro/**/*.j2", "docs/**/*.md", "specs/*.yaml", "README.md")
    for path in sorted(ROOT.glob(pattern))
    if not path.is_relative_to(ROOT / "docs" / "results") and path.name not in ("decisions.md", "glossary.md")
]


def turns_in(path: Path) -> list[str]:
    """The turns of phrase in a file, which may run over the end of a line or a string."""
    text = re.sub(r'"?\n\s*(#\s*|f?")?', " ", path.read_text(encoding="utf-8"))
    turns = re.compile(rf"\b(?:{'|'.join(TURNS)})\b".replace(" ", r"\s+"), re.IGNORECASE)
    return [" ".join(match[0].split()) for match in turns.finditer(text)]


def test_a_sentence_is_read_once() -> None:
    assert {str(path.relative_to(ROOT)): turns for path in FILES if (turns := turns_in(path))} == {}

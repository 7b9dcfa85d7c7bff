"""Generated tables of pages: numbers by hand, README's by pandas alone, and Markdown as GitHub shows it."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from markdown_it import MarkdownIt
from scipy import stats

from ddco_pyro.errors import BadInput
from studies import page
from studies.__main__ import main
from studies.statistics import COLUMNS

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
GENERATED = [ROOT / "README.md", *sorted((ROOT / "docs" / "results").glob("*.md"))]
STUDY = {
    "question": "Does it help?",
    "world": "files:WORLD",
    "tasks": ["a"],
    "methods": {"options": {}, "flat": {"baseline": "flat"}},
    "seeds": {"test": {"count": 4}},
    "demonstrations": {"counts": [4, 6], "held_out": 3, "test": {"count": 9}},
    "kept": [{"table": "table.csv"}],
}
HAND = """study,task,method,demonstrations,seed,measure,value
by_hand,a,"ours, k = 2",10,0,success,0.5
by_hand,a,"ours, k = 2",10,1,success,0.7
by_hand,a,"ours, k = 2",10,2,success,0.9
by_hand,a,"ours, k = 2",10,,success,0.1
by_hand,a,theirs,20,0,success,0.4
by_hand,a,theirs,20,1,success,0.5
by_hand,a,theirs,20,2,success,1.0
by_hand,b,summary,,,nats,-2.5
other,a,theirs,20,0,success,0.0
""" + "".join(  # "two" is above "base" with a one-sided p of 0.018
    f"family,a,{name},{count},{seed},goals,{value}\n"
    for name, values in {"one": [3, 4, 5, 4], "two": [1, 2, 3, 1], "base": [0] * 4}.items()
    for count in (10, 20)
    for seed, value in enumerate(values)
)


@pytest.fixture
def rendered(tmp_path, monkeypatch):
    """Renders a page with one table, whose template is given."""
    monkeypatch.setattr(page, "STUDIES", tmp_path)
    monkeypatch.setattr(page, "RESULTS", tmp_path)
    (tmp_path / "tables").mkdir()
    (tmp_path / "hand.csv").write_text(HAND)

    def of(template):
        (tmp_path / "tables" / "mine.md").write_text(f"## first\n\n| other |\n\n## own\n\n{template}\n")
        now = page.render("Before.\n\n<!-- table: mine/own -->\nold\n<!-- end -->\n\nAfter.\n")
        assert page.render(now) == now
        begin, end = "Before.\n\n<!-- table: mine/own -->\n\n", "\n\n<!-- end -->\n\nAfter.\n"
        assert now.startswith(begin)
        assert now.endswith(end)
        return now.removeprefix(begin).removesuffix(end)

    return of


@pytest.mark.parametrize(
    ("number", "said"),
    [
        ("ours, k = 2; success; 10", "70% [20%, 120%]"),  # sd 0.2; t(0.975, 2) = 4.3027 times 0.2 / √3
        ("ours, k = 2; success; 10; show=±; form=.3f", "0.700 ± 0.497"),
        ("ours, k = 2; success; 10; show=sd; times=100; form=.1f", "70.0 ± 20.0"),
        ("ours, k = 2; success; 10; show=se; form=.3f", "0.700 ± 0.115"),
        ("ours, k = 2; success; 10; show=range", "50% to 90%"),
        ("ours, k = 2; success; 10; seed=1; show=mean", "70%"),
        ("ours, k = 2 - theirs; success; 10 - 20; study=by_hand; show=above", "2 of 3"),
        ("ours, k = 2 - theirs; success; 10 - 20; study=by_hand; show=mean; form=+.2f", "+0.07"),
        ("summary; nats", "−2.50"),
        ("one - base; goals; 10; form=+.1f", "+4.0 [+2.7, +5.3]"),
        ("base - one; goals; 10; show=±; form=.1f", "−4.0 ± 1.3"),
        ("one - base; goals; 10; show=verdict", "holds"),
        ("base - one; goals; 10; show=verdict", "does not hold"),
        ("base - base; goals; 10; show=verdict", "not tested"),
        ("one - base; goals; 10; task=a; seed=1", "+4.00"),
        ("base; goals; 10", "0.00"),
        ("one - base; goals; 10; show=median", "+4.00"),
        ("one; goals; 10; seed=1-2; show=range", "4.00 to 5.00"),
        ("theirs; success; 20; study=other", "0%"),
    ],
)
def test_a_number_is_that_of_the_table_by_hand(rendered, number, said):
    assert rendered(f"| a |\n|---|\n| {{hand.csv: {number}}} |") == f"| a |\n|---|\n| {said} |"


def test_several_methods_and_counts_are_a_whole_table(rendered):
    assert rendered("{hand.csv: ours, k = 2 | theirs; success; 10 | 20; study=by_hand}") == (
        "| demonstrations | measure | ours, k = 2 | theirs |\n|--:|---|--:|--:|\n"
        "| 10 | Success | 70% | – |\n| 20 | Success | – | 63% |"
    )


NO_NUMBER = "{hand.csv: one; goals; 11}: there is no such number; check its names"


@pytest.mark.parametrize(
    ("template", "said"),
    [
        ("{hand.csv: one; goals; 11}", NO_NUMBER),
        ("{hand.csv: one}", "write a method or contrast, a measure and a number of demonstrations"),
        ("{hand.csv: one; goals; 10; show=all}", "After show= stands one of: interval, mean"),
        ("{none.csv: one; goals; 10}", "none.csv: cannot be read: No such file or directory"),
    ],
)
def test_a_number_that_is_not_there_is_refused(rendered, template, said):
    with pytest.raises(BadInput, match=re.escape(said)):
        rendered(template)


def test_a_table_that_is_not_there_is_refused(rendered):
    rendered("| a |")
    with pytest.raises(BadInput, match=r"has no table 'owm' \(did you mean 'own'\?\)"):
        page.render("<!-- table: mine/owm -->\n<!-- end -->\n")


def test_verdicts_of_a_page_are_those_that_holm_leaves(rendered):
    """Two differences of one family at a one-sided p of 0.018 are inconclusive together."""
    own = "{hand.csv: two - base; goals; 10; show=verdict}"
    assert "holds" in rendered(own)
    assert "inconclusive" in rendered(own + "{hand.csv: two - base; goals; 20}")


def test_a_fixed_sequence_goes_on_beside_equivalence(rendered, tmp_path):
    """Differences of 3, 4, 5 and 4 with four demonstrations; with six of 0 and 1."""
    nats = {"contrast": "options - flat", "measure": "nats"}
    first, last = ({**nats, "demonstrations": number} for number in (4, 6))
    equal = {**first, "kind": "equivalence", "margin": 0.5}
    contrasts = [equal, first, last, {**first, "contrast": "flat - options"}]
    study = STUDY | {"contrasts": contrasts, "correction": "fixed_sequence"}
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(study))
    values = {("options", 4): [3, 4, 5, 4], ("options", 6): [0, 1, 0, 1]}
    values |= {("flat", number): [0] * 4 for number in (4, 6)}
    rows = [("study", "a", method, str(count), str(seed), "nats", value)
            for (method, count), own in values.items() for seed, value in enumerate(own)]  # fmt: skip
    pd.DataFrame(rows, columns=COLUMNS).to_csv(tmp_path / "table.csv", index=False)
    for asked, said in (
        ("options - flat; nats; 4; show=equivalence", "does not hold"),
        ("options - flat; nats; 4; show=verdict", "holds"),
        ("options - flat; nats; 6; show=verdict", "inconclusive"),
        ("flat - options; nats; 4; show=verdict", "not reached"),
        ("options - flat; nats; 4", "**+4.00 [+2.70, +5.30]**"),
    ):
        assert rendered(f"{{study.yaml: {asked}}}") == said
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(study | {"exploratory": True}))
    assert rendered("{study.yaml: options - flat; nats; 4}") == "+4.00 [+2.70, +5.30]"


def test_a_declaration_names_methods_and_measures_its_own_way(rendered, tmp_path):
    kept = [{"table": "hand.csv", "methods": {"mine": "one"}, "measures": {"points": "goals"}}]
    methods = {"mine": {}, "flat": {"baseline": "flat"}}
    demonstrations = STUDY["demonstrations"] | {"counts": [10], "test": {"count": 13}}
    starts = {"test": {"count": 2, "first": 100}}
    study = STUDY | {"kept": kept, "methods": methods, "demonstrations": demonstrations, "starts": starts}
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(study | {"measures": ["points"]}))
    assert rendered("{study.yaml: mine; points; 10; show=mean}") == "4.00"


def test_the_command_renders_checks_and_refuses_in_one_line(rendered, tmp_path, monkeypatch, capsys):
    rendered("| {hand.csv: one; goals; 10} |")
    path = tmp_path / "page.md"
    path.write_text("<!-- table: mine/own -->\n<!-- end -->\n")

    def run(*words):
        monkeypatch.setattr("sys.argv", ["studies", *map(str, words)])
        try:
            main()
        except SystemExit as ended:
            return ended.code, capsys.readouterr().err
        return 0, capsys.readouterr().out

    status, said = run("render", "--check", path)
    says = f"{path}: differs from the results; write it with: python -m studies render {path}\n"
    assert (status, said) == (1, says)
    assert run("render", path) == run("render", "--check", path) == (0, "1 pages agree with the results\n")
    assert "| 4.00 [2.70, 5.30] |" in path.read_text()
    for words, text in (
        (("status", tmp_path / "none.yaml"), "none.yaml: cannot be read"),
        (("status", path, path), "one study at a time"),
        (("render", tmp_path), "is missing; check the path"),
    ):
        status, said = run(*words)
        assert (status, said.count("\n")) == (2, 1)
        assert text in said
    status, said = run("status", ROOT / "studies" / "bins.yaml", "--out", tmp_path / "out")
    assert (status, said) == (0, "9 of 9 cells are done\n")
    status, said = run("report", ROOT / "studies" / "bins.yaml", "--out", tmp_path / "out")
    assert status == 0
    assert "| options - mixture | Success | 60 | superiority | inconclusive | −" in said
    assert (tmp_path / "out" / "table.csv").read_text().startswith(",".join(COLUMNS))


# --- the pages of the project -------------------------------------------------------------------------------


@pytest.mark.parametrize("path", GENERATED, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_of_the_project_agree_with_the_results(path):
    assert page.render(path.read_text()) == path.read_text()


def test_every_page_with_results_has_a_table_on_its_first_screen():
    assert {path.stem for path in (ROOT / "docs" / "results").glob("*.csv")} - {"performance"} <= {
        path.stem for path in GENERATED if page.BLOCK.search(path.read_text().partition("\n## ")[0])
    }


def test_every_table_stands_on_a_page():
    there = {name for path in GENERATED for name in page.BLOCK.findall(path.read_text())}
    made = {
        (path.stem, name)
        for path in (ROOT / "studies" / "tables").glob("*.md")
        for name in re.findall(r"^## (\w+)$", path.read_text(), re.MULTILINE)
    }
    assert there == made


RAW = re.compile(r"<!--|-->|\*\*|__\w|\]\(|`|^\s*\||\|\s*:?-{2,}|^#{1,6} |\{\w+\.(csv|yaml):", re.MULTILINE)
"""What is Markdown, or a comment, and nothing that a reader is to see."""


def raw(text):
    """Raw Markdown and comments in a page as GitHub shows it, and the lines that would begin a raw line."""
    shown = []
    for block in MarkdownIt("commonmark").enable(["table", "strikethrough"]).parse(text):
        parts = [part for part in block.children or [block] if not part.type.startswith(("code", "fence"))]
        visible = "".join(part.content or "\n" * part.type.endswith("break") for part in parts)
        shown.append(re.sub(r"<!--.*?-->|<[^>]*>", "", visible, flags=re.DOTALL))
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return RAW.findall("\n".join(shown)) + re.findall(r"^<!--.*-->[ \t]*\S.*", prose, re.MULTILINE)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_page_shows_raw_markdown_or_comments(path):
    assert raw(path.read_text()) == []


def rows(table, **named):
    """The value of each seed, read by pandas alone."""
    whole = pd.read_csv(ROOT / table, dtype=str, keep_default_na=False)
    own = whole[np.all([whole[column] == value for column, value in named.items()], axis=0)]
    return own.assign(value=own.value.astype(float)).set_index(["task", "seed"]).value


def difference(ours, theirs, form):
    """A mean difference and its t interval, over seeds or, of several, over tasks or their families."""
    paired = (ours - theirs).dropna()
    tasks = paired.groupby("task").mean()
    if len(tasks) > 1:
        families = yaml.safe_load((ROOT / "studies" / "frozen.yaml").read_text())["families"]
        related = {task: family for family, own in families.items() for task in own}
        paired = tasks.groupby(lambda task: related.get(task, task)).mean()
    low, high = stats.ttest_1samp(paired, 0).confidence_interval(0.95)
    return f"{paired.mean():{form}} [{low:{form}}, {high:{form}}]".replace("-", "−")


def of(table, *methods, **named):
    """The values by seed of each method in a table."""
    return [rows(table, method=method, **named) for method in methods]


def test_numbers_of_readme_are_those_of_the_tables_by_pandas_alone():
    text = (ROOT / "README.md").read_text().replace("**", "")
    results, own, names = "docs/results/{}.csv".format, {"measure": "success"}, ("options", "flow", "lstm")
    shown = (("six tasks of Meta-World", "peers", "10"), ("a goal shown once", "hidden", "40"))
    for named, study, count in shown:
        known = of(results(study), *names, study=study, demonstrations=count, **own)
        means = " | ".join(f"{one.groupby('task').mean().mean():.0%}" for one in known)
        assert f"| {named} | {count} | {means} |" in text
    flat, mixture, options = of(
        results("hidden"), "flat", "mixture", "options", study="hidden", demonstrations="40", **own
    )
    marginal = {"study": "needle", "demonstrations": "100", "measure": "success, acting by marginal"}
    needle = of(results("needle"), "flat", "ddco", study="needle", demonstrations="100", **own)
    needle.insert(1, *of(results("memory"), "mixture", **marginal))
    for named, count, known in (("a goal shown once", 40, (flat, mixture, options)), ("needle", 100, needle)):
        parts = [difference(known[n + 1], known[n], "+.0%") for n in range(2)]
        assert f"| {named} | {count} | success | {' | '.join(parts)} | 10 |" in text
    by_em = {"study": "arena_em", "demonstrations": "50", "measure": "nmi"}
    for named, table, form, of_study in (
        ("27 tasks | 10 | success", "frozen", "+.0%", {"demonstrations": "10", **own}),
        ("26 tasks | 10 | success", "frozen_again", "+.0%", {"demonstrations": "10", **own}),
        ("9 tasks | 50 | NMI", "arena_em", "+.2f", by_em),
    ):
        known = of(f"studies/{table}.csv", "options", "mixture", **of_study)
        assert f"{named} | – | {difference(*known, form)} | 3 |" in text
    people = {"study": "surgeon", "measure": "accuracy"}
    for named, task in (("knot tying", "Knot_Tying"), ("suturing", "Suturing")):
        methods = ("options, 3 labelled", "recogniser, transitions, 3 labelled")
        folds = of(results("people"), *methods, task=task, **people)
        parts = " | ".join(difference(one, 0 * one, ".2f") for one in folds)
        assert f"| {named}, right steps | {parts} |" in text

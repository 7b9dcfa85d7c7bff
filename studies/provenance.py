"""Which code made a result, and whether that code has changed since.

    python studies/provenance.py          # names the results that are older than their code
    python studies/provenance.py adopt    # gives results that do not say what made them what git knows of it

A result is a file under ``docs/results``, with the page, table and picture of the same name beside it. Its JSON has
``provenance``, a list of records, and ``results``. A record says by which ``command`` the result was made, at which
``commit``, whether files that it depends on were ``dirty`` (not as in that commit), the hash of their ``code``, and the
number of ``files``; there are several where a study went on after its code had changed. A result that was adopted has
``added_at``, the commit that brought it, instead of ``commit``. Needs neither torch nor a network.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import io
import json
import re
import shlex
import subprocess
import tomllib
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import yaml

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ("docs/results", "benchmarks/results")
PACKAGES = {"ddco_pyro": "ddco_pyro", "ddco_tasks": "tasks"}
"""Import name to folder."""
NO_NUMBERS = ("ddco_pyro/report/", "studies/provenance.py")
"""Left out of what a result depends on: this shows numbers, or says what made them."""

FOLDERS = ("benchmarks", "ddco_pyro", "specs", "studies", "tasks", "tests")
SHARED = ("studies", "tests/support")
"""Where scripts find modules beside those of their own folder."""
ENDINGS = {".py", ".yaml", ".xml", ".json", ".toml", ".j2", ".txt"}

Record = dict[str, Any]


# --- what a command depends on ----------------------------------------------------------------------------------------


Files = Mapping[str, bytes]
"""Contents by path from the project's root, with slashes."""


def tree(root: Path) -> Files:
    """The files that a command may depend on, as they are now."""
    places = [root / "pyproject.toml", *(path for folder in FOLDERS for path in (root / folder).rglob("*"))]
    kept = (path for path in places if path.suffix in ENDINGS and path.is_file())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in kept}


def sources(files: Files, command: str) -> dict[str, str]:
    """Digest of every file that a command depends on, by path.

    From the command's script on, imports are followed, and so are names of files beside the file that names them, such
    as a scene. Scripts and the command itself may name specs, specs name tasks. What makes no numbers is left out. A
    digest is blind to comments, docstrings and format.

    :raises LookupError: the command's script is not there.
    """
    words = shlex.split(command)
    script = "ddco_pyro/cli/app.py" if words[0] == "ddco-pyro" else next(word for word in words if word.endswith(".py"))
    if script not in files:
        raise LookupError(script)
    todo, found = [script, *_specs(files, words)], dict[str, str]()
    while todo:
        name = todo.pop()
        if name in found or name.startswith(NO_NUMBERS):
            continue
        content, folder = files[name], name.rpartition("/")[0]
        found[name] = hashlib.sha256(content).hexdigest()
        if name.endswith(".py"):
            module = _parsed(content)
            found[name] = module.digest
            todo += [*_imported(files, folder, module.imports), *_named(files, folder, module.constants)]
        elif name.endswith(".yaml"):
            todo += _tasks(files, yaml.safe_load(content))
    return dict(sorted(found.items()))


def code(files: Mapping[str, str]) -> str:
    """One hash of all files."""
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()


class _Module(NamedTuple):
    digest: str
    imports: frozenset[tuple[int, str, str]]
    """Level (of dots), module and name of each import."""
    constants: frozenset[str]
    """Strings that may name a file."""


@cache
def _parsed(content: bytes) -> _Module:
    imports: set[tuple[int, str, str]] = set()
    constants: set[str] = set()
    digest = hashlib.sha256(repr(_canonical(ast.parse(content), imports, constants)).encode()).hexdigest()
    return _Module(digest, frozenset(imports), frozenset(constants))


_PATH = re.compile(r"(?=.{1,80}$)[\w-][\w.-]*(/[\w-][\w.-]*)*")


def _canonical(node: Any, imports: set[tuple[int, str, str]], constants: set[str]) -> Any:
    """What of a tree is executed, whatever the format and the version of Python; gathers what it imports and names."""
    if isinstance(node, list):
        return [_canonical(one, imports, constants) for one in node if not _is_text(one)]
    if not isinstance(node, ast.AST):
        return repr(node)
    if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
        return _canonical(node.orelse, imports, constants)
    if isinstance(node, ast.Import):
        imports |= {(0, alias.name, "") for alias in node.names}
    elif isinstance(node, ast.ImportFrom):
        imports |= {(node.level, node.module or "", alias.name) for alias in node.names}
    elif isinstance(node, ast.Constant) and isinstance(node.value, str) and _PATH.fullmatch(node.value):
        constants.add(node.value)
    fields = ((name, getattr(node, name, None)) for name in node._fields)
    return (
        type(node).__name__,
        [(name, _canonical(value, imports, constants)) for name, value in fields if value not in (None, [])],
    )


def _is_text(node: Any) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _imported(files: Files, folder: str, imports: Iterable[tuple[int, str, str]]) -> Iterator[str]:
    """Files of the modules that a file in ``folder`` imports, and of the packages that they are in."""
    for level, module, name in imports:
        first, *rest = module.split(".")
        if level:
            above = folder.split("/")[: len(folder.split("/")) - level + 1]
            places = [[*above, first, *rest]]
        elif first in PACKAGES:
            places = [[PACKAGES[first], *rest]]
        elif _holds_scripts(files, folder):
            places = [[*place.split("/"), first, *rest] for place in (folder, *SHARED)]
        else:
            continue
        for place in places:
            parts = [part for part in (*place, name) if part]
            for end in range(len(parts), 0, -1):
                path = "/".join(parts[:end])
                yield from (one for one in (f"{path}.py", f"{path}/__init__.py") if one in files)


def _holds_scripts(files: Files, folder: str) -> bool:
    return f"{folder}/__init__.py" not in files


def _named(files: Files, folder: str, constants: Iterable[str]) -> list[str]:
    beside = [f"{folder}/{word}" for word in constants]
    used = [name for name in beside if name in files and not name.startswith(RESULTS)]
    return used + (_specs(files, constants) if _holds_scripts(files, folder) else [])


def _specs(files: Files, words: Iterable[str]) -> list[str]:
    """Specs that are named by their path or by their name alone."""
    return [
        name for word in words for name in (word, f"specs/{word}.yaml") if name.startswith("specs/") and name in files
    ]


def _tasks(files: Files, spec: Any) -> list[str]:
    """Modules of the registered tasks that a spec names, at any depth."""
    if not isinstance(spec, dict):
        return []
    found = [name for value in spec.values() for name in _tasks(files, value)]
    module, _, _ = _entry_points(files["pyproject.toml"]).get(spec.get("task"), "").partition(":")
    return found + list(_imported(files, "", [(0, module, "")] if module else []))


@cache
def _entry_points(content: bytes) -> dict[Any, str]:
    found: dict[Any, str] = tomllib.loads(content.decode())["project"]["entry-points"]["ddco_pyro.tasks"]
    return found


# --- records ----------------------------------------------------------------------------------------------------------


def record(command: str, root: Path = ROOT) -> Record:
    """What a result has to say of the code that makes it; call it before the work starts."""
    files = sources(tree(root), command)
    commit = _git(root, "rev-parse", "--short", "HEAD")
    dirty = None if commit is None else bool(_git(root, "status", "--porcelain", "--", *files))
    return {"command": command, "commit": commit, "dirty": dirty, "code": code(files), "files": len(files)}


def text(results: Any, records: Iterable[Record | None]) -> str:
    """The JSON of a result, with the distinct records of what it was made from."""
    return json.dumps({"provenance": distinct(records), "results": results}, indent=1) + "\n"


def distinct(records: Iterable[Record | None]) -> list[Record | None]:
    """Records that differ in more than the command; None is what nothing is known of."""
    return list({json.dumps((one or {}) | {"command": ""}, sort_keys=True): one for one in records}.values())


def is_kept(content: Any, settings: Mapping[str, Any], made_by: Record) -> bool:
    """Whether a result that a study keeps as JSON, settings and all, is what this code gives with these settings."""
    if [one and one.get("code") for one in content.get("provenance", [])] != [made_by["code"]]:
        return False
    return all(content["results"].get(key) == value for key, value in settings.items())


def sentence(command: str, records: Iterable[Record | None]) -> str:
    """The line of a page that says what made it."""
    found = distinct(records)
    made = dict.fromkeys(_at(one) for one in found if one is None or "added_at" not in one)  # each commit once
    added = dict.fromkeys(f"commit {one['added_at']}" for one in found if one is not None and "added_at" in one)
    parts = ([f" at {', '.join(made)}"] if made else []) + ([f"; added at {', '.join(added)}"] if added else [])
    return f"Made by `{command}`{''.join(parts)}."


def _at(one: Record | None) -> str:
    if one is None or one["commit"] is None:
        return "an unknown commit"
    return f"commit {one['commit']}" + (" with uncommitted changes" if one["dirty"] else "")


def _git(root: Path, *arguments: str) -> str | None:
    """What git says of this very tree; None where it is not a checkout, or git does not know."""
    if not (root / ".git").exists():
        return None
    ended = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=False)
    return ended.stdout.strip() if ended.returncode == 0 else None


# --- results ----------------------------------------------------------------------------------------------------------


def results(root: Path) -> list[Path]:
    """Every result, without the ending of its files."""
    files = [path for name in RESULTS for path in (root / name, *(root / name).rglob("*"))]
    return sorted({path.with_suffix("") for path in files if _is_result(path)})


def _is_result(path: Path) -> bool:
    return path.is_file() and path.suffix in _ENDINGS and path.stem != "README"


_ENDINGS = (".json", ".csv", ".md")
"""Of files that hold a result's numbers, the first that tells best when they came."""


def records_of(result: Path) -> list[Record | None]:
    """A result's records; none where it has no JSON, or one that does not say."""
    found = _content(result)
    return found.get("provenance", []) if isinstance(found, dict) else []


def outdated(root: Path) -> list[str]:
    """A line for each result that is older than its code, or of which that is not known."""
    lines, today = [], tree(root)
    for result in results(root):
        name = result.relative_to(root).as_posix()
        for one in records_of(result) or [None]:
            problem = "unknown: it does not say which code made it" if one is None else _changes(root, today, one)
            if problem:
                lines.append(f"{name}: {problem}")
    return lines


def _changes(root: Path, today: Files, one: Record) -> str:
    """How a record's code differs from today's; empty where it does not."""
    try:
        now = sources(today, one["command"])
    except LookupError as error:
        return f"unknown: {error} is gone"
    if code(now) == one["code"]:
        return ""
    commit = one.get("commit") or one.get("added_at")
    then = _sources_at(root, commit, one["command"]) if commit else None
    if then is None:
        known = commit and _tree_at(root, commit)
        why = "at which its script lay elsewhere" if known else "which git does not have here"
        return f"older than its code (commit {commit or 'unknown'}, {why})"
    files = now.keys() | then.keys()
    changed = [name for name in files if now.get(name) != then.get(name)]
    more = ", and others that were not committed" if one.get("dirty") else ""
    return f"older than its code: since commit {commit} {len(changed)} of {len(files)} files have changed{more}"


def _sources_at(root: Path, commit: str, command: str) -> dict[str, str] | None:
    """:func:`sources` as of a commit; None where git does not have it, or the script was not there."""
    try:
        return sources(_tree_at(root, commit), command)
    except LookupError:
        return None


@cache
def _tree_at(root: Path, commit: str) -> Files:
    if _git(root, "cat-file", "-e", f"{commit}^{{commit}}") is None:
        return {}
    command = ["git", "-C", str(root), "archive", "--format=zip", "-0", commit, "--", ":!docs", ":!notebooks"]
    archive = zipfile.ZipFile(io.BytesIO(subprocess.run(command, capture_output=True, check=True).stdout))
    return {name: archive.read(name) for name in archive.namelist() if Path(name).suffix in ENDINGS}


def adopt(root: Path) -> list[str]:
    """Give every result that does not say what made it the commit that brought it, and the hash of its code then.

    The command is taken from its JSON (``command``, or ``PART_command`` where parts were made apart), from its page (a
    line ``Command: `…```), or from the summary in its folder; a result without any stays as it is.

    :returns: the results that have been adopted.
    """
    from ddco_pyro.data.files import write_text

    adopted = []
    for result in (one for one in results(root) if not records_of(one)):
        commands = _commands(result)
        numbers = next(path for path in map(result.with_suffix, _ENDINGS) if path.exists())
        commit = _git(root, "log", "-1", "--format=%h", "--", str(numbers))
        files = _sources_at(root, commit, next(iter(commands.values()))) if commit and commands else None
        if files is None:
            continue
        known = {"added_at": commit, "code": code(files), "files": len(files)}
        made_by = {key: {"command": command} | known for key, command in commands.items()}
        content = _content(result)
        if isinstance(content, dict):
            kept = {key: value for key, value in content.items() if key not in commands}
            content = kept | {
                key.replace("_command", "_made_by"): one for key, one in made_by.items() if key in content
            }
            content.pop("command", None)
        write_text(result.with_suffix(".json"), text(content, made_by.values()))
        page = result.with_suffix(".md")
        if page.exists():
            write_text(page, _COMMAND.sub(partial(_adopted, known), page.read_text()))
        adopted.append(result.relative_to(root).as_posix())
    return adopted


_COMMAND = re.compile(r"^Command: `([^`]+)`\.?", re.MULTILINE)


def _adopted(known: Record, line: re.Match[str]) -> str:
    return sentence(line[1], [known])


def _commands(result: Path) -> dict[str, str]:
    """What made a result, or each of its parts, by the key that its JSON has for it."""
    content = _content(result)
    if isinstance(content, dict):
        found = {key: value for key, value in content.items() if key == "command" or key.endswith("_command")}
        if found:
            return found
    pages = (result.with_suffix(".md"), result.with_name("summary.md"))
    named = (_COMMAND.search(page.read_text()) for page in pages if page.exists())
    match = next(filter(None, named), None)
    return {"command": match[1]} if match else {}


def _content(result: Path) -> Any:
    path = result.with_suffix(".json")
    return json.loads(path.read_text()) if path.exists() else None


def main() -> None:
    """Say which results are older than their code, or adopt those that do not say."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=["check", "adopt"], default="check")
    if parser.parse_args().what == "adopt":
        print(*(f"adopted {name}" for name in adopt(ROOT)), sep="\n")
        return
    if not (ROOT / ".git").exists():
        print("no git checkout: how much of the code of a result has changed cannot be said")
    lines = outdated(ROOT)
    if lines:
        print("warning: results that may not be what their commands give today:", *lines, sep="\n  ")


if __name__ == "__main__":
    main()

"""What the site is made of beside the pages: references from the code, equations, and commands that were run.

- ``spec.md`` comes from the spec's schema, ``cli.md`` from the command line itself.
- ``$...$`` and ``$$...$$`` become MathML, which browsers show without a script.
- A fence ``run`` is run while the site is built, in one folder for each page, and its output stands below it;
  one that fails fails the build. A fence ``file NAME`` writes a file there.
"""

from __future__ import annotations

import html
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import latex2mathml.converter
import typer
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

from ddco_pyro.cli.app import app
from ddco_pyro.spec import spec_schema

SECONDS = 300
OUTPUT_LINES = 40


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages."""
    files.append(File.generated(config, "spec.md", content=spec_page()))
    files.append(File.generated(config, "cli.md", content=command_page()))
    return files


def on_page_markdown(markdown: str, page: Any, **more: Any) -> str:
    """Run what is to be run, and set the equations."""
    with tempfile.TemporaryDirectory() as folder:
        parts = re.split(r"(^```.*?^```$)", markdown, flags=re.MULTILINE | re.DOTALL)
        return "".join(
            fence(part, Path(folder), page.file.src_path) if part.startswith("```") else equations(part)
            for part in parts
        )


# --- equations ----------------------------------------------------------------------------------------------


def equations(text: str) -> str:
    """TeX to MathML, outside of code."""
    text = re.sub(r"\$\$(.+?)\$\$", lambda found: _mathml(found[1], "block"), text, flags=re.DOTALL)
    return re.sub(r"(?<![\w`])\$([^$`\n]+?)\$(?![\w`])", lambda found: _mathml(found[1], "inline"), text)


def _mathml(tex: str, display: str) -> str:
    found = latex2mathml.converter.convert(" ".join(tex.split()), display=display)
    if display == "inline":
        return f"<span>{found}</span>"  # a line that begins with <math> would be a paragraph of its own
    return f'<div style="margin: 1.2em 0; overflow-x: auto">{found}</div>'


# --- commands that are run ----------------------------------------------------------------------------------


def fence(block: str, folder: Path, page: str) -> str:
    """A fenced block; ``run`` and ``file`` do what they say."""
    head, _, rest = block.partition("\n")
    body = rest.removesuffix("```")
    words = head.removeprefix("```").split()
    if words[:1] == ["file"]:
        (folder / words[1]).write_text(body)
        language = {".py": "python", ".yaml": "yaml"}.get(Path(words[1]).suffix, "text")
        return f'```{language} title="{words[1]}"\n{body}```'
    if words[:1] == ["run"]:
        shown = [f"```console\n$ {line}\n{run(line, folder, page)}```" for line in body.splitlines() if line]
        return "\n\n".join(shown)
    return block


def run(line: str, folder: Path, page: str) -> str:
    """The output of a command, without the progress of it; long output is cut in the middle."""
    command = shlex.split(line)
    beside = Path(sys.executable).with_name(command[0])
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "110", "PYTHONHASHSEED": "0"}
    ended = subprocess.run(
        [beside if beside.exists() else command[0], *command[1:]],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=SECONDS,
    )
    if ended.returncode:
        raise PluginError(f"{page}: {line!r} ended with {ended.returncode}: {ended.stderr.strip()}")
    lines = [one.rstrip() for one in ended.stdout.splitlines()]
    if len(lines) > OUTPUT_LINES:
        lines = [*lines[: OUTPUT_LINES // 2], "...", *lines[-OUTPUT_LINES // 2 :]]
    return "\n".join([*lines, ""])


# --- the spec -----------------------------------------------------------------------------------------------


def spec_page() -> str:
    """Every key of a spec: what it is, what it takes, what it is without."""
    schema = spec_schema()
    about = (
        "A spec is a YAML file. Unknown keys, wrong types and values out of range are one line each, with "
        "the nearest valid key. `ddco-pyro check SPEC` prints a spec with all its defaults, `ddco-pyro check "
        "--schema` the JSON Schema that this page is made from."
    )
    parts = [f"# The spec\n\n{about}\n"]
    parts += _section("", schema, schema["$defs"])
    order = [name for name in schema["$defs"] if schema["$defs"][name].get("type") == "object"]
    parts += [part for name in order for part in _section(name, schema["$defs"][name], schema["$defs"])]
    return "\n".join(parts)


def _section(name: str, model: dict[str, Any], definitions: dict[str, Any]) -> Iterator[str]:
    title = name.removesuffix("Spec") or "The whole spec"
    about = model.get("description", "").partition(">>>")[0]  # without the example
    yield f"\n## {title} {{#{name.lower() or 'whole'}}}\n\n{_cell(about.strip())}\n"
    yield "| key | takes | default | |\n|---|---|---|---|"
    for key, field in model.get("properties", {}).items():
        default = "required" if key in model.get("required", ()) else _default(field)
        yield f"| `{key}` | {_type(field, definitions)} | {default} | {_cell(_about(field, definitions))} |"


def _about(field: dict[str, Any], definitions: dict[str, Any]) -> str:
    """What a key is; a part of the spec says it itself."""
    own = definitions.get(field.get("$ref", "").rpartition("/")[2], {})
    return str(field.get("description") or own.get("description", ""))


def _default(field: dict[str, Any]) -> str:
    if "default" not in field:
        return ""
    value = field["default"]
    return "" if isinstance(value, dict) else f"`{json.dumps(value, ensure_ascii=False)}`"


def _type(field: dict[str, Any], definitions: dict[str, Any]) -> str:
    if "$ref" in field:
        name = field["$ref"].rpartition("/")[2]
        if definitions[name].get("type") != "object":
            return _type(definitions[name], definitions)
        return f"[{name.removesuffix('Spec')}](#{name.lower()})"
    for several in ("anyOf", "oneOf", "allOf"):
        if several in field:
            return " or ".join(dict.fromkeys(_type(one, definitions) for one in field[several]))
    if "enum" in field:
        return ", ".join(f"`{one}`" for one in field["enum"])
    if "const" in field:
        return f"`{str(field['const']).lower()}`"
    if field.get("type") == "array":
        return f"list of {_type(field.get('items', {}), definitions)}"
    names = {"integer": "whole number", "string": "text", "boolean": "true, false", "object": "mapping"}
    limits = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    bounds = ", ".join(f"{sign} {field[limit]}" for limit, sign in limits.items() if limit in field)
    found = names.get(field.get("type", ""), field.get("type", "anything"))
    return f"{found} {bounds}".strip()


def _cell(text: str) -> str:
    """Text of a docstring as Markdown in a table."""
    return " ".join(text.replace("``", "`").split()).replace("|", "\\|")


# --- the commands -------------------------------------------------------------------------------------------


def command_page() -> str:
    """Every command with its arguments and options, as the command line itself describes them."""
    group: Any = typer.main.get_command(app)
    ends = "Every command ends with 0 (done), 1 (failed) or 2 (bad input)."
    parts = [f"# The commands\n\n{group.help}\n\n{ends} {group.epilog}\n"]
    for name, command in group.commands.items():
        context = command.make_context(name, ["--help"], resilient_parsing=True)
        usage = " ".join(command.collect_usage_pieces(context))
        about = " ".join(command.help.split("\n\n")[0].split())
        parts.append(f"\n## {name}\n\n{html.escape(about)}\n\n```console\n$ ddco-pyro {name} {usage}\n```\n")
        rows = [one.get_help_record(context) for one in command.params]
        table = "\n".join(f"| `{left}` | {_cell(right)} |" for left, right in rows)
        parts.append(f"| argument or option | what it is |\n|---|---|\n{table}")
        if command.epilog:
            parts.append(f"\nExample: `{command.epilog.removeprefix('Example: ')}`\n")
    return "\n".join(parts)

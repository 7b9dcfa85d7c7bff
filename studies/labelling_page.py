"""What demonstrations cost on the page of ``ddco-pyro label``, by a simulated person who drives it in chromium.

    python -m studies.labelling_page RUN DEMOS LABELS TRUTH --way proposals|scratch [--demonstrations 3] [--slack 1]

The person knows LABELS of the file TRUTH, which DEMOS need not have, and uses keys and the mouse alone: the cursor is
set by a click, and corrected by arrow keys. With *proposals* the person does the commands of a cheapest plan, looking
again after each. From *scratch* names go on from the cursor, and each segment is named from its first step. Then the
person accepts, waits for the refit, and goes on with the demonstration that the page opens. Each command that the
server acknowledges counts one, and so does the naming of an option. Prints a line for each demonstration: edits, those
of labelling by hand (each boundary, each name of a segment, each new label), seconds of waiting for the page, and right
steps of all demonstrations. Names that the run has are removed first.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Page, sync_playwright

from ddco_pyro.data.demonstrations import Demonstrations

GUTTER = 108
CHROMIUM = "/usr/bin/chromium"
PATIENCE = 120_000

Segments = list[tuple[str, int, int]]
"""(name, first step, step after the last)."""


OPEN = "label -1"
"""Of steps without a label, which the person leaves open."""


def stretches(labels: np.ndarray) -> Segments:
    """The segments of labels [T]."""
    edges = [0, *(np.flatnonzero(np.diff(labels)) + 1).tolist(), len(labels)]
    return [(f"label {labels[start]}", start, stop) for start, stop in itertools.pairwise(edges)]


def plan(shown: Segments, wanted: Segments, slack: int) -> list[tuple[Any, ...]]:
    """Commands that turn what is shown into what is wanted, by the cheapest path through pairs of segments."""
    best: dict[tuple[int, int], tuple[int, str]] = {}
    for i, (option, start, stop) in enumerate(shown):
        for j, (name, to, _) in enumerate(wanted):
            ways = [(0, "")] if i == j == 0 else []
            if (i, j - 1) in best and start < to < stop:
                ways.append((best[i, j - 1][0] + 1, "split"))
            if (i - 1, j) in best:
                ways.append((best[i - 1, j][0], "join"))
            if (i - 1, j - 1) in best and (abs(start - to) <= slack or shown[i - 1][1] < to < stop):
                ways.append((best[i - 1, j - 1][0] + (abs(start - to) > slack), "move"))
            if ways:
                cost, way = min(ways, key=lambda own: own[0])
                best[i, j] = cost + (option != name), way
    i, j, path = len(shown) - 1, len(wanted) - 1, list[tuple[int, int, str]]()
    while i >= 0 and j >= 0:
        way = best[i, j][1]
        path.append((i, j, way))
        i, j = i - (way != "split"), j - (way != "join")
    commands = list[tuple[Any, ...]]()
    for i, pairs in itertools.groupby(reversed(path), key=lambda own: own[0]):
        (option, start, _), own = shown[i], [*pairs]
        first = wanted[own[0][1]]
        if own[0][2] == "move" and abs(start - first[1]) > slack:
            commands.append(("move", start, first[1]))
        commands += [("split", wanted[j][1]) for _, j, way in own if way == "split"]
        commands += [
            ("name", wanted[j][1] if way == "split" else start, wanted[j][0])
            for _, j, way in own
            if wanted[j][0] != option
        ]
    return commands


class Person:
    """Drives a page, and counts what is done and how long the page is waited for."""

    def __init__(self, page: Page, address: str, truth: list[np.ndarray], slack: int) -> None:
        self.page, self.address, self.truth, self.slack = page, address, truth, slack
        self.named: dict[str, int] = {}
        self.edits, self.waited = 0, 0.0

    def look(self, path: str) -> dict[str, Any]:
        """What the page shows, as the server says it to the page."""
        found: dict[str, Any] = self.page.request.get(f"{self.address}level/0/{path}", timeout=PATIENCE).json()
        return found

    def index(self) -> int:
        """The demonstration that is open."""
        return int(self.page.evaluate("location.hash").strip("#").split("/")[0])

    def do(self, act: Any) -> None:
        """Do something that is an edit, and wait until the page shows what comes of it."""
        before = time.monotonic()
        with (
            self.page.expect_response(lambda answer: "/view/" in answer.url, timeout=PATIENCE),
            self.page.expect_response(lambda answer: answer.url.endswith("/edit"), timeout=PATIENCE) as edit,
        ):
            act()
        self.waited += time.monotonic() - before
        self.edits += bool(edit.value.json().get("done"))  # what the page refused, the person does again

    def go(self, step: int, steps: int) -> None:
        """Set the cursor by a click, and correct it by keys."""
        slider = self.page.locator("#timeline")
        box = slider.bounding_box()
        assert box is not None
        self.page.mouse.click(box["x"] + GUTTER + (step + 0.5) * (box["width"] - GUTTER) / steps, box["y"] + 30)
        while (at := int(slider.get_attribute("aria-valuenow") or 0)) != step:
            self.page.keyboard.press("ArrowRight" if at < step else "ArrowLeft")

    def names(self, index: int, shown: list[dict[str, Any]]) -> None:
        """Give the labels of a demonstration that have no option yet those that share most steps with them."""
        options = np.concatenate([np.full(own["stop"] - own["start"], own["option"]) for own in shown])
        for label, _, _ in stretches(self.truth[index]):
            if label in self.named or label == OPEN:
                continue
            mine = np.array([f"label {value}" == label for value in self.truth[index]])
            count = self.page.locator("#options input:not([type=color])").count() - 1
            free = [option for option in range(1, count + 1) if option not in self.named.values()]
            option = max(free, key=lambda option: int((mine & (options == option)).sum()))
            field = self.page.get_by_label(f"Name of option {option}", exact=True)
            field.fill(label)
            self.do(lambda: self.page.keyboard.press("Enter"))
            self.named[label] = option
        self.page.locator("#timeline").focus()

    def label(self, way: str) -> int:
        """Make the demonstration that is open right, and accept it."""
        index = self.index()
        steps, wanted = len(self.truth[index]), stretches(self.truth[index])
        self.names(index, self.look(f"view/{index}")["demo"]["segments"])
        if way == "scratch":
            self.page.keyboard.press("t")
            for name, start, _ in wanted:
                self.go(start, steps)
                key = "0" if name == OPEN else str(self.named[name])
                self.do(lambda key=key: self.page.keyboard.press(key))
            self.page.keyboard.press("t")
        for _ in range(200):
            names = {option: name for name, option in self.named.items()}
            shown = [
                (
                    OPEN if own["source"] == "open" else names.get(own["option"], str(own["option"])),
                    own["start"],
                    own["stop"],
                )
                for own in self.look(f"view/{index}")["demo"]["segments"]
            ]
            commands = plan(shown, wanted, self.slack)
            if not commands:
                break
            kind, step, *more = commands[0]
            if kind == "move":
                box = self.page.locator("#timeline").bounding_box()
                assert box is not None
                each = (box["width"] - GUTTER) / steps
                self.page.mouse.move(box["x"] + GUTTER + step * each, box["y"] + 30)
                self.page.mouse.down()
                self.page.mouse.move(box["x"] + GUTTER + more[0] * each, box["y"] + 30, steps=3)
                self.do(self.page.mouse.up)
            else:
                self.go(step, steps)
                key = "s" if kind == "split" else str({**self.named, OPEN: 0}[more[0]])
                self.do(lambda key=key: self.page.keyboard.press(key))
        self.do(lambda: self.page.keyboard.press("Enter"))
        return index

    def middle(self) -> tuple[float, float]:
        """The middle of the labelled level on the time line."""
        box = self.page.locator("#timeline").bounding_box()
        assert box is not None
        return box["x"] + box["width"] / 2, box["y"] + 30

    def settled(self) -> None:
        """Wait for the refit, and for all demonstrations to follow it."""
        while (state := self.look("poll"))["behind"] or state["refit"]["running"]:
            time.sleep(0.2)

    def right(self) -> float:
        """The share of right steps of all demonstrations."""
        names, right = {option: name for name, option in self.named.items()}, 0
        for demo, labels in zip(self.look("state")["demos"], self.truth, strict=True):
            starts, options, _ = zip(*demo["strip"], strict=True)
            steps = np.searchsorted(starts, np.arange(len(labels)), side="right") - 1
            right += sum(
                names.get(options[step]) == f"label {label}" for step, label in zip(steps, labels, strict=True)
            )
        return right / sum(int((labels >= 0).sum()) for labels in self.truth)


def main() -> None:
    """Label demonstrations, and print what each took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("demos", type=Path)
    parser.add_argument("labels")
    parser.add_argument("truth", type=Path)
    parser.add_argument("--way", choices=("proposals", "scratch"), required=True)
    parser.add_argument("--demonstrations", type=int, default=3)
    parser.add_argument("--target", type=float, default=1.0)
    parser.add_argument("--slack", type=int, default=1)
    own = parser.parse_args()
    truth = [demo.labels[own.labels] for demo in Demonstrations.read(own.truth, labels=[own.labels])]
    (own.run / "names.yaml").unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as started:
        place = ["--out", str(Path(folder) / "labels.hdf5"), "--no-browser", "--allow-code"]
        command = [sys.executable, "-m", "ddco_pyro.cli", "label", str(own.run), str(own.demos), *place]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        page = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"]).new_page(
            viewport={"width": 1600, "height": 900}
        )
        page.goto(address)
        while not page.evaluate("location.hash"):
            page.wait_for_timeout(100)
        page.locator("#timeline").focus()
        person, seen = Person(page, address, truth, own.slack), set[str]()
        for number in range(1, own.demonstrations + 1):
            before, waited = person.edits, person.waited
            segments = stretches(truth[person.label(own.way)])
            names = [name for name, _, _ in segments if name != OPEN]
            by_hand = len(segments) - 1 + len(names) + len({*names} - seen)
            seen |= {*names}
            person.settled()
            row = {"demonstration": number, "edits": person.edits - before, "by hand": by_hand}
            told = {"waited": round(person.waited - waited, 1), "right": round(person.right(), 3)}
            print(json.dumps(row | told), flush=True)
            if told["right"] >= own.target:
                break
            page.wait_for_timeout(2000)
        process.terminate()
        process.wait()


if __name__ == "__main__":
    main()

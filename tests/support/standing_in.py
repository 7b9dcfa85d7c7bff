"""A session of made-up demonstrations without a model: what a person says is kept, and the rest stays as proposed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.drawing.colours import OPTIONS
from ddco_pyro.drawing.timeline import text
from ddco_pyro.errors import BadInput
from ddco_pyro.labelling.server import Listening, serve

FREE, OPEN = -1, -2


def segments(values: np.ndarray, cuts: set[int], said: np.ndarray) -> list[dict[str, Any]]:
    """The segments of an array of options, and whether every step of each is said."""
    begins = sorted({0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), *cuts})
    found = []
    for start, stop in zip(begins, [*begins[1:], len(values)], strict=True):
        kind = "open" if (said[start:stop] == OPEN).all() else "said" if (said[start:stop] > 0).all() else "proposed"
        found.append({"start": start, "stop": stop, "option": int(values[start]), "said": kind})
    return found


class StandIn:
    """Demonstrations along circles, with ``levels`` levels; the lowest is labelled."""

    def __init__(self, demos: int = 6, steps: int = 120, levels: int = 2, ask: bool = True) -> None:
        generator = np.random.default_rng(0)
        self.steps, self.levels, self.revision, self.dirty = steps, levels, 1, False
        self.asks, self.answered = True if ask else None, ""
        self.names = ["reach", "grasp", "lift", "place"]
        self.refits, self.running = 0, 0
        each = max(steps // 8, 1)
        self.proposed = [np.repeat(generator.permutation(np.arange(8) % 4 + 1), each + 1)[:steps] for _ in range(demos)]
        self.said = [np.full(steps, FREE) for _ in range(demos)]
        self.cuts: list[set[int]] = [set() for _ in range(demos)]
        self.accepted, self.changed = [False] * demos, set[int]()
        self.done: list[tuple[Any, ...]] = []
        self.undone: list[tuple[Any, ...]] = []
        angle = np.linspace(0, 2 * np.pi, steps)
        self.numbers = [
            np.stack([np.cos(angle) * r, np.sin(angle * 2), angle / 7, generator.random(steps)])
            for r in generator.uniform(0.5, 1, demos)
        ]

    def shown(self, demo: int) -> np.ndarray:
        """The options that are shown [T]."""
        return np.where(self.said[demo] > 0, self.said[demo], self.proposed[demo])

    def segments(self, demo: int) -> list[dict[str, Any]]:
        """The segments that are shown."""
        values = np.where(self.said[demo] == OPEN, OPEN, self.shown(demo))
        return [one | {"option": max(one["option"], 0)} for one in segments(values, self.cuts[demo], self.said[demo])]

    def wrong(self, demo: int) -> float:
        """The share of steps that are expected to be wrong."""
        return 0.2 * float((self.said[demo] == FREE).mean()) * (1 + demo % 3)

    def summary(self) -> dict[str, Any]:
        """What the labels did."""
        wrong = float(np.mean([self.wrong(demo) for demo in range(len(self.said))]))
        return {"expected_wrong": wrong, "labelled": sum(self.accepted), "one_more": wrong / 7}

    def state(self) -> dict[str, Any]:
        """Everything but the demonstrations; each call takes a refit a step further."""
        if self.running:
            self.running -= 1
            self.refits += not self.running
            self.revision += not self.running
        count = len(self.said)
        order = sorted(range(count), key=lambda demo: -self.wrong(demo))
        names = ["skill", "task", "plan"][: self.levels]
        question = None
        if self.asks is not None:
            shown = list(range(min(3, count)))
            proposals = []
            for name, width in {"medium": 2, "coarse": 4, "fine": 1}.items():
                cut = [(self.proposed[demo] - 1) // width + 1 for demo in shown]
                runs = [segments(one, set(), self.said[demo]) for demo, one in zip(shown, cut, strict=True)]
                median = float(np.median([one["stop"] - one["start"] for run in runs for one in run]))
                look = {"names": [f"skill {n}" for n in range(1, 5)], "colours": list(OPTIONS[:4])}
                proposals.append({"id": name, "name": name, "median": median, "demos": runs, **look})
            question = {"demos": shown, "proposals": proposals, "asked": self.asks, "chosen": self.answered}
        return {
            "title": "made-up.hdf5", "revision": self.revision, "level": names[0], "levels": names,
            "names": list(self.names), "colours": [OPTIONS[n % len(OPTIONS)] for n in range(len(self.names))],
            "frequency": 20.0, "order": order, "summary": self.summary(),
            "demos": [
                {
                    "name": f"demo_{demo}", "steps": self.steps, "accepted": self.accepted[demo],
                    "labelled": int((self.said[demo] > 0).sum()), "expected_wrong": self.wrong(demo),
                    "changed": demo in self.changed, "held_out": demo == count - 1,
                    "reason": f"{self.wrong(demo):.0%} expected wrong",
                    "strip": [[one["start"], one["option"], one["said"]] for one in self.segments(demo)],
                }
                for demo in range(count)
            ],
            "uncertain": [
                {"demo": demo, "step": one["start"]}
                for demo in order for one in self.segments(demo)[1:2] if not self.accepted[demo]
            ],
            "can_undo": bool(self.done), "can_redo": bool(self.undone),
            "refit": {
                "running": bool(self.running), "progress": 1 - self.running / 3 if self.running else None,
                "message": "fitting the labels" if self.running else "", "done": self.refits, "error": "",
            },
            "question": question, "warnings": [], "out": "labelled.hdf5",
            "dirty": self.dirty, "formats": ["csv", "elan"],
        }  # fmt: skip

    def demo(self, index: int) -> dict[str, Any]:
        """One demonstration, as it is shown."""
        if index >= len(self.said):
            raise BadInput(f"demonstration {index}: there are {len(self.said)}")
        self.changed.discard(index)
        shown, said, numbers = self.segments(index), self.said[index], self.numbers[index]
        low, span = numbers.min(1), np.ptp(numbers, 1)
        steps = np.arange(self.steps)
        sure = np.where(said > 0, 1.0, 0.75 + 0.25 * np.cos(steps / 9 + index))
        boundaries = [
            {
                "step": one["start"], "low": max(one["start"] - (0 if pinned else 3), 0),
                "high": one["start"] + (0 if pinned else 4), "probability": 0.8, "said": pinned,
                "density": text(np.array([255] if pinned else [20, 90, 160, 255, 120, 60, 80, 30])),
            }
            for one in shown[1:] for pinned in [bool((said[one["start"] - 1 : one["start"] + 1] > 0).all())]
        ]  # fmt: skip
        upper = [
            {
                "level": level, "names": ["move", "handle"], "colours": list(OPTIONS[4:6]),
                "segments": segments(steps * (2 + depth) // self.steps % 2 + 1, set(), np.full(self.steps, FREE)),
            }
            for depth, level in enumerate(["task", "plan"][: self.levels - 1])
        ]  # fmt: skip
        return {
            "index": index, "name": f"demo_{index}", "steps": self.steps, "revision": self.revision,
            "segments": shown, "boundaries": boundaries, "probability": text(np.rint(255 * sure)), "upper": upper,
            "numbers": {
                "names": ["control[0]", "control[1]", "gripper", "force"], "every": 1,
                "bytes": text(np.rint(255 * (numbers - low[:, None]) / span[:, None])),
                "low": low.tolist(), "span": span.tolist(),
            },
            "paths": [[0, 1, 2]], "view": [[0.9, 0.3, 0.3], [-0.2, 0.9, -0.4]], "pictures": False,
        }  # fmt: skip

    def nearest(self, index: int, step: int) -> list[dict[str, Any]]:
        """The first segment of the same option in each of three other demonstrations."""
        option = int(self.shown(index)[step])
        others = [demo for demo in range(len(self.said)) if demo != index][:3]
        found = [next((one for one in self.segments(demo) if one["option"] == option), None) for demo in others]
        pairs = zip(others, found, strict=True)
        return [{"index": demo, **one} for demo, one in pairs if one]

    def picture(self, index: int, step: int) -> bytes:
        """No demonstration has pictures."""
        raise BadInput(f"demonstration {index} has no pictures")

    def edit(self, command: dict[str, Any]) -> dict[str, Any]:
        """Do what a person said."""
        do, demo = command.get("do"), command.get("demo", 0)
        before = self.kept(demo)
        if do in ("undo", "redo"):
            give, take = (self.done, self.undone) if do == "undo" else (self.undone, self.done)
            if not give:
                raise BadInput(f"there is nothing to {do}")
            last = give.pop()
            demo = last[0]
            take.append(self.kept(demo))
            _, self.said[demo], self.cuts[demo], self.accepted[demo], self.names = last
        elif do in self.DO:
            getattr(self, f"_{do}")(demo, command)
            self.done.append(before)
            self.undone.clear()
        else:
            raise BadInput(f"do={do!r}: no such edit")
        self.revision += 1
        self.dirty = True
        changed = [other for other in range(len(self.said)) if other != demo][:2]
        self.changed = set(changed)
        can = {"can_undo": bool(self.done), "can_redo": bool(self.undone)}
        return {"revision": self.revision, "demo": demo, "changed": changed, "summary": self.summary(), **can}

    DO = ("name", "everywhere", "paint", "open", "split", "merge", "move", "accept", "new", "rename")

    def kept(self, demo: int) -> tuple[Any, ...]:
        """What an undo needs."""
        return demo, self.said[demo].copy(), set(self.cuts[demo]), self.accepted[demo], list(self.names)

    def _at(self, demo: int, step: int) -> tuple[int, int]:
        return next((one["start"], one["stop"]) for one in self.segments(demo) if one["start"] <= step < one["stop"])

    def _paint(self, demo: int, command: dict[str, Any]) -> None:
        self.said[demo][command["start"] : command["stop"]] = command["option"] or OPEN

    def _name(self, demo: int, command: dict[str, Any]) -> None:
        if not 1 <= command["option"] <= len(self.names):
            raise BadInput(f"option {command['option']}: there are {len(self.names)}")
        start, stop = self._at(demo, command["step"])
        self.said[demo][start:stop] = command["option"]

    def _everywhere(self, demo: int, command: dict[str, Any]) -> None:
        self._name(demo, command)

    def _open(self, demo: int, command: dict[str, Any]) -> None:
        start, stop = self._at(demo, command["step"])
        self.said[demo][start:stop] = OPEN

    def _split(self, demo: int, command: dict[str, Any]) -> None:
        if command["step"] in {one["start"] for one in self.segments(demo)}:
            raise BadInput(f"a segment begins at step {command['step']} already")
        self.cuts[demo].add(command["step"])

    def _merge(self, demo: int, command: dict[str, Any]) -> None:
        start, stop = self._at(demo, command["step"])
        if stop == self.steps:
            raise BadInput("this is the last segment; there is none to merge it with")
        end = self._at(demo, stop)[1]
        self.said[demo][start:end] = self.shown(demo)[start]
        self.cuts[demo] -= set(range(start + 1, end))

    def _move(self, demo: int, command: dict[str, Any]) -> None:
        at, to, shown = command["boundary"], command["to"], self.shown(demo)
        low, high = min(at, to), max(at, to)
        self.said[demo][low:high] = shown[at - 1] if to > at else shown[at]

    def _accept(self, demo: int, command: dict[str, Any]) -> None:
        self.said[demo] = np.where(self.said[demo] == OPEN, OPEN, self.shown(demo))
        self.accepted[demo] = True

    def _new(self, demo: int, command: dict[str, Any]) -> None:
        self.names.append(command["text"])

    def _rename(self, demo: int, command: dict[str, Any]) -> None:
        self.names[command["option"] - 1] = command["text"]

    def refit(self) -> None:
        """Pretend to."""
        self.running = 3

    def cancel(self) -> None:
        """End what it pretends to do."""
        self.running = 0

    def ask(self) -> None:
        """The ways to cut are known at once."""
        if self.asks is None:
            self.asks, self.revision = False, self.revision + 1

    def choose(self, proposal: Any) -> None:
        """Answer the question."""
        if proposal not in ("coarse", "medium", "fine"):
            raise BadInput(f"proposal {proposal!r}: there is none")
        self.asks, self.answered, self.revision = False, proposal, self.revision + 1

    def save(self) -> str:
        """Write nothing."""
        self.dirty = False
        return f"labels/skill of {len(self.said)} demonstrations are in labelled.hdf5"

    def export(self, format: str, folder: Path) -> Path:
        """A file with the number of demonstrations, or a folder with one."""
        if format not in ("csv", "elan"):
            raise BadInput(f"{format}: no such format")
        path = folder / f"segments.{format}"
        if format == "elan":
            path = folder / "segments" / "demo_0.eaf"
            path.parent.mkdir()
        path.write_text(f"{len(self.said)} demonstrations\n")
        return path if format == "csv" else path.parent

    def close(self) -> None:
        """Nothing runs in the background."""


if __name__ == "__main__":
    import sys

    listening = Listening.at(int(sys.argv[1]))
    size = [int(one) for one in sys.argv[2:5]] or [6, 120, 2]
    print(serve(StandIn(*size), listening, lambda: print(listening.address, flush=True)))

"""The film strip of ``docs/results/hidden.md``: fits that ``studies/hidden.yaml`` has made, in the test's own episodes.

    python studies/hidden_film.py

Options push to either side; the mixture has the first of the options' episodes that it ends on the wrong side.
"""

from __future__ import annotations

import numpy as np
from study import RESULTS, ROOT

from ddco_pyro.drawing.figures import blank, hide_frame, save, style
from ddco_pyro.fitting.fitted import Fit, load
from ddco_pyro.simulation.episodes import Episode, run_episode
from ddco_pyro.simulation.task import find_task
from ddco_pyro.study.cells import Folder, work_of
from ddco_pyro.study.declaration import Study

TASK, SEED = "pushing_cue", 0
AFTER = (1, 12, 20, 28)
"""Steps after the box has come."""


def episodes(fits: dict[str, Fit], starts: range) -> dict[str, Episode]:
    """The episodes to show, by what stands beside them."""
    task, found = find_task(TASK), dict[str, Episode]()

    def played(method: str, start: int, film: bool) -> Episode:
        return run_episode(task, fits[method].controller(), start, film, keep=("goal", "box_pose"))

    for start in starts:
        ours, theirs = (played(method, start, film=False) for method in ("options", "mixture"))
        side = "left" if ours.record.observations["goal"][0, 0] < 0 else "right"
        wrong = bool(theirs.outcome["wrong_side"])
        if ours.outcome["success"] and f"options, goal {side}" not in found and (wrong or found):
            found[f"options, goal {side}"] = played("options", start, film=True)
            if wrong and len(found) == 1:
                found[f"mixture, goal {side}"] = played("mixture", start, film=True)
        if len(found) == 3:
            break
    return found


def main() -> None:
    """Draw the strip."""
    study = Study.load(ROOT / "studies" / "hidden.yaml", allow_code=True)
    folder = Folder(study, ROOT / "runs" / "studies" / "hidden")
    cells = {cell.method: cell for cell in folder.state().done if cell.part == "test" and cell.seed == SEED}
    fits = {name: load(work_of(folder.place(cells[name])) / "fit") for name in ("options", "mixture")}
    assert study.declared.starts is not None  # it has starts
    shown = episodes(fits, study.declared.starts.test.of(cells["options"].place))
    with style():
        figure = blank(1.05 * len(shown) + 0.3)
        rows = figure.subplots(len(shown), 4 + len(AFTER))
        for row, (name, episode) in zip(rows, shown.items(), strict=True):
            came = int(np.argmax(np.abs(episode.record.observations["box_pose"][:, 0]) < 0.5))
            places = [2, 6, came - 1, *(came + after for after in AFTER), len(episode.frames) - 1]
            for axes, place in zip(row, places, strict=True):
                axes.imshow(episode.frames[place][20:, 20:300])
                hide_frame(axes)
                axes.set_xlabel(f"step {place}", labelpad=2)
            row[0].set_ylabel(name.replace(", ", "\n"))
        save(figure, RESULTS / "hidden_film.png", "Options push to the side that was shown; a mixture takes the other")


if __name__ == "__main__":
    main()

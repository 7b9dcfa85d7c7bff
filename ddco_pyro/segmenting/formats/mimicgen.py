"""Ends of subtasks for MimicGen and Isaac Lab Mimic, in a copy of a file that their own scripts prepared."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ddco_pyro.data.files import whole_file
from ddco_pyro.data.hdf5 import opened, written
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting.formats import Asked, Run
from ddco_pyro.segmenting.formats.labels import leave_out
from ddco_pyro.segmenting.segments import Segmented, chosen_names


class Tool(NamedTuple):
    """What a tool needs.

    :param place: the group of a demonstration that holds its data.
    :param prepared: what the tool's own ``script`` writes there.
    """

    place: str
    prepared: Sequence[str]
    script: str


TOOLS = {
    "--mimicgen": Tool(
        "datagen_info",
        ("eef_pose", "object_poses", "target_pose", "gripper_action"),
        "python mimicgen/scripts/prepare_src_dataset.py --dataset {}",
    ),
    "--isaac": Tool(
        "obs/datagen_info",
        ("eef_pose", "object_pose", "target_eef_pose"),
        "scripts/imitation_learning/isaaclab_mimic/annotate_demos.py --auto --input_file {} "
        "--output_file PREPARED",
    ),
}


def check(asked: Asked) -> None:
    """Check that the tool's script has prepared every demonstration.

    :raises BadInput: it has not.
    """
    tool = TOOLS[asked.option]
    with opened(asked.source.path) as file:
        for name in chosen_names(asked.source, asked.fit):
            there = file[f"data/{name}"].get(tool.place, {})
            if missing := [key for key in tool.prepared if key not in there]:
                path, lacks = asked.source.path, f"has no {tool.place}/{missing[0]}"
                script = f"the file is not prepared for {asked.option}; first: {tool.script.format(path)}"
                raise BadInput(f"{path}: {name}: {lacks}, so {script}")


def write(asked: Asked, segmented: Segmented) -> str:
    """``subtask_term_signals/<subtask>`` [T] beside the tool's data of each demonstration.

    A signal is 0, and 1 from the last step of its subtask on. The last subtask of a demonstration has none.
    The copy has only demonstrations whose subtasks follow one order.
    """
    names, runs = _one_order(asked, segmented)
    with whole_file(asked.out) as temporary:
        shutil.copyfile(asked.source.path, temporary)
        with written(temporary, "r+") as file:
            left_out = [name for name in file["data"] if name not in runs]
            for name in left_out:
                del file[f"data/{name}"]
            leave_out(file, left_out)
            if left_out and "total" in file["data"].attrs:
                file["data"].attrs["total"] = sum(len(demo["actions"]) for demo in file["data"].values())
            for name, each in runs.items():
                group = file[f"data/{name}"].require_group(TOOLS[asked.option].place)
                steps = np.arange(len(file[f"data/{name}/actions"]))
                for subtask, (_, _, stop) in zip(names[:-1], each, strict=False):
                    signal = f"subtask_term_signals/{subtask.replace('/', '_')}"
                    if signal in group:
                        del group[signal]
                    group[signal] = (steps >= stop - 1).astype(np.int64)
    missing = f"; left out: {', '.join(left_out)}" if left_out else ""
    return f"{asked.out}: {len(runs)} demonstrations with subtasks {', '.join(names)}{missing}"


def _one_order(asked: Asked, segmented: Segmented) -> tuple[list[str], dict[str, list[Run]]]:
    """The subtasks that demonstrations go through, and the runs of each demonstration that does so.

    A subtask that occurs twice has a number the second time, such as ``grasp_2``. The first one lasts at
    least two steps: MimicGen looks for the step where its signal rises.
    """
    runs = {demo.name: asked.runs(demo) for demo in segmented.segments}
    subtasks = {name: [asked.names[option] for option, _, _ in each] for name, each in runs.items()}
    ((common, count),) = Counter(map(tuple, subtasks.values())).most_common(1)
    problems = {}
    for name, each in runs.items():
        if tuple(subtasks[name]) != common:
            most = f"those of {count} of {len(runs)} demonstrations are {', '.join(common)}"
            problems[name] = f"its subtasks are {', '.join(subtasks[name])}, and {most}"
        elif each[0][2] == 1:
            problems[name] = f"its first subtask, {common[0]}, lasts one step, whose end cannot be marked"
    if len(common) == 1:
        single = f"most demonstrations have one subtask, {common[0]}"
        raise BadInput(f"{asked.option}: {single}: there is no end to mark")
    if problems and not (asked.same_order and len(problems) < len(runs)):
        name, problem = next(iter(problems.items()))
        remedy = f"--same-order leaves such demonstrations out ({len(problems)} of {len(runs)})"
        raise BadInput(f"{asked.option}: {name}: {problem}; {remedy}")
    names = [
        f"{name}_{common[:place].count(name) + 1}" if name in common[:place] else name
        for place, name in enumerate(common)
    ]
    return names, {name: each for name, each in runs.items() if name not in problems}

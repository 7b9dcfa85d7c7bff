"""Convert the JSON results of 6b4a34a to one tidy table for each study.

    python studies/convert.py
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path("docs/results")
COLUMNS = ("study", "task", "method", "demonstrations", "seed", "measure", "value")
Row = tuple[Any, ...]


def results(name: str) -> Any:
    return json.loads((ROOT / f"{name}.json").read_text())["results"]


def needle() -> Iterator[Row]:
    for path in sorted((ROOT / "needle").glob("*seed-*.json")):
        own = json.loads(path.read_text())["results"]
        head = "needle", "needle"
        for method, one in own["methods"].items():
            at = (*head, method, own["count"], own["seed"])
            for measure, value in one["measures"].items():
                if value["trials"]:
                    yield *at, measure, value["mean"] if "mean" in value else value["rate"]
                    if measure != "accuracy_mm":
                        yield *at, f"{measure}, trials", value["trials"]
        for method, one in own["log_likelihood_per_step"].items():
            for part, name in (("valid", "nats"), ("train", "nats, training")):
                yield *head, method, own["count"], own["seed"], name, one[part]
    for method, seeds in results("needle/rounding").items():
        for seed, own in seeds.items():
            for number, (rate, nats) in enumerate(zip(own["rates"], own["log_likelihood_valid"], strict=True)):
                at = "rounding", f"draw {number} of 1e-7", method, 100, seed
                yield *at, "success", rate
                yield *at, "nats", nats


def pushing() -> Iterator[Row]:
    measures = {"goals": "goals", "limited_goals": "goals, 250 steps each", "topples": "topples"}
    measures |= {"log_likelihood_held_out": "nats", "dwell": "steps an option lasts"}
    measures |= {"own_control": "steps under own control"}
    for study in ("perceptrons/sample_complexity", "sample_complexity", "number_of_options", "augmentation", "variants"):
        with (ROOT / "pushing" / f"{study}.csv").open(newline="") as file:
            for row in csv.DictReader(file):
                method = row["method"] + (f", k = {row['options']}" if row["options"] else "")
                name = study.partition("/")[0]
                for column, measure in measures.items():
                    if row[column] and (column != "own_control" or name == "augmentation"):
                        at = (name, row["variant"], method, row["demonstrations"], row["seed"])
                        yield *at, measure, float(row[column])
    for supervisor, own in results("pushing/supervisors")["supervisors"].items():
        for measure, value in own.items():
            if measure != "steps_per_second":
                yield "supervisors", "pushing", supervisor, "", "", measure, value["mean"]
    for options, fits in results("pushing/joint_angles")["segments_nmi"].items():
        for seed, own in enumerate(fits):
            for label, value in own.items():
                yield "joint_angles", "pushing", f"DDCO MLP, k = {options}", 40, seed, f"NMI with {label}", value


def pushing_pictures() -> Iterator[Row]:
    measures = {"goals": "goals", "limited": "goals, 250 steps each", "topples": "topples", "held_out": "nats"}
    measures |= {"train": "nats, training", "dwell": "steps an option lasts", "own_control": "steps under own control"}
    for name in ("demonstrations", "options", "augmentation", "large", "encoded", "forty/encoded"):
        encoded = {"at_one_std": "nats at σ = 0.35"} if name.endswith("encoded") else {}
        for cell in results(f"pushing_pictures/{name}")["cells"]:
            method = cell["method"] + (f", k = {cell['options']}" if cell["options"] else "")
            for key, measure in (measures | encoded).items():
                if isinstance(cell.get(key), (int, float)):
                    study = "encoded_forty" if name == "forty/encoded" else "pushing_pictures"
                    at = study, f"σ = {cell['std']:g}" if cell.get("std") else "pushing"
                    yield *at, method, cell["count"], cell["seed"], measure, cell[key]
    yield "looks", "pushing", "ff, k = 2", 80, 0, "NMI with phases", results("pushing_pictures/looks")["phases"]["nmi"]


def bin_picking() -> Iterator[Row]:
    known = {("bin_picking", "60"): results("bin_picking/summary"), ("hybrid", "60"): results("bin_picking/hybrid/summary")}
    for name in ("fewer", "others", "six"):
        for variant, methods in results(f"bin_picking/{name}").items():
            kind, _, number = variant.rpartition("-")
            known[(name if kind == "demonstrations" else variant, number if kind == "demonstrations" else "60")] = methods
    for (study, count), methods in known.items():
        for method, own in methods.items():
            at = study, "bins", method, count
            for criterion, found in own["criteria"].items():
                yield *at, "", f"{criterion}, successes", found["successes"]
                yield *at, "", f"{criterion}, trials", found["trials"]
            for failure, number in own["failures"].items():
                yield *at, "", f"attempts: {failure}", number
            for end, number in own["ends"].items():
                yield *at, "", f"ended: {end}", number
            for seed, number in enumerate(own["cleared by seed"]):
                trials = own["criteria"]["bins cleared"]["trials"] / len(own["cleared by seed"])
                yield *at, seed, "success", number / trials
            for seed, value in enumerate(own["held_out"]):
                yield *at, seed, "nats", value
    for method, own in results("bin_picking/recovery").items():
        for name, found in own.items():
            yield "recovery", "bins", method, 60, "", f"{name}, successes", found["successes"]
            yield "recovery", "bins", method, 60, "", f"{name}, trials", found["trials"]
    demonstrator = results("bin_picking/supervisor")
    for part in ("grasps", "fresh piles of five", "five left in demonstrations", "bins"):
        for name, found in demonstrator[part].items():
            if "successes" in found:
                yield "demonstrator", part, "supervisor", "", "", f"{name}, successes", found["successes"]
                yield "demonstrator", part, "supervisor", "", "", f"{name}, trials", found["trials"]
    for thing, own in results("bin_picking/unseen").items():
        yield "unseen", thing, "DDCO", 60, "", "taken, successes", own["pooled"]["taken"]["successes"]
        yield "unseen", thing, "DDCO", 60, "", "taken, trials", own["pooled"]["taken"]["trials"]
        for place, found in own["pooled"]["dropped"].items():
            yield "unseen", thing, "DDCO", 60, "", f"dropped: {place}", found["successes"]
    yield from selected("bin_picking/selection", "bins", "60")


def arena() -> Iterator[Row]:
    measures = ("nmi", "ari", "boundary_f1_3")
    for task, found in results("arena/summary")["tasks"].items():
        for count, own in found["counts"].items():
            for method, one in own["methods"].items():
                for seed, value in enumerate(one["success"]["by_seed"]):
                    yield "arena", task, method, count, seed, "success", value
                for seed, value in enumerate(one["log_likelihood_valid"]["by_seed"]):
                    yield "arena", task, method, count, seed, "nats", value
            for seed, one in enumerate(own["agreement"]):
                valid = one["valid"][0]
                globally = valid["matched_globally"]
                for measure in measures:
                    yield "arena", task, "ddco", count, seed, "NMI" if measure == "nmi" else measure, valid[measure]
                for measure in ("accuracy", "f1_50", "edit"):
                    yield "arena", task, "ddco", count, seed, measure, globally[measure]
    for count, own in results("arena/summary")["segments"].items():
        for measure in ("nmi", "f1_50"):
            for method, one in own["measures"][measure]["methods"].items():
                for task, value in zip(own["tasks"], one["by_seed"], strict=True):
                    yield "segments", task, method, count, "", "NMI" if measure == "nmi" else measure, value
    for labelled, own in results("arena_labels/summary").items():
        for task, one in own["tasks"].items():
            for measure in ("nmi", "accuracy", "named", "f1_50"):
                for seed, value in enumerate(one[measure]["by_seed"]):
                    name = "NMI" if measure == "nmi" else measure
                    yield "labels", task, f"{labelled} labelled", 50, seed, name, value


def babyai() -> Iterator[Row]:
    for name, study, count in (("babyai", "babyai", 60), ("babyai_many", "babyai", 300), ("babyai_segments", "segments", 300)):
        for own in results(f"{name}/summary"):
            task = f"{own['level']}, {own['progress']}"
            for method, one in own["methods"].items():
                for part, measure in (("valid", "nats"), ("train", "nats, training")):
                    for seed, value in enumerate(one[f"log_likelihood_{part}"]["by_seed"]):
                        yield study, task, method, count, seed, measure, value
            for method, one in own["success"].items():
                for seed, value in enumerate(one["by_seed"]):
                    yield study, task, method, count, seed, "success", value
            for part, many in (("agreement", True), ("references", False)):
                for method, levels in own.get(part, {}).items():
                    for number, labels in enumerate(levels if many else [levels]):
                        for label, found in labels.items():
                            if found:
                                level = f"{method}, level {number + 1}" if many else method
                                for seed, value in enumerate(found["nmi"]["by_seed"]):
                                    yield study, task, level, count, seed, f"NMI with {label}", value


def segments() -> Iterator[Row]:
    for one in results("metaworld"):
        at = "metaworld", "pick-place-v3", f"initialize: {one['initialize']}", 50, one["seed"]
        yield *at, "nats", one["valid"]
        yield *at, "NMI", one["agreement_valid"]["nmi"]
        for measure in ("accuracy", "f1_50"):
            yield *at, measure, one["agreement_valid"]["matched_globally"][measure]
    for task, name in (("pick-place-v3", ""), ("assembly-v3", "_assembly"), ("hammer-v3", "_hammer")):
        for one in results(f"emission_kinds{name}"):
            at = "emission_kinds", task, f"{one['kind']}, {one['network']}, σ: {one['sigma']}", 50, one["seed"]
            yield *at, "nats", one["valid"]
            yield *at, "NMI", one["nmi_valid"] if "nmi_valid" in one else one["agreement_valid"]["nmi"]
    for method, values in results("starting_spec")["valid"].items():
        for seed, value in enumerate(values):
            yield "starting_spec", "pick-place-v3", method, 50, seed, "nats", value
    for one in results("planted_levels"):
        count = 320 if one["way"].endswith("320") else 80
        for model in ("found", "truth"):
            method = one["way"] if model == "found" else f"{one['way']}: truth"
            at = "planted_levels", one["way"], one["way"] if model == "found" else "truth", count, one["seed"]
            yield *at, "nats", one[model]
            for level, value in enumerate(one[f"{model} nmi"], 1):
                yield *at, f"NMI, level {level}", value
        if "fitted" in one:
            yield *at[:2], one["way"], count, one["seed"], "nats, training", one["fitted"]


def selected(name: str, task: str, count: str) -> Iterator[Row]:
    for one in results(name)["candidates"]:
        for fold in one["folds"]:
            at = "selection", task, one["name"].replace("count", "k"), count, fold["fold"]
            yield *at, "nats", fold["log_likelihood_per_step"]


def selection() -> Iterator[Row]:
    yield from selected("selection_needle", "needle", "100")
    for one in results("selection_planted")["draws"]:
        at = "selection_planted", f"{one['options']} planted", "ddco", "", one["seed"]
        yield *at, "chosen", one["chosen"]
        yield *at, "likeliest", one["best"]
    for method, counts in results("learning_curve").items():
        for count, own in counts.items():
            for fold, value in enumerate(own["folds"]):
                yield "learning_curve", "needle", method, count, fold, "nats", value
    for task, ways in results("stability").items():
        for way, own in ways.items():
            names = {"valid": "nats", "train": "nats, training", "selects_option": "P(option)", "largest": "largest share"}
            for key, measure in names.items():
                for seed, value in zip(own["seeds"], own["values"][key], strict=True):
                    yield "stability", task, way, "", seed, measure, value
            for number, value in enumerate(own["nmi"]["pairs"]):
                yield "stability", task, way, "", f"pair {number}", "NMI of two seeds", value


def memory() -> Iterator[Row]:
    for name in ("cells", "far_end"):
        with (ROOT / "memory" / f"{name}.csv").open(newline="") as file:
            for row in csv.DictReader(file):
                measure = row["measure"] + (f", acting by {row['acting']}" if row["acting"] else "")
                own = (row[key] for key in ("study", "task", "method", "demonstrations", "seed"))
                yield *own, measure, float(row["value"])


def main() -> None:
    studies = needle, pushing, pushing_pictures, bin_picking, arena, babyai, segments, selection, memory
    for study in studies:
        rows = dict.fromkeys((*row[:-1], f"{row[-1]:.9g}") for row in study())
        assert len({row[:-1] for row in map(lambda row: tuple(map(str, row)), rows)}) == len(rows), study.__name__
        with (ROOT / f"{study.__name__}.csv").open("w", newline="") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(COLUMNS)
            table.writerows(rows)
        print(study.__name__, len(rows), (ROOT / f"{study.__name__}.csv").stat().st_size)


if __name__ == "__main__":
    main()

"""Damaged specs and files of demonstrations, by seed, and how the files are tried."""

from __future__ import annotations

import contextlib
import json
import random
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import forked
import h5py
import numpy as np
import yaml
from random_demonstrations import demonstrations

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.importing import import_demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.starting import starting_spec
from ddco_pyro.errors import BadInput

SECONDS = 60
"""A spec that keeps the process busy for longer hangs."""

VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 3, 10**6, 10**12, 10**40, -0.0, 1e-320, 1e308, float("nan"), float("inf"), "", " ", "x",
    "x" * 9999, "linear", "mlp", "conv", "per_timestep", "os:system", "a:b:c", "state", "\u0000", "é\U0001f9ea", "1e3",
    [], [[]], [1, "a"], [None], {}, {"a": {}}, {"learn": True}, {"network": "mlp"}, ["options", "control"], "../../x",
)  # fmt: skip


# --- specs ------------------------------------------------------------------------------------------------------------


def damaged_spec(base: dict[str, Any], seed: int) -> bytes:
    """The text of a spec with some things wrong, or right in another way."""
    choose = random.Random(seed)
    data = json.loads(json.dumps(base))
    for _ in range(choose.randint(1, 3)):
        _damage_data(data, choose)
    text = yaml.safe_dump(data, allow_unicode=True, sort_keys=choose.random() < 0.5).encode()
    return _damage_bytes(text, choose) if choose.random() < 0.25 else text


def places(node: Any) -> Iterator[tuple[Any, Any]]:
    for key in list(node) if isinstance(node, dict) else range(len(node)):
        yield node, key
        if isinstance(node[key], dict | list):
            yield from places(node[key])


def _damage_data(data: dict[str, Any], choose: random.Random) -> None:
    known = list(places(data))
    if not known:
        return
    node, key = choose.choice(known)
    other_node, other_key = choose.choice(known)
    how = choose.randrange(6)
    if how == 0:
        del node[key]
    elif how == 1 and isinstance(node, dict):
        name = str(key)
        at = choose.randrange(len(name) + 1)
        node[name[:at] + choose.choice("xs_. ") + name[at + 1 :]] = node.pop(key)
    elif how == 2:
        node[key] = json.loads(json.dumps(other_node[other_key]))
    elif how == 3 and isinstance(node, list):
        node.insert(key, json.loads(json.dumps(node[key])))
    else:
        node[key] = choose.choice(VALUES)


def _damage_bytes(content: bytes, choose: random.Random) -> bytes:
    damaged = bytearray(content)
    for _ in range(choose.randint(1, 4)):
        if not damaged:
            break
        at = choose.randrange(len(damaged))
        end = min(at + choose.choice([1, 2, 8, 64, 512]), len(damaged))
        how = choose.randrange(5)
        if how == 0:
            damaged[at] = choose.randrange(256)
        elif how == 1:
            del damaged[at:end]
        elif how == 2:
            damaged[at:at] = bytes(choose.randrange(256) for _ in range(choose.choice([1, 4, 8])))
        elif how == 3:
            damaged[at:end] = bytes([choose.choice([0, 255])]) * (end - at)
        else:
            damaged[at] ^= 1 << choose.randrange(8)
    return bytes(damaged[: choose.randrange(len(damaged) + 1)] if choose.random() < 0.1 else damaged)


# --- files of demonstrations ------------------------------------------------------------------------------------------


def damaged_file(path: Path, seed: int) -> None:
    choose = random.Random(seed)
    demonstrations(4, {"train": ("demo_0", "demo_1"), "valid": ("demo_2",)}).write(path)
    if choose.random() < 0.3:
        with h5py.File(path, "r+") as file:
            for group in file["data"].values():
                camera = group["obs/camera"][()]
                del group["obs/camera"]
                group.create_dataset("obs/camera", data=camera, chunks=(1, *camera.shape[1:]), compression="gzip")
    if choose.random() < 0.5:
        with h5py.File(path, "r+") as file:
            for _ in range(choose.randint(1, 3)):
                with contextlib.suppress(ValueError, OSError, RuntimeError, KeyError, TypeError):
                    choose.choice(EDITS)(file, choose)
    else:
        path.write_bytes(_damage_bytes(path.read_bytes(), choose))


Edit = Callable[[h5py.File, random.Random], object]


def _anything(file: h5py.File, choose: random.Random) -> str:
    found: list[str] = []
    file.visit(found.append)
    return choose.choice(found or ["data"])


def _remove(file: h5py.File, choose: random.Random) -> str:
    place = _anything(file, choose)
    if place in file:
        del file[place]
    return place


def _replace(make: Callable[[random.Random], Any]) -> Edit:
    def edit(file: h5py.File, choose: random.Random) -> None:
        file[_remove(file, choose)] = make(choose)

    return edit


def _huge(file: h5py.File, choose: random.Random) -> None:
    place = _remove(file, choose)
    steps = choose.choice([10**9, 10**15])
    file.create_dataset(place, shape=(steps, 3), chunks=(1024, 3), dtype=choose.choice(["f8", "u1"]),
                        compression=choose.choice([None, "gzip"]))  # fmt: skip


def _loop(file: h5py.File, choose: random.Random) -> None:
    place = _anything(file, choose)
    group = file.get(place, file)
    if isinstance(group, h5py.Group):
        group[f"again{choose.randrange(9)}"] = choose.choice(
            [file["/"], h5py.SoftLink("/data"), h5py.SoftLink("nowhere"), h5py.ExternalLink("none.hdf5", "/")]
        )


def _attribute(file: h5py.File, choose: random.Random) -> None:
    place = _anything(file, choose)
    values = [np.nan, -1, 10**18, "x" * 9999, np.zeros((50, 50)), h5py.Empty("f8"), b"\xff\xfe", "{", 7]
    if place in file:
        names = ["num_samples", "env_args", "control_frequency", "total", "segmented_by", "imported"]
        file[place].attrs[choose.choice(names)] = choose.choice(values)


def _rename(file: h5py.File, choose: random.Random) -> None:
    place = _anything(file, choose)
    if place in file:
        file.move(place, place + choose.choice(["x", "\n", " ", "é", "/y", "[red]", "<b>"]))


DTYPES = ("i1", "f2", "c16", "?", "u8")

EDITS: tuple[Edit, ...] = (
    _remove, _remove, _huge, _loop, _attribute, _attribute, _rename,
    _replace(lambda choose: np.full((choose.randint(0, 5), 2), choose.choice([np.nan, np.inf, 1e308, 0.0]))),
    _replace(lambda choose: np.zeros((choose.randint(0, 5),) * choose.randint(0, 4), choose.choice(DTYPES))),
    _replace(lambda choose: np.zeros(4, dtype=[("a", "f8"), ("b", "S3")])),
    _replace(lambda choose: [b"demo_0", b"demo_9", b"\xff"]),
    _replace(lambda choose: h5py.Empty("f8")),
    _replace(lambda choose: np.array(["a", "bb"], dtype=object)),
    _replace(lambda choose: np.zeros((4, 0))),
)  # fmt: skip


# --- where they are tried ---------------------------------------------------------------------------------------------

GROWN = 3 * 2**29
"""Bytes of memory beyond those of the process, which together are less than 2 GB."""


def tried(path: Path) -> list[str]:
    """How each way to read a file ends: ``fine``, ``refused``, or what went wrong."""
    out = path.with_suffix(".imported")
    ways = (
        lambda: Demonstrations.read(path),
        lambda: starting_spec(inspect(path), path),
        lambda: import_demonstrations(path, out),
    )
    child = forked.run(lambda: [_end(way) for way in ways])
    out.unlink(missing_ok=True)
    return child.value if child.status == 0 and child.grown < GROWN else [f"{child}"]


def _end(way: Callable[[], object]) -> str:
    try:
        way()
        return "fine"
    except BadInput as error:
        return "refused" if "\n" not in str(error) else f"more than one line: {error!r}"
    except BaseException:
        return traceback.format_exc()

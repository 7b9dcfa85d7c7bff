"""Damaged specs and files of demonstrations, by seed, and how the files are tried."""

from __future__ import annotations

import contextlib
import copy
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
    choose, data = random.Random(seed), copy.deepcopy(base)
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
    """Remove, misspell, double, or replace something, by a value from elsewhere or an odd one."""
    if not data:
        return
    known = list(places(data))
    (node, key), (other_node, other_key) = choose.choice(known), choose.choice(known)
    other, how = copy.deepcopy(other_node[other_key]), choose.randrange(6)
    if how == 0:
        del node[key]
    elif how == 1 and isinstance(node, dict):
        at = choose.randrange(len(str(key)) + 1)
        node[str(key)[:at] + choose.choice("xs_. ") + str(key)[at + 1 :]] = node.pop(key)
    elif how == 2 and isinstance(node, list):
        node.insert(key, copy.deepcopy(node[key]))
    else:
        node[key] = other if how == 3 else choose.choice(VALUES)


def _damage_bytes(content: bytes, choose: random.Random) -> bytes:
    """Flip a bit, or replace a piece by zeros, by noise or by nothing; at times cut off the rest."""
    damaged = bytearray(content)
    for _ in range(choose.randint(1, 4)):
        at = choose.randrange(len(damaged) or 1)
        end = min(at + choose.choice([1, 2, 8, 64, 512]), len(damaged))
        size = end - at
        pieces = b"", bytes(size), b"\xff" * size, choose.randbytes(size), choose.randbytes(size + 8)
        damaged[at:end] = choose.choice([*pieces, bytes(byte ^ 1 << choose.randrange(8) for byte in damaged[at:end])])
    return bytes(damaged[: choose.randrange(len(damaged) + 1)] if choose.random() < 0.1 else damaged)


# --- files of demonstrations ------------------------------------------------------------------------------------------


def damaged_file(path: Path, seed: int) -> None:
    choose = random.Random(seed)
    demonstrations(4, {"train": ("demo_0", "demo_1"), "valid": ("demo_2",)}).write(path)
    with h5py.File(path, "r+") as file:
        for group in file["data"].values() if choose.random() < 0.3 else ():
            camera = group["obs/camera"][()]
            del group["obs/camera"]
            group.create_dataset("obs/camera", data=camera, chunks=(1, *camera.shape[1:]), compression="gzip")
        edits = choose.randint(1, 3) if choose.random() < 0.5 else 0
        for _ in range(edits):
            with contextlib.suppress(ValueError, OSError, RuntimeError, KeyError, TypeError):
                choose.choice(EDITS)(file, choose)
    if not edits:
        path.write_bytes(_damage_bytes(path.read_bytes(), choose))


Edit = Callable[[h5py.File, random.Random], object]


def _anything(file: h5py.File, choose: random.Random) -> str:
    found: list[str] = []
    file.visit(found.append)
    return choose.choice(found or ["data"])


def _replace(make: Callable[[random.Random], Any] | None = None) -> Edit:
    """Something is this instead; removed where nothing is made."""

    def edit(file: h5py.File, choose: random.Random) -> None:
        place = _anything(file, choose)
        del file[place]
        if make:
            file[place] = make(choose)

    return edit


def _huge(file: h5py.File, choose: random.Random) -> None:
    place, rows = _anything(file, choose), choose.choice([10**9, 10**15])
    del file[place]
    file.create_dataset(place, (rows, 3), choose.choice(["f8", "u1"]), chunks=(1024, 3),
                        compression=choose.choice([None, "gzip"]))  # fmt: skip


def _link(file: h5py.File, choose: random.Random) -> None:
    links = [file["/"], h5py.SoftLink("/data"), h5py.SoftLink("nowhere"), h5py.ExternalLink("none.hdf5", "/")]
    file[_anything(file, choose)][f"again{choose.randrange(9)}"] = choose.choice(links)


def _attribute(file: h5py.File, choose: random.Random) -> None:
    values = [np.nan, -1, 10**18, "x" * 9999, np.zeros((50, 50)), h5py.Empty("f8"), b"\xff\xfe", "{", 7]
    names = ["num_samples", "env_args", "control_frequency", "total", "segmented_by", "imported"]
    file[_anything(file, choose)].attrs[choose.choice(names)] = choose.choice(values)


def _rename(file: h5py.File, choose: random.Random) -> None:
    place = _anything(file, choose)
    file.move(place, place + choose.choice(["x", "\n", " ", "é", "/y", "[red]", "<b>"]))


DTYPES = ("i1", "f2", "c16", "?", "u8")

EDITS: tuple[Edit, ...] = (
    _replace(), _replace(), _huge, _link, _attribute, _attribute, _rename,
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

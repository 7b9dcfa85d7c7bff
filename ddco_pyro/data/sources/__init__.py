"""Sources of demonstrations: files and folders of several libraries (:mod:`ddco_pyro.data.formats`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from pkgutil import resolve_name
from shlex import quote

import h5py

from ddco_pyro.data.demonstration import NOTHING, Attribute, Demonstration
from ddco_pyro.data.errors import DemonstrationsError, Located
from ddco_pyro.data.formats import FORMATS, LAYOUTS
from ddco_pyro.data.tasks import Where, chosen
from ddco_pyro.errors import command, nearest, path_of, refuse_unknown

__all__ = ["Source", "narrowed", "open_own", "open_source", "refuse_foreign"]


@dataclass(frozen=True)
class Source:
    """A file or folder of demonstrations, open for reading.

    :param names: of the demonstrations, in order.
    :param read: a demonstration by its name, as stored; lazy arrays can be read while the source is open.
    :param masks: name of each mask (robomimic: filter key) to names of demonstrations.
    :param frequency: control steps per second, Hz; None if unknown.
    :param attributes: facts about the whole source.
    :param format: the name of its format, and ``path`` the file or folder, once it is open.
    """

    names: tuple[str, ...]
    read: Callable[..., Demonstration]
    masks: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    frequency: float | None = None
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    format: str = ""
    path: Path = Path()


@contextmanager
def open_source(
    path: str | Path,
    form: str | None = None,
    actions: Sequence[str] = (),
    where: Where = NOTHING,
    exclude: Sequence[str] = (),
) -> Iterator[Source]:
    """Open a file or folder.

    :param form: its format, of :data:`~ddco_pyro.data.formats.FORMATS`; recognised if None.
    :param actions: names of the arrays that are the control, where a LeRobot or Minari dataset has several.
    :param where: attributes and values of the demonstrations that the source has then; all if empty.
    :param exclude: names of demonstrations that the source has not.
    :raises DemonstrationsError: the source cannot be read, or has another format.
    """
    path = path_of(path, "demonstrations")
    form = form or format_of(path)
    refuse_unknown("format", form, FORMATS, DemonstrationsError, f"{path}: ")
    if actions and not FORMATS[form].parts:
        several = " or ".join(about.text for about in FORMATS.values() if about.parts)
        has = f"has the format {form}, with one control"
        raise DemonstrationsError(f"{path}: {has}; --action is for {several}")
    reader = contextmanager(resolve_name(f"{__name__}.{FORMATS[form].reader}"))
    with reader(path, actions) if FORMATS[form].parts else reader(path) as source:
        if not source.names:
            raise Located(f"{path}: holds no demonstrations; at least one is needed")
        yield narrowed(replace(source, format=form, path=path), where, exclude)


@contextmanager
def open_own(path: Path, where: Where, exclude: Sequence[str]) -> Iterator[Source]:
    """Open an HDF5 file of this project's layout, which datasets of other libraries are to be imported into.

    :raises DemonstrationsError: as :func:`open_source`; it is such a dataset; ``exclude`` names an unknown
        demonstration, or all.
    """
    if path.is_file():
        refuse_foreign(path)
    with open_source(path, "robomimic") as source:
        for name in exclude:
            if name not in source.names:
                unknown = f"there is no demonstration {name!r}{nearest(name, source.names)}"
                raise DemonstrationsError(f"demonstrations.exclude: {unknown}")
        if set(exclude) == set(source.names):
            raise DemonstrationsError("demonstrations.exclude: leaves every demonstration out; keep some")
        yield narrowed(source, where, exclude)


def narrowed(source: Source, where: Where, exclude: Sequence[str] = ()) -> Source:
    """A source of the demonstrations with some values of attributes (:func:`~ddco_pyro.data.tasks.chosen`).

    :param exclude: names of demonstrations that it has not either.
    :raises DemonstrationsError: there is none.
    """
    if not (where or exclude):
        return source
    names = [name for name in source.names if name not in exclude]
    if where:
        names = chosen({name: source.read(name).attributes for name in names}, where)
    left_out = {*source.names} - {*names}
    given = source.masks.items()
    masks = {mask: tuple(name for name in members if name not in left_out) for mask, members in given}
    return replace(source, names=tuple(names), masks=masks)


# --- recognition --------------------------------------------------------------------------------------------


def format_of(path: Path) -> str:
    """The format of a file or folder, by its layout.

    :raises DemonstrationsError: nothing is there, the layout is unknown, or it must be converted first.
    """
    if not path.exists():
        raise DemonstrationsError(f"{path}: there is no such file or folder; check the path")
    if not (path.is_file() or path.is_dir()):
        raise DemonstrationsError(f"{path}: is neither a regular file nor a folder; name an HDF5 file")
    names = _top_names(path) if path.is_file() else ()
    told = (
        form for form, about in FORMATS.items()
        if (about.fits(path, names) if about.fits else (path / about.sign).exists())
    )  # fmt: skip
    form = next(told, "")
    inside = [path] if path.is_file() else [*path.glob("*"), *path.glob("*/*")]
    suffixes = (one.suffix.partition("-")[0] for one in inside)  # of x.tfrecord-00000-of-00001
    here = {*names, *suffixes, *(one.name for one in inside if one != path)}
    layout = next((text for text, signs in LAYOUTS.items() if any(each <= here for each in signs)), "")
    if form in ("", "robomimic") and layout:
        write = "write its episodes into an HDF5 file as data/demo_0, data/demo_1, ..."
        raise DemonstrationsError(f"{path}: {layout}; {write} with the lines in docs/own.md")
    if form:
        return form
    folders = ", ".join(f"{about.text} (with {about.sign})" for about in FORMATS.values() if about.sign)
    raise DemonstrationsError(f"{path}: is a folder of no known format; name an HDF5 file, or {folders}")


def refuse_foreign(path: Path) -> None:
    """Refuse a dataset of another library, which is to be imported first.

    :raises DemonstrationsError: it is one, nothing is there, or the layout is unknown.
    """
    if (form := format_of(path)) != "robomimic":
        first = command("import", path, "--out", "demos.hdf5")
        raise DemonstrationsError(f"{path}: has the format {form}; first: {first}")


def _top_names(path: Path) -> frozenset[str]:
    """The names at the top of an HDF5 file; none of another file."""
    try:
        with h5py.File(path, "r") as file:
            names, data = frozenset(file), file.get("data")
            groups = data.values() if isinstance(data, h5py.Group) else ()
            first = next((group for group in groups if isinstance(group, h5py.Group)), ())
            bare = "states" in first and "obs" not in first
            prepared = data is not None and "env_args" in data.attrs
    except (OSError, RuntimeError, ValueError, KeyError):
        return frozenset()
    if bare:
        scripts, name = "python -m robomimic.scripts", quote(str(path))
        before = "" if prepared else f"{scripts}.conversion.convert_robosuite --dataset {name} && "
        raise DemonstrationsError(
            f"{path}: has states of robosuite's simulator and no observations; robomimic makes them: {before}"
            f"{scripts}.dataset_states_to_obs --dataset {name} --output_name low_dim.hdf5"
        )
    return names

"""Pictures of a dm-control scene, and one clear error where the machine has no OpenGL to make them with."""

from __future__ import annotations

import ctypes
import weakref

import numpy as np

from ddco_pyro.errors import Failed

from . import opengl

MAX_GEOMS = 200  # in a picture; making room for more for every picture takes as long as drawing it


class NoOpenGL(Failed):
    """No OpenGL context can be made on this machine."""


def _no_opengl(error: BaseException) -> NoOpenGL:
    return NoOpenGL(opengl.advice(opengl.missing() or str(error)))


_ERRORS = (ImportError, AttributeError, RuntimeError, OSError, ctypes.ArgumentError)
"""PyOpenGL fails with any of these."""

try:
    from dm_control import mujoco
except ModuleNotFoundError:
    raise
except _ERRORS as error:
    raise _no_opengl(error) from error


_CAMERAS: weakref.WeakKeyDictionary[mujoco.Physics, dict[tuple[str, int, int], mujoco.Camera]]
_CAMERAS = weakref.WeakKeyDictionary()
"""What a simulation has been seen with: to make a camera takes as long as to draw a small picture. They hold
the simulation by a proxy, so that it goes when nobody else has it."""


def render(physics: mujoco.Physics, camera: str, height: int, width: int) -> np.ndarray:
    """What ``camera`` sees, uint8 [height, width, 3].

    :raises NoOpenGL: names the packages to install.
    """
    try:
        kept = _CAMERAS.setdefault(physics, {})
        if (camera, height, width) not in kept:
            proxy = weakref.proxy(physics)
            kept[camera, height, width] = mujoco.Camera(proxy, height, width, camera, max_geom=MAX_GEOMS)
        picture: np.ndarray = kept[camera, height, width].render().copy()  # it draws into the same array
        return picture
    except _ERRORS as error:
        raise _no_opengl(error) from error

"""Pictures of a dm-control scene, and one clear error where the machine has no OpenGL to make them with."""

from __future__ import annotations

import numpy as np

MAX_GEOMS = 200  # in a picture; making room for more for every picture takes as long as drawing it
PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0"


class NoOpenGL(RuntimeError):
    """No OpenGL context can be made on this machine."""

    def __init__(self, cause: BaseException) -> None:
        super().__init__(
            f"this task renders images, and no OpenGL is found here ({cause}). On Debian or Ubuntu: "
            f"apt-get install {PACKAGES}; then set MUJOCO_GL=egl where there is no display"
        )


try:
    from dm_control import mujoco
except (ImportError, AttributeError, RuntimeError, OSError) as error:  # PyOpenGL fails with any of these
    raise NoOpenGL(error) from error


def render(physics: mujoco.Physics, camera: str, height: int, width: int) -> np.ndarray:
    """What ``camera`` sees, uint8 [height, width, 3].

    :raises NoOpenGL: names the packages to install.
    """
    try:
        seen = mujoco.Camera(physics, height, width, camera, max_geom=MAX_GEOMS)
        picture: np.ndarray = seen.render()
        seen.scene.free()
        return picture
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        raise NoOpenGL(error) from error

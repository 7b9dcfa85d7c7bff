"""Whether this machine can draw the camera's pictures, before an installation: ``python3 tasks/opengl.py``.

Ends with 0, or with 1 and a line that says what is missing and how to get it. Does with the system's
libraries what dm-control's renderers do first, through ``ctypes`` alone.
"""

from __future__ import annotations

import ctypes
import os
import sys

PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0"
EGL = "libEGL.so.1"
OPENGL = ("libOpenGL.so.0", "libGL.so.1", "libGLESv2.so.2")  # any of them
PLATFORM_DEVICE = 0x313F  # EGL_PLATFORM_DEVICE_EXT
MOST_DEVICES = 10


def has_display() -> bool:
    """Whether a window system could give an OpenGL context."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return not sys.platform.startswith("linux") or bool(display)


def missing() -> str | None:
    """What keeps the tasks from drawing pictures here, in a few words; None where nothing does.

    Another renderer than EGL (``MUJOCO_GL``), or a window system, is taken to work.
    """
    chosen = os.environ.get("MUJOCO_GL", "egl").lower()
    if chosen != "egl" or (has_display() and "MUJOCO_GL" not in os.environ):
        return None
    if not any(map(_loads, OPENGL)):
        return f"{OPENGL[0]} cannot be loaded"
    if not _loads(EGL):
        return f"{EGL} cannot be loaded"
    return None if _device_starts() else "EGL has no device that starts"


def advice(cause: str) -> str:
    """One line: what is missing, what for, and what to do."""
    return (
        f"no OpenGL is found here ({cause}), and the tasks' cameras and films are drawn with it. "
        f"On Debian or Ubuntu: sudo apt-get install {PACKAGES}" + "; then set MUJOCO_GL=egl" * has_display()
    )


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def _device_starts() -> bool:
    """Whether EGL can be initialised on one of its devices, for which it needs a driver."""
    egl = ctypes.CDLL(EGL)
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    addresses = [egl.eglGetProcAddress(name) for name in (b"eglQueryDevicesEXT", b"eglGetPlatformDisplayEXT")]
    if None in addresses:
        return False
    pointer, number = ctypes.c_void_p, ctypes.c_int
    query = ctypes.CFUNCTYPE(number, number, ctypes.POINTER(pointer), ctypes.POINTER(number))(addresses[0])
    display_of = ctypes.CFUNCTYPE(pointer, number, pointer, pointer)(addresses[1])
    egl.eglInitialize.argtypes = [pointer, pointer, pointer]
    devices, count = (pointer * MOST_DEVICES)(), number()
    if not query(MOST_DEVICES, devices, ctypes.byref(count)):
        return False
    displays = (display_of(PLATFORM_DEVICE, device, None) for device in devices[: count.value])
    return any(display and egl.eglInitialize(display, None, None) for display in displays)


if __name__ == "__main__":
    cause = missing()
    if cause:
        sys.exit(advice(cause))

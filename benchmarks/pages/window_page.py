"""A page in Python that shows the video in a window of its own: decode, convert, and put into the window.

It is the floor for a browser: nothing is composed, and no event loop is between the socket and the screen.

    DISPLAY=:1 python -m benchmarks.pages.window_page URL X Y WIDTH HEIGHT
"""

from __future__ import annotations

import ctypes
import sys
from ctypes import POINTER, Structure, byref, c_char_p, c_int, c_uint, c_ulong, c_void_p
from typing import Any, Final

import av
import cv2
from av.codec.context import Flags, ThreadType
from benchmarks.pages.python_page import PythonPage

from lavt.clock import pause
from lavt.errors import WorkError

Z_PIXMAP: Final = 2
IPC_CREATE_PRIVATE: Final = 0o1600
DEPTH: Final = 24
FOREVER_NS: Final = 10**15


class _Image(Structure):
    """The first fields of Xlib's `XImage`."""

    _fields_ = (("width", c_int), ("height", c_int), ("xoffset", c_int), ("format", c_int), ("data", c_void_p))


class _Segment(Structure):
    """`XShmSegmentInfo` of the MIT-SHM extension."""

    _fields_ = (("shmseg", c_ulong), ("shmid", c_int), ("shmaddr", c_void_p), ("readOnly", c_int))


class PictureWindow:
    """A window at a place of the screen whose pictures the X server copies from shared memory."""

    def __init__(self, x_px: int, y_px: int, width_px: int, height_px: int) -> None:
        self._x, self._xext = _libraries()
        self._size = width_px, height_px
        self._display = self._x.XOpenDisplay(None)
        if not self._display:
            raise WorkError("the display cannot be opened")
        root = self._x.XDefaultRootWindow(self._display)
        self._window = self._x.XCreateSimpleWindow(self._display, root, x_px, y_px, width_px, height_px, 0, 0, 0)
        self._x.XMapRaised(self._display, self._window)
        self._context = self._x.XDefaultGC(self._display, 0)
        self._segment = _Segment()
        visual = self._x.XDefaultVisual(self._display, 0)
        self._image = self._xext.XShmCreateImage(
            self._display, visual, DEPTH, Z_PIXMAP, None, byref(self._segment), width_px, height_px
        )
        libc = ctypes.CDLL(None, use_errno=True)
        libc.shmat.restype, libc.shmat.argtypes = c_void_p, (c_int, c_void_p, c_int)
        self._segment.shmid = libc.shmget(0, ctypes.c_size_t(width_px * height_px * 4), IPC_CREATE_PRIVATE)
        self._segment.shmaddr = self._image.contents.data = libc.shmat(self._segment.shmid, None, 0)
        self._xext.XShmAttach(self._display, byref(self._segment))
        self._x.XSync(self._display, 0)
        libc.shmctl(self._segment.shmid, 0, None)  # it is removed when both processes have ended

    def show(self, bgra: bytes) -> None:
        """Show a picture, 4 bytes for each pixel, and wait until the X server has copied it."""
        ctypes.memmove(self._segment.shmaddr, bgra, len(bgra))
        self._xext.XShmPutImage(self._display, self._window, self._context, self._image, 0, 0, 0, 0, *self._size, 0)
        self._x.XSync(self._display, 0)


def _libraries() -> tuple[Any, Any]:
    """Return Xlib and its extensions, with the types of the functions that return or take pointers."""
    x, xext = ctypes.CDLL("libX11.so.6"), ctypes.CDLL("libXext.so.6")
    x.XOpenDisplay.restype, x.XOpenDisplay.argtypes = c_void_p, (c_char_p,)
    x.XDefaultRootWindow.restype, x.XDefaultRootWindow.argtypes = c_ulong, (c_void_p,)
    x.XCreateSimpleWindow.restype = c_ulong
    x.XCreateSimpleWindow.argtypes = (c_void_p, c_ulong, *(c_int,) * 2, *(c_uint,) * 3, c_ulong, c_ulong)
    x.XMapRaised.argtypes = (c_void_p, c_ulong)
    x.XDefaultGC.restype, x.XDefaultGC.argtypes = c_void_p, (c_void_p, c_int)
    x.XDefaultVisual.restype, x.XDefaultVisual.argtypes = c_void_p, (c_void_p, c_int)
    x.XSync.argtypes = (c_void_p, c_int)
    xext.XShmCreateImage.restype = POINTER(_Image)
    xext.XShmCreateImage.argtypes = (c_void_p, c_void_p, c_uint, c_int, c_void_p, c_void_p, c_uint, c_uint)
    xext.XShmAttach.argtypes = (c_void_p, c_void_p)
    xext.XShmPutImage.argtypes = (c_void_p, c_ulong, c_void_p, POINTER(_Image), *(c_int,) * 4, *(c_uint,) * 2, c_int)
    return x, xext


def main() -> None:
    """Show the video of the console at the address of the first argument, at the place and size of the others."""
    url, size = sys.argv[1], (int(sys.argv[4]), int(sys.argv[5]))
    window = PictureWindow(int(sys.argv[2]), int(sys.argv[3]), *size)
    cv2.setNumThreads(1)  # as the browser's compositor without a graphics processor
    context: Any = av.CodecContext.create("h264", "r")
    context.thread_type, context.thread_count = ThreadType.SLICE, 1
    context.flags |= Flags.low_delay
    has_begun = False

    def take(data: bytes, _unit: int, is_keyframe: bool) -> None:
        nonlocal has_begun
        has_begun = has_begun or is_keyframe
        if not has_begun:
            return
        for frame in context.decode(av.Packet(data)):
            picture = frame.to_ndarray(format="bgra")
            if (frame.width, frame.height) != size:
                picture = cv2.resize(picture, size)  # bilinear; less than half of the time of swscale
            window.show(picture.tobytes())

    PythonPage(url, take)
    pause(FOREVER_NS)


if __name__ == "__main__":
    main()

"""People watching while the loop runs: a thread of its own feeds their stream and drops what it cannot take."""

import threading
from collections import deque

import rerun as rr

from twin.station.frame import Frame
from twin.station.native import ViewerKeeper
from twin.station.rerun_view import RerunView


class LiveView:
    """Hands frames to a view from another thread, so that a slow or failing view costs frames only.

    Parameters
    ----------
    view
        The view; nobody else may use it or its stream from now on.
    depth
        Frames that may wait; the oldest goes when another one comes.
    keeper
        Of the window that shows it, if there is one: the end waits until it has seen all, if it can.

    Attributes
    ----------
    dropped
        Frames that nobody saw.
    error
        What stopped the view, if anything did.
    """

    def __init__(self, view: RerunView, *, depth: int = 50, keeper: ViewerKeeper | None = None) -> None:
        self._view, self._keeper = view, keeper
        self._depth = depth
        self._waiting: deque[Frame] = deque()
        self._change = threading.Condition()
        self._closing = False
        self.dropped = 0
        self.error: Exception | None = None
        self._thread = threading.Thread(target=self._feed, name="live view", daemon=True)
        self._thread.start()

    def show(self, frame: Frame) -> None:
        """Queue a frame; returns at once."""
        with self._change:
            if self._closing or self.error is not None:
                self.dropped += 1
                return
            if len(self._waiting) >= self._depth:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(frame)
            self._change.notify()

    def close(self, timeout_s: float = 2.0) -> None:
        """Show what waits and finish, for as long as that takes but no longer than the time-out [s]."""
        with self._change:
            self._closing = True
            self._change.notify()
        self._thread.join(timeout_s)
        if self._keeper is not None:
            self._keeper.stop(timeout_s)
        if not self._thread.is_alive():
            return
        with self._change:
            self.dropped += len(self._waiting)
            self._waiting.clear()
        # At exit Rerun would wait for what its thread still holds; the thread that waits instead ends with us.
        rr.unregister_shutdown()

    def _feed(self) -> None:
        while True:
            with self._change:
                while not self._waiting and not self._closing:
                    self._change.wait()
                if not self._waiting:
                    break
                frame = self._waiting.popleft()
            try:
                self._view.show(frame)
            except Exception as error:  # the run must go on whatever the view does
                with self._change:
                    self.error = error
                    self.dropped += 1 + len(self._waiting)
                    self._waiting.clear()
                return
            if self._keeper is not None:
                self._keeper.shown_s = frame.block.end_s
        self._view.send()

"""Where a run's frames go: the recording, and whoever is watching. Shared by every command that runs the loop."""

import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Self

import rerun as rr

from twin.plant.errors import RunError
from twin.rig.recording import APPLICATION, Recorder
from twin.rig.storage import Storage, part_path, parts_beside
from twin.station.answers import note, software
from twin.station.frame import Frame
from twin.station.live import LiveView
from twin.station.native import Broadcast, NativeViewer, ViewerKeeper
from twin.station.rerun_view import RerunView
from twin.station.session import Session
from twin.station.view.pace import KEPT, WATCHED, Pace
from twin.station.web import WebViewer


def has_display() -> bool:
    """Whether a window can be opened here."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def keep_existing(path: Path) -> Path | None:
    """Move a run that is in the way aside, all its files, to the first free ``NAME.k.SUFFIX``; None if there was none.

    Nothing recorded is lost because a name was used twice.
    """
    found = parts_beside(path)
    if not found:
        return None
    k = 1
    while parts_beside(aside := path.with_name(f"{path.stem}.{k}{path.suffix}")):
        k += 1
    for number, file in found.items():
        file.rename(part_path(aside, number))
    return part_path(aside, min(found))


class Outputs:
    """Recording and views of one run; a context manager that leaves a readable recording however it ends.

    Parameters
    ----------
    session
        Gives plant, channels and configuration.
    recording
        File to write; None for none.
    setup
        Markdown about the run, for the view.
    run_config_json, seed
        Kept in the recording.
    window
        Open Rerun's own viewer.
    web
        Serve Rerun's web viewer on this machine.
    storage
        When another file is begun, and how much all may take.
    looked_at
        Whether the recording holds the series that people look at, besides what a replay needs.
    """

    def __init__(
        self,
        session: Session,
        *,
        recording: Path | None,
        setup: str,
        run_config_json: str,
        seed: int | None,
        window: bool = False,
        web: bool = False,
        storage: Storage | None = None,
        looked_at: bool = True,
    ) -> None:
        self._model: float | None = None
        self._session = session
        self._setup = setup
        self.recorder: Recorder | None = None
        self._file_view: RerunView | None = None
        self.live: LiveView | None = None
        self._keeper: ViewerKeeper | None = None
        self._stream: rr.RecordingStream | None = None
        self._web: WebViewer | None = None
        self.url = ""
        self.moved_aside: Path | None = None
        if recording is not None:
            recording.parent.mkdir(parents=True, exist_ok=True)
            self.moved_aside = keep_existing(recording)
            self.recorder = Recorder(
                recording,
                plant=session.plant,
                sample_rate_hz=session.observer.sample_rate_hz,
                channels=session.channels,
                run_config_json=run_config_json,
                seed=seed,
                storage=storage,
                software=software(),
            )
            self._file_view = self._new_file_view(self.recorder) if looked_at else None
        if web or window:
            stream = rr.RecordingStream(APPLICATION)
            if web:
                self._web = WebViewer(stream)
                self.url = self._web.start()
            source = self._web.source if self._web is not None else Broadcast(stream).url
            self._keeper = ViewerKeeper(NativeViewer(), source) if window else None
            self._stream = stream
            self.live = LiveView(self._view(stream, WATCHED), keeper=self._keeper)

    def _new_file_view(self, recorder: Recorder) -> RerunView:
        return self._view(recorder.stream, KEPT)

    def _view(self, stream: rr.RecordingStream, pace: Pace) -> RerunView:
        session = self._session
        return RerunView(
            stream,
            plant=session.plant,
            sample_rate_hz=session.observer.sample_rate_hz,
            channels=session.channels,
            schedule=session.schedule,
            budget_kind=session.settings.goal.budget_kind,
            setup=self._setup,
            pace=pace,
        )

    def take(self, frame: Frame) -> None:
        """Keep and show one frame.

        Raises
        ------
        RunError
            If the recording can no longer be written.
        """
        recorder = self.recorder
        if recorder is not None:
            if self._file_view is not None and recorder.part_is_full(frame.block):
                self._file_view.send()
                recorder.next_part()
                self._file_view = self._new_file_view(recorder)
            recorder.write_block(frame.block)
            sample = frame.block.end_sample - 1
            if self._session.modelled_damping_ns_m != self._model:
                self._model = self._session.modelled_damping_ns_m
                recorder.write_note("models", sample, json.dumps({"damping_ns_m": self._model}))
            for command in frame.commands:
                recorder.write_command(command)
            if frame.ordered is not None and frame.ordered.order is not None:
                recorder.write_note("orders", sample, frame.ordered.order.model_dump_json())
            for answer in frame.acknowledgements:
                recorder.write_acknowledgement(answer, sample)
            for event in frame.events:
                recorder.write_note("events", event.sample, json.dumps(asdict(event)))
            if frame.asked is not None:
                recorder.write_note("questions", sample, json.dumps({"number": frame.asked}))
            if frame.arrival is not None:
                a = frame.arrival
                recorder.write_note("answers", sample, note(a.number, a.trouble, a.chain, a.answer))
            if frame.audited is not None:
                recorder.write_note("audit", frame.audited.sample, json.dumps(asdict(frame.audited)))
            for decision in frame.decisions:
                recorder.write_note("decisions", decision.sample, json.dumps(asdict(decision)))
        if self._file_view is not None:
            self._file_view.show(frame)
        if self.live is not None:
            self.live.show(frame)

    @property
    def watching(self) -> bool:
        """Whether somebody may be looking at this run as it happens."""
        return self.live is not None

    @property
    def frames_unseen(self) -> int:
        """Frames the live view could not take."""
        return self.live.dropped if self.live is not None else 0

    def finish(self) -> None:
        """Finish the recording, so that it can be read; views stay open. Raises RunError if it cannot be."""
        if self._file_view is not None:
            self._file_view.send()
            self._file_view = None
        if self.recorder is not None:
            self.recorder.close()
            self.recorder = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.finish()
        except RunError:
            if error is None:
                raise
        finally:
            if self.live is not None:
                self.live.close()
            if self._web is not None:
                self._web.stop()
            elif self._stream is not None:
                self._stream.disconnect()

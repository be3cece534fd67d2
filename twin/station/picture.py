"""A picture of a recorded run: drawn by Rerun's viewer without a screen, or as a plain summary instead."""

import subprocess
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from rerun.experimental import ViewerClient

from twin.plant.errors import InputError, RunError
from twin.rig.recorded import open_recording
from twin.rig.recording import ROOT
from twin.rig.rerun_tool import rerun_environment, rerun_program
from twin.station import palette
from twin.station.native import NativeViewer
from twin.station.series import Series, read_series

_TIMEOUT_S = 60.0
# The viewer announces itself in a corner for about four seconds; a picture taken earlier would show that.
_SETTLE_S = 5.0
_WAVEFORM_S = 0.12
_PANELS = (
    ("vibration", "Vibration at the excitation [µm]"),
    ("waveform", "Waveform, measured and twin"),
    ("power", "Coil power [W]"),
    ("damping", "Coil damping c2 at the excitation [Ns/m]"),
    ("health/nis", "Model health: NIS, 1 = consistent"),
    ("excitation", "Excitation [Hz]"),
)


@dataclass(frozen=True, slots=True)
class PictureResult:
    """Where the picture is, what drew it, and why it was not Rerun if it was not."""

    path: Path
    how: Literal["rerun", "summary"]
    note: str


def save_picture(
    recording: Path, png: Path, *, time_s: float | None = None, timeout_s: float = _TIMEOUT_S
) -> PictureResult:
    """Draw a recorded run as people saw it.

    Parameters
    ----------
    recording
        A recorder's file.
    png
        Picture to write, 1600 x 1000 pixels; an existing one is replaced.
    time_s
        Where the time cursor stands [s]; None for the end of the run.
    timeout_s
        How long Rerun's viewer may take [s] before the summary is drawn instead.

    Raises
    ------
    InputError
        If the recording cannot be read or the picture cannot be written.
    """
    run = open_recording(recording)
    at_s = run.end_sample / run.sample_rate_hz if time_s is None else time_s
    try:
        png.parent.mkdir(parents=True, exist_ok=True)
        png.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{png}: cannot be written ({error.strerror}); give another place") from error
    with tempfile.TemporaryDirectory(prefix="atmd-") as folder:
        visible = Path(folder) / "visible.rrd"
        _leave_raw_data_out(recording, visible)
        try:
            _draw_with_viewer(visible, png, at_s, timeout_s)
        except RunError as error:
            note = f"drawn without Rerun's viewer: {error}"
            _draw_summary(read_series(visible), png, at_s, f"{run.plant.name}, {recording.name}")
            return PictureResult(png, "summary", note)
    return PictureResult(png, "rerun", "")


def _leave_raw_data_out(recording: Path, visible: Path) -> None:
    """Copy what is to be seen: the viewer would hold ten times as much in memory otherwise."""
    command = [rerun_program(), "rrd", "filter", "--continue-on-error", "--drop-entity", f"/{ROOT}/raw"]
    done = subprocess.run(
        [*command, str(recording), "-o", str(visible)],
        env=rerun_environment(),
        capture_output=True,
        check=False,
    )
    if not visible.is_file():
        raise InputError(f"{recording}: cannot be filtered: {done.stderr.decode(errors='replace')[-300:]}")


def _draw_with_viewer(visible: Path, png: Path, at_s: float, timeout_s: float) -> None:
    """Let a viewer without a screen draw the file; RunError with the reason where it cannot."""
    viewer = NativeViewer(headless=True)
    failure: list[Exception] = []

    def draw(url: str) -> None:
        try:
            _take(url, visible, png, at_s)
        except Exception as error:  # whatever the viewer does, the summary can be drawn
            failure.append(error)

    try:
        url = viewer.start()
        # The client's calls have no time-out of their own.
        worker = threading.Thread(target=draw, args=(url,), daemon=True)
        worker.start()
        worker.join(timeout_s)
        slow = worker.is_alive()
    except InputError as error:
        raise RunError(str(error)) from error
    finally:
        viewer.stop()
    if slow:
        raise RunError(f"the viewer took more than {timeout_s:g} s")
    if failure:
        raise RunError(f"the viewer failed ({str(failure[0])[:200]})") from failure[0]
    if not png.is_file() or float(np.std(imread(png)[..., :3])) < 0.01:
        raise RunError("the viewer drew nothing")


def _take(url: str, visible: Path, png: Path, at_s: float) -> None:
    start = time.monotonic()
    client = ViewerClient.connect(url)
    client.open(str(visible))
    while client.get_state().loading:
        time.sleep(0.1)
    client.set_time("time", duration=at_s)
    time.sleep(max(1.5, _SETTLE_S - (time.monotonic() - start)))
    client.save_screenshot(str(png))


def _draw_summary(series: dict[str, Series], png: Path, at_s: float, title: str) -> None:
    figure = Figure(figsize=(16, 10), dpi=100, facecolor="#0d1011", layout="constrained")
    figure.suptitle(title, color="#eceff1")
    for place, (key, heading) in enumerate(_PANELS, start=1):
        axes = figure.add_subplot(2, 3, place)
        axes.set_title(heading, color="#eceff1", fontsize=10)
        axes.set_facecolor("#11161a")
        axes.tick_params(colors="#b0bec5", labelsize=8)
        axes.grid(color="#37474f", linewidth=0.5)
        _draw_panel(axes, series, key, at_s)
        axes.set_xlabel("time [s]", color="#b0bec5", fontsize=8)
    FigureCanvasAgg(figure)
    figure.savefig(png, format="png", dpi=100)


def _draw_panel(axes: Axes, series: dict[str, Series], key: str, at_s: float) -> None:
    wave = next((path for path in series if path.startswith("waveform/")), "")
    paths = {"damping": ("damping/learned", "damping/in_use"), "waveform": (wave,)}.get(key, (key,))
    shown = [series[path] for path in paths if path in series]
    colours = iter(palette.SERIES * 4)
    for one in shown:
        rows = np.ones(len(one.time_s), dtype=np.bool_)
        if key == "waveform":
            rows = (one.time_s > at_s - _WAVEFORM_S) & (one.time_s <= at_s)
        for column, name in enumerate(one.names):
            colour = palette.hex_of(next(colours))
            time_s, values = one.time_s[rows], one.values[rows, column]
            axes.plot(time_s, values, color=colour, linewidth=1.2, label=name)
            if one.std is not None:
                std = one.std[rows, column]
                axes.fill_between(time_s, values - std, values + std, color=colour, alpha=0.25, linewidth=0)
    if not shown:
        axes.text(0.5, 0.5, "not in this run", color="#b0bec5", ha="center", transform=axes.transAxes)
        return
    if key != "waveform":
        axes.axvline(at_s, color="#eceff1", linewidth=0.8)
    axes.legend(fontsize=8, facecolor="#11161a", labelcolor="#eceff1", edgecolor="#37474f")

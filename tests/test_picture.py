"""A run can be looked at without a screen, and without Rerun's viewer if need be."""

import os
from pathlib import Path

import numpy as np
import pytest
from frames import RATE, channels, frames, schedule
from matplotlib.image import imread

from twin.plant.errors import InputError, RunError
from twin.plant.files import load_plant
from twin.rig.recording import Recorder
from twin.station import picture
from twin.station.picture import save_picture
from twin.station.rerun_view import RerunView
from twin.station.view.pace import KEPT


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "run.rrd"
    plant = load_plant("rig")
    with Recorder(
        path, plant=plant, sample_rate_hz=RATE, channels=channels(plant), run_config_json="{}", seed=1
    ) as recorder:
        view = RerunView(
            recorder.stream,
            plant=plant,
            sample_rate_hz=RATE,
            channels=channels(plant),
            schedule=schedule(),
            pace=KEPT,
        )
        for frame in frames(plant, 6.0):
            recorder.write_block(frame.block)
            view.show(frame)
        view.send()
    return path


def share_of_colour(image: np.ndarray, rgb: tuple[int, int, int]) -> float:
    return float(np.mean(np.all(np.abs(image[..., :3] * 255 - rgb) < 25, axis=-1)))


def test_rerun_draws_the_run(recording: Path, tmp_path: Path) -> None:
    result = save_picture(recording, tmp_path / "new" / "run.png", time_s=5.0)
    if result.how != "rerun" and not os.environ.get("CI"):
        pytest.skip(result.note)
    assert result.how == "rerun", result.note
    image = imread(result.path)
    assert image.shape[:2] == (1000, 1600)
    assert share_of_colour(image, (0xF2, 0xB8, 0x4B)) > 5e-4  # measured
    assert share_of_colour(image, (0xEF, 0x53, 0x50)) > 2e-4  # limits
    assert share_of_colour(image, (0x38, 0x8E, 0x3C)) + share_of_colour(image, (0x2C, 0x70, 0x30)) > 5e-3


def test_without_a_viewer_the_summary_says_why(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_viewer(*_: object) -> None:
        raise RunError("the Rerun viewer did not start: no graphics adapter")

    monkeypatch.setattr(picture, "_draw_with_viewer", no_viewer)
    result = save_picture(recording, tmp_path / "run.png")
    assert result.how == "summary"
    assert "no graphics adapter" in result.note
    image = imread(result.path)
    assert image.shape[:2] == (1000, 1600)
    assert share_of_colour(image, (0xF2, 0xB8, 0x4B)) > 1e-3


def test_a_machine_without_a_graphics_driver_gets_the_summary(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, str(tmp_path / "none.json"))
    monkeypatch.setenv("LIBGL_DRIVERS_PATH", str(tmp_path))
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", str(tmp_path))
    result = save_picture(recording, tmp_path / "run.png")
    assert result.how == "summary"
    assert result.note.startswith("drawn without Rerun's viewer: the ")


def test_a_viewer_that_takes_too_long_is_not_waited_for(recording: Path, tmp_path: Path) -> None:
    result = save_picture(recording, tmp_path / "run.png", timeout_s=0.05)
    assert result.how == "summary"
    assert result.path.is_file()


def test_a_picture_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        save_picture(tmp_path / "none.rrd", tmp_path / "run.png")


def test_a_place_that_cannot_be_written_is_named(recording: Path) -> None:
    with pytest.raises(InputError, match=r"run\.png: cannot be written"):
        save_picture(recording, Path("/proc/nothing/run.png"))

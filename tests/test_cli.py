"""The commands as a person runs them: real processes, real sockets, real files, exit codes and words."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
import pytest
from PIL import Image

from twin.rig.recorded import open_recording

ENVIRONMENT = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
DEMO_KEYS = [
    "attenuation_mean", "attenuation_worst", "current_peak_a", "joule_mean_w", "joule_peak_w", "electrical_mean_w",
    "budget_w", "budget_kind", "damping_rmse_ns_m", "blocks", "dropped", "realtime_factor", "recording", "picture",
]  # fmt: skip
NOT_REPEATED = ("realtime_factor", "recording", "picture", "frames_unseen")


def atmd(*words: str | Path, cwd: Path, timeout: float = 200.0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "twin.station.cli", *map(str, words)]
    return subprocess.run(
        command, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=timeout, check=False
    )


def said(done: subprocess.CompletedProcess[str]) -> str:
    """Words on standard error, without the line breaks a narrow terminal puts in."""
    assert "Traceback" not in done.stderr
    return " ".join(done.stderr.split())


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, object], Path]:
    folder = tmp_path_factory.mktemp("demo")
    done = atmd("demo", "--headless", "--seconds", "12", "--seed", "1", "--json", "-", cwd=folder)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), folder


def test_demo_sums_up_as_json(demo: tuple[dict[str, object], Path]) -> None:
    result, _ = demo
    assert set(DEMO_KEYS) <= set(result)
    assert result["blocks"] == 120
    assert result["dropped"] == 0
    assert result["budget_kind"] == "joule_mean"
    assert result["attenuation_mean"] > 0.9
    assert result["attenuation_worst"] > 0.7
    assert 0.0 < result["joule_mean_w"] < result["budget_w"]
    assert result["joule_mean_w"] < result["joule_peak_w"]
    assert 0.5 < result["current_peak_a"] <= 2.0
    assert result["damping_rmse_ns_m"] < 1.0
    assert result["realtime_factor"] > 1.0


def test_demo_draws_a_picture_with_something_in_it(
    demo: tuple[dict[str, object], Path], requires_debian: Callable[[str], Path]
) -> None:
    requires_debian("mesa-vulkan-drivers")
    result, folder = demo
    picture = np.asarray(Image.open(folder / str(result["picture"])).convert("RGB"), dtype=int)
    assert picture.shape[:2] == (1000, 1600)
    colourful = (picture.max(axis=2) - picture.min(axis=2)) > 60
    # Every panel of the layout has coloured lines in it: no third of the picture's width or height is grey.
    for row in np.array_split(colourful, 4, axis=0):
        for cell in np.array_split(row, 3, axis=1):
            assert cell.sum() > 100


def test_demo_repeats_itself_for_the_same_seed_and_not_for_another(
    demo: tuple[dict[str, object], Path], tmp_path: Path
) -> None:
    result, _ = demo
    same = atmd("demo", "--headless", "--seconds", "12", "--seed", "1", "--json", "s.json", cwd=tmp_path)
    assert same.returncode == 0
    again = json.loads((tmp_path / "s.json").read_text())
    assert {k: v for k, v in again.items() if k not in NOT_REPEATED} == {
        k: v for k, v in result.items() if k not in NOT_REPEATED
    }
    other = atmd("demo", "--headless", "--seconds", "2", "--seed", "2", "--json", "-", cwd=tmp_path)
    assert json.loads(other.stdout)["damping_rmse_ns_m"] != again["damping_rmse_ns_m"]


def test_replay_of_the_demo_repeats_its_decisions(demo: tuple[dict[str, object], Path]) -> None:
    result, folder = demo
    done = atmd("replay", str(result["recording"]), "--plant", "rig", "--json", "-", cwd=folder)
    assert done.returncode == 0, done.stderr
    replayed = json.loads(done.stdout)
    assert replayed["decisions_repeated"] is True
    assert replayed["commands"] == result["commands"] > 5
    for key in ("current_peak_a", "joule_mean_w", "joule_peak_w", "electrical_mean_w", "nis_median"):
        assert replayed[key] == result[key]
    # The passive rig is the model's in a replay and a run of its own in the demo.
    assert replayed["attenuation_mean"] == pytest.approx(result["attenuation_mean"], abs=0.01)


def test_a_second_recording_of_the_same_name_does_not_cost_the_first(tmp_path: Path) -> None:
    (tmp_path / "run.rrd").write_bytes(b"precious")
    done = atmd("demo", "--headless", "--seconds", "2", "--save", "run.rrd", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run.1.rrd").read_bytes() == b"precious"
    assert "kept as run.1.rrd" in said(done)
    assert open_recording(tmp_path / "run.rrd").n_blocks == 20


@contextmanager
def demo_in_mid_run(folder: Path) -> Iterator[tuple[subprocess.Popen[str], psutil.Process]]:
    """A demo in real time, more than six blocks into its recording, and the process of its rig."""
    command = [
        sys.executable,
        "-m",
        "twin.station.cli",
        "demo",
        "--headless",
        "--speed",
        "1",
        "--seconds",
        "60",
    ]
    with subprocess.Popen(
        [*command, "--save", "run.rrd", "--json", "-"],
        cwd=folder, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        rig = wait_for_rig(process.pid)
        wait_until((folder / "run.rrd").exists, 60.0)
        block = 5_000 * 7 * 4  # bytes
        wait_until(lambda: (folder / "run.rrd").stat().st_size > 10 * block, 60.0)
        yield process, rig


def test_killed_rig_ends_the_twin_with_a_message_and_a_readable_recording(tmp_path: Path) -> None:
    with demo_in_mid_run(tmp_path) as (process, rig):
        rig.send_signal(signal.SIGKILL)
        out, err = process.communicate(timeout=90)
    assert process.returncode == 3
    assert "Traceback" not in err
    assert "The rig's process ended in mid-run" in " ".join(err.split())
    assert "run.rrd" in err
    result = json.loads(out)
    assert "ended in mid-run" in result["error"]
    assert result["blocks"] > 5
    recording = open_recording(tmp_path / "run.rrd")
    assert recording.n_blocks == result["blocks"]
    assert not recording.repaired
    replayed = atmd("replay", "run.rrd", cwd=tmp_path)
    assert replayed.returncode == 0


def test_interrupted_demo_leaves_a_readable_recording_and_no_rig_behind(tmp_path: Path) -> None:
    with demo_in_mid_run(tmp_path) as (process, rig):
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in err
    assert "interrupted" in err
    assert open_recording(tmp_path / "run.rrd").n_blocks > 5
    _, alive = psutil.wait_procs([rig], timeout=10.0)
    assert not alive


def wait_for_rig(station: int) -> psutil.Process:
    found: list[psutil.Process] = []

    def looking() -> bool:
        children = psutil.Process(station).children()
        found[:] = [c for c in children if "twin.rig.process" in " ".join(c.cmdline())]
        return bool(found)

    wait_until(looking, 60.0)
    return found[0]


def wait_until(done: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


def test_beam_is_predicted_better_with_its_known_input(realdata: Path, tmp_path: Path) -> None:
    recording = realdata / "beam_closed_lq.npz"
    done = atmd("replay", recording, "--plant", "beam.toml", "--json", "-", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["nrmse"] < 0.07
    assert result["nrmse"] < result["nrmse_without_input"]
    assert result["sensors"][0]["rows"] == 1200
    assert result["fitted_rows_left_out"] == [[0, 1200]]
    assert result["realtime_factor"] > 1.0


FOREIGN_PLANT = """
name = "mine"
[[body]]
name = "tip"
mass_kg = 0.1
attached_to = "ground"
stiffness_n_m = 265.6
damping_ns_m = 0.098
[[actuator]]
name = "u"
kind = "force"
between = ["tip", "ground"]
force_constant_n_v = 4.2e-4
[[sensor]]
name = "y"
kind = "displacement"
of = "tip"
noise_density = 8.5e-6
"""


def test_plant_file_that_states_no_disturbance_gets_the_likeliest(realdata: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(FOREIGN_PLANT)
    recording = realdata / "beam_closed_lq.npz"
    done = atmd("replay", recording, "--plant", "mine.toml", "--json", "-", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert "wandering force" in " ".join(result["remarks"])
    assert result["fitted_rows_left_out"] == [[0, 1200]]
    assert result["nrmse"] < 0.08
    assert result["nrmse"] < result["nrmse_without_input"]


def make_recording(path: Path, n: int = 400) -> None:
    t = np.arange(n) / 100.0
    np.savez(path, tip_displacement=1e-3 * np.sin(8.0 * t), piezo=np.zeros(n))


def test_nan_in_a_channel_is_masked_and_counted(tmp_path: Path) -> None:
    make_recording(tmp_path / "whole.npz")
    with np.load(tmp_path / "whole.npz") as arrays:
        holed = dict(arrays)
    holed["tip_displacement"][100:120] = np.nan
    np.savez(tmp_path / "holed.npz", **holed)
    options = ("--plant", "beam", "--sample-rate", "100", "--yes")
    done = atmd("replay", "holed.npz", *options, "--json", "-", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["masked_samples"] == 20
    assert np.isfinite(result["nrmse"])


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ('name = "x', "not valid TOML"),
        ("", "name: missing"),
        (FOREIGN_PLANT.replace("mass_kg = 0.1", "mass_kg = -0.1"), "mass_kg [kg]: must be greater than 0 kg"),
        (FOREIGN_PLANT.replace("mass_kg = 0.1\n", ""), "mass_kg [kg]: missing; add it in kg"),
        (FOREIGN_PLANT.replace("stiffness_n_m = 265.6", "stiffness_n_m = inf"), "finite number of N/m"),
        (FOREIGN_PLANT.replace('attached_to = "ground"', 'attached_to = "moon"'), "names no body"),
        (FOREIGN_PLANT + "colour = 3\n", "unknown key"),
    ],
)
def test_malformed_plant_is_explained(tmp_path: Path, content: str, complaint: str) -> None:
    (tmp_path / "bad.toml").write_text(content)
    done = atmd("plants", "bad.toml", cwd=tmp_path)
    assert done.returncode == 2
    assert "bad.toml" in said(done)
    assert complaint in said(done)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("replay", "nothing.rrd"), "nothing.rrd: no such recording"),
        (("replay", "notes.txt"), "says nothing about its plant"),
        (("replay", "whole.npz"), "add --plant"),
        (("replay", "whole.npz", "--plant", "bem"), "no preset of that name"),
        (("replay", "whole.npz", "--plant", "beam"), "sample rate"),
        (("replay", "whole.npz", "--plant", "beam", "--channel", "piezo"), "write NAME=ARRAY:UNIT"),
        (("replay", "cut.npz", "--plant", "beam", "--sample-rate", "100"), "cut short or damaged"),
        (("replay", "cut.rrd"), "cut.rrd"),
        (("replay", "whole.npz", "--plant", "beam", "--sample-rate", "100", "--view"), "no display"),
        (("demo", "--headless", "--save", "picture.png"), "ends in .rrd"),
        (("demo", "--seconds", "nan", "--headless"), "seconds"),
        (("plants", "--json", "no/such/folder/x.json"), "cannot be written"),
    ],
)
def test_bad_input_ends_with_2_and_says_what_to_do(
    tmp_path: Path, words: tuple[str, ...], complaint: str
) -> None:
    make_recording(tmp_path / "whole.npz")
    (tmp_path / "notes.txt").write_text("notes")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "whole.npz").read_bytes()[:900])
    (tmp_path / "cut.rrd").write_bytes(b"RRF2")
    done = atmd(*words, cwd=tmp_path)
    assert done.returncode == 2
    assert complaint in said(done)


def test_recording_cut_in_the_middle_is_replayed_as_far_as_it_goes(
    demo: tuple[dict[str, object], Path], tmp_path: Path
) -> None:
    result, folder = demo
    whole = (folder / str(result["recording"])).read_bytes()
    (tmp_path / "cut.rrd").write_bytes(whole[: len(whole) // 2])
    done = atmd("replay", "cut.rrd", "--json", "-", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    replayed = json.loads(done.stdout)
    assert 10 < replayed["blocks"] < 120
    assert "cut short" in " ".join(replayed["remarks"])


@pytest.mark.parametrize("command", ["demo", "replay", "plants", "analyse", "validate", "doctor"])
def test_help_has_an_example(tmp_path: Path, command: str) -> None:
    done = atmd(command, "--help", cwd=tmp_path)
    assert done.returncode == 0
    assert "Example" in done.stdout
    assert f"atmd {command}" in done.stdout
    assert "--json" in done.stdout


def test_presets_are_listed_with_their_frequencies(tmp_path: Path) -> None:
    done = atmd("plants", "--json", "-", cwd=tmp_path)
    plants = {p["name"]: p for p in json.loads(done.stdout)["plants"]}
    assert {"engine", "engine_vcm", "engine_vcm_large", "rig", "rig_no_vcm"} <= set(plants)
    assert plants["rig"]["natural_frequencies_hz"] == pytest.approx([11.09, 54.92], abs=0.01)


def test_doctor_ends_with_what_it_found(tmp_path: Path) -> None:
    done = atmd("doctor", "--json", "-", cwd=tmp_path)
    found = json.loads(done.stdout)
    missing = [c for c in found["checks"] if c["required"] and not c["ok"]]
    assert done.returncode == (1 if missing else 0)
    assert {"control", "cvxpy", "filterpy", "osqp", "rerun-sdk"} <= {c["name"] for c in found["checks"]}

"""atmd recordings smooth: the states of a recorded run, nearer to the truth than the filter has them, as stated."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from typer.testing import CliRunner

from tuning.rule import scheduling_rule
from twin.plant.blocks import make_block
from twin.plant.config import DampingTable
from twin.plant.files import load_plant
from twin.rig.excitation import Sweep
from twin.rig.programme import Programme, rig_channels
from twin.rig.recording import Recorder
from twin.rig.simulated import SimulatedRig
from twin.station.cli import app


def test_smoothed_states_are_those_of_the_rig_within_their_stated_deviations(tmp_path: Path) -> None:
    plant = load_plant("rig")
    programme = Programme(
        plant=plant,
        true_damping=DampingTable(frequency_hz=(40.0, 60.0), ns_m=(7.0, 7.0)),
        sweep=Sweep(from_hz=49.0, to_hz=50.0, duration_s=1.0, amplitude_v=4.0),
        schedule=scheduling_rule(plant, [45.0, 50.0, 55.0]),
        seed=5,
    )
    rig, fs = SimulatedRig(programme, keep_truth=True), programme.sample_rate_hz
    path, truth = tmp_path / "run.rrd", []
    with Recorder(
        path, plant=plant, sample_rate_hz=fs, channels=rig_channels(plant), run_config_json="{}", seed=5
    ) as out:
        while not rig.finished:
            first = rig.next_sample
            values, on, _ = rig.next_block()
            out.write_block(make_block(first, fs, values, rig.channels, control_on=on))
            truth += [t.states[1:] for t in rig.truth]
            states = rig.truth[0].model.states
    table = tmp_path / "states.parquet"
    done = CliRunner().invoke(app, ["recordings", "smooth", str(path), "--out", str(table), "--every", "20"])
    assert done.exit_code == 0, done.output
    found = pq.read_table(table)
    assert found.num_rows == 2_500
    true = np.concatenate(truth)[::20]
    for state in ("x_table", "x_absorber", "v_table", "v_absorber", "i_vcm"):
        error = found[state].to_numpy() - true[:, states.index(state)]
        std = found[f"{state}_std"].to_numpy()
        assert np.all(std > 0.0)
        # Errors last for many samples, so that the share scatters; the rig starts at rest, as the filter assumes.
        assert np.sqrt(np.mean((error / std) ** 2)) < 1.6
        assert np.std(error) < 0.02 * np.std(true[:, states.index(state)])

"""The README's promises that a program can check."""

import re
from pathlib import Path

import pytest

from twin.plant.files import load_plant
from twin.plant.linear import natural_frequencies_hz

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_plant_in_the_readme_loads_and_has_the_frequencies_it_states(tmp_path):
    path = tmp_path / "my_rig.toml"
    path.write_text(re.search(r"```toml\n(.*?)```", README, re.DOTALL)[1], encoding="utf-8")
    stated = re.search(r"natural frequencies are ([\d.]+) and ([\d.]+) Hz", README)
    assert natural_frequencies_hz(load_plant(path)) == pytest.approx(
        [float(f) for f in stated.groups()], abs=0.005
    )


def test_every_make_target_in_the_readme_exists():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set(re.findall(r"(?:`|^    )make ([a-z-]+)", README, re.MULTILINE))
    assert {"demo", "test"} <= named <= targets


def test_every_code_room_in_the_readme_exists():
    rooms = re.findall(r"^\| `((?:twin/[a-z]+|estimators|tuning)/)` \|", README, re.MULTILINE)
    assert len(rooms) == 6
    assert all((ROOT / room / "__init__.py").is_file() for room in rooms)


def test_every_package_that_the_program_needs_is_locked_for_both_environments():
    run, dev = (
        dict(re.findall(r"^([a-z0-9-]+)==([^ ;]+)", (ROOT / "requirements" / name).read_text(), re.MULTILINE))
        for name in ("run.txt", "dev.txt")
    )
    assert run.items() <= dev.items()
    assert {"numpy", "rerun-sdk", "hatchling"} <= run.keys()

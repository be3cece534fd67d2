"""What was learned, on disk: saved with the model it belongs to, and refused for any other."""

import json
from pathlib import Path
from typing import Any

from estimators.damping import DampingLearner
from twin.plant.config import Plant, fingerprint
from twin.plant.errors import InputError

FORMAT = "atmd-twin learned damping 1"


def learned_fingerprint(plant: Plant) -> str:
    """Fingerprint of all that a learned curve depends on.

    That is bodies, actuators and sensors as configured, but neither the absorber's damping, which is what is
    learned, nor limits, nor which recording the parameters were fitted on.
    """
    absorber = plant.absorber
    bare = plant if absorber is None else plant.with_damping(absorber.name, 0.0)
    return fingerprint(bare.model_copy(update={"limits": {}, "fitted_on": ()}))


def save_learned(path: str | Path, learner: DampingLearner, plant: Plant) -> None:
    """Write what a learner knows, as JSON.

    Parameters
    ----------
    plant
        The model it learned with; its damping does not matter.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    content = {
        "format": FORMAT,
        "plant": plant.name,
        "fingerprint": learned_fingerprint(plant),
        **learner.state(),
    }
    try:
        Path(path).write_text(json.dumps(content, allow_nan=False, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); choose a folder that exists and may be written to"
        ) from error


def load_learned(path: str | Path, plant: Plant) -> DampingLearner:
    """Learner that goes on from a file of `save_learned`.

    Raises
    ------
    InputError
        If the file cannot be read, is not such a file, or was learned with another model.
    """
    content = _read(Path(path))
    wanted, found = learned_fingerprint(plant), content.get("fingerprint")
    if found != wanted:
        raise InputError(
            f"{path}: learned with plant '{content.get('plant')}', fingerprint {found}; this plant is "
            f"'{plant.name}', fingerprint {wanted}. What one model learned is wrong for another: load it with the "
            "plant it was saved with, or start without it and learn anew"
        )
    try:
        return DampingLearner.restored(content, plant)
    except (ValueError, KeyError, TypeError) as error:
        what = f"key {error} is missing" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{path}: damaged ({what}); delete it and learn anew") from error


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the name") from error
    except ValueError as error:
        raise InputError(
            f"{path}: is not JSON ({error}); give a file that was saved by this program"
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else None
        raise InputError(f"{path}: format is {found!r}, expected '{FORMAT}'; save it anew with this version")
    return content

"""Answers of the tuner, kept with the question they belong to, so that a replay need not work them out again.

An adviser's answer is a function of the questions it was asked and of the program. Where both are the same to the bit,
the recorded answer is the one that would come out, and a replay takes it; where anything differs, it is worked out.
"""

import functools
import hashlib
import json
import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

import estimators
import tuning
import twin.control
import twin.plant
from tuning.loop import LoopFacts
from tuning.retune import TuningGoal
from twin.plant.config import Plant
from twin.station.advice import Answer, Question

_NUMERIC_LIBRARIES = ("numpy", "scipy", "numba", "pydantic")


class _Kept(BaseModel):
    """An answer on its way to a file: JSON has no word for NaN, so it is a string there."""

    model_config = ConfigDict(ser_json_inf_nan="strings")

    answer: Answer


@functools.cache
def code_id() -> str:
    """Fingerprint of everything but the questions that an answer depends on.

    The sources of plant, control, estimators, tuning and the adviser, Python, the numeric libraries and the kind of
    machine: 16 hex digits.
    """
    digest = hashlib.sha256()
    folders = [
        Path(p) for package in (twin.plant, twin.control, estimators, tuning) for p in package.__path__
    ]
    files = sorted(f for folder in folders for f in folder.rglob("*.py"))
    for file in (*files, Path(__file__).with_name("advice.py")):
        digest.update(f"{file.name}\n".encode())
        digest.update(file.read_bytes())
    about = [platform.python_version(), platform.machine(), platform.system()]
    about += [f"{name} {version(name)}" for name in _NUMERIC_LIBRARIES]
    digest.update("\n".join(about).encode())
    return digest.hexdigest()[:16]


def chain_begin(plant: Plant, facts: LoopFacts, goal: TuningGoal) -> str:
    """Fingerprint of an adviser that was asked nothing yet."""
    return _digest("", plant, facts, goal)


def chain(before: str, question: Question) -> str:
    """Fingerprint of a question and all those an adviser was asked before it, every number to the bit.

    Parameters
    ----------
    before
        Fingerprint of the question before, or of `chain_begin`.
    """
    return _digest(before, *(getattr(question, f.name) for f in fields(question)))


def _digest(before: str, *parts: object) -> str:
    texts = (part.model_dump_json() if isinstance(part, BaseModel) else repr(part) for part in parts)
    return hashlib.sha256("\n".join((before, *texts)).encode()).hexdigest()[:32]


def as_json(answer: Answer) -> str:
    """An answer as one line of JSON, every number to the bit, NaN as a string."""
    return _Kept(answer=answer).model_dump_json()


def from_json(text: str) -> Answer:
    """Read what `as_json` wrote.

    Raises
    ------
    ValueError
        If it is not that.
    """
    return _Kept.model_validate_json(text).answer


@dataclass(frozen=True, slots=True)
class KnownAnswers:
    """Answers of a recorded run, by the fingerprint of the questions that led to them."""

    by_chain: Mapping[str, str]

    def get(self, chain_id: str) -> Answer | None:
        """Answer to the question with that fingerprint; None if it is not known or cannot be read."""
        text = self.by_chain.get(chain_id)
        if text is None:
            return None
        try:
            return from_json(text)
        except ValidationError:
            return None


def software() -> dict[str, str]:
    """Versions that a recording keeps."""
    found = {name: version(name) for name in (*_NUMERIC_LIBRARIES, "rerun-sdk")}
    return found | {"python": platform.python_version(), "machine": platform.machine(), "code_id": code_id()}


NOTHING_KNOWN = KnownAnswers({})


def known_answers(recorded_code_id: str | None, notes: Iterable[tuple[int, str]]) -> KnownAnswers:
    """Answers of a recording that hold here.

    Parameters
    ----------
    recorded_code_id
        `code_id` of the program that recorded; with another than this program's, no answer holds.
    notes
        (sample, JSON) of the notes ``answers``.
    """
    if recorded_code_id != code_id():
        return NOTHING_KNOWN
    told = (json.loads(text) for _, text in notes)
    return KnownAnswers({a["chain"]: json.dumps(a["answer"]) for a in told if a.get("answer") is not None})


def note(number: int, trouble: str, chain_id: str, answer: Answer | None) -> str:
    """The line of JSON under ``answers`` in a recording."""
    line = {"number": number, "trouble": trouble, "chain": chain_id}
    if answer is not None:
        line["answer"] = json.loads(as_json(answer))
    return json.dumps(line, allow_nan=False)

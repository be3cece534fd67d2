"""TOML files into frozen models, with errors a person can act on; the presets that ship with the package."""

import tomllib
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from twin.plant.config import SENSOR_UNITS, Plant
from twin.plant.errors import InputError

M = TypeVar("M", bound=BaseModel)

# Longest suffix first: damping_ns_m is Ns/m, not m.
_UNITS = {
    "_density_n": "N/√Hz", "_ns_m": "Ns/m", "_n_m": "N/m", "_n_a": "N/A", "_n_v": "N/V", "_v_a": "V/A",
    "_kg": "kg", "_ohm": "Ω", "_hz": "Hz", "_us": "µs", "_ms": "ms", "_h": "H", "_a": "A", "_v": "V",
    "_w": "W", "_n": "N", "_m": "m", "_s": "s",
}  # fmt: skip

_LISTS = ("body", "actuator", "sensor", "fitted_on", "excitation", "scatter")
# Words that pydantic puts into the path of an error for the chosen form of a value.
_FORMS = (
    "voice_coil", "shaker", "force", "number", "table", "one", "pair", "uniform", "normal", "log_normal", "thesis",
    "retuned", "from_file", "sweep", "steps", "tone", "shuttle",
)  # fmt: skip


def load_plant(name_or_path: str | Path) -> Plant:
    """Read a plant from a TOML file or, where no such file exists, from the preset of that name.

    Parameters
    ----------
    name_or_path
        A path, or a preset's name with or without ``.toml`` (see `preset_names`).

    Raises
    ------
    InputError
        If there is neither, or the content cannot be used; the message names the file, key and unit.
    """
    path = Path(name_or_path)
    try:
        if path.is_file():
            return read_toml(path, Plant)
        is_directory = path.is_dir()
    except OSError as error:  # a name too long, a folder that may not be entered
        raise InputError(f"{path}: cannot be read ({_reason(error)}); check the path") from error
    name = path.name.removesuffix(".toml")
    if str(name_or_path) in (name, f"{name}.toml") and name in preset_names():
        return _preset(name)
    if is_directory:
        raise InputError(f"{path}: is a directory; give the path of a plant TOML in it")
    raise InputError(
        f"{name_or_path}: no such plant file, and no preset of that name; "
        f"give the path of a plant TOML or one of {', '.join(preset_names())}"
    )


@cache
def preset_names() -> tuple[str, ...]:
    """Names of the plants that ship with the package, sorted."""
    return tuple(
        sorted(
            p.name.removesuffix(".toml")
            for p in files("twin.plant.presets").iterdir()
            if p.name.endswith(".toml")
        )
    )


@cache
def _preset(name: str) -> Plant:
    text = files("twin.plant.presets").joinpath(f"{name}.toml").read_text(encoding="utf-8")
    return parse_toml(text, Plant, f"preset {name}")


def read_toml(path: Path, model: type[M]) -> M:
    """Read one TOML file into a frozen model.

    Raises
    ------
    InputError
        If the file cannot be read, is no TOML, or its content does not fit the model.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # some editors begin a file with a byte order mark
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read ({_reason(error)}); check the path and that it is UTF-8 text"
        ) from error
    return parse_toml(text, model, str(path))


def parse_toml(text: str, model: type[M], where: str) -> M:
    """Parse TOML text into a frozen model; ``where`` names the text in messages.

    Raises
    ------
    InputError
        As `read_toml`.
    """
    try:
        data = tomllib.loads(text)
    except RecursionError as error:
        raise InputError(f"{where}: not valid TOML: nested too deeply") from error
    except ValueError as error:  # also an integer of thousands of digits
        raise InputError(f"{where}: not valid TOML: {error}") from error
    try:
        return model.model_validate(data)
    except ValidationError as error:
        problems = error.errors()
        lines = [_explain(p, data) for p in problems if not _is_consequence(p, problems)]
        raise InputError("\n".join(f"{where}: {line}" for line in dict.fromkeys(lines))) from error


def _is_consequence(problem: Any, problems: list[Any]) -> bool:
    """Whether a list is too short only because of errors in its entries."""
    place = problem["loc"]
    return problem["type"] == "too_short" and any(
        p["loc"][: len(place)] == place and len(p["loc"]) > len(place) for p in problems
    )


def _reason(error: Exception) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else "not UTF-8"


def unit_of(key: str) -> str | None:
    """Return the unit that a key's suffix states, such as ``kg`` for ``mass_kg``; None where it states none."""
    key = "ns_m" if key == "ns_m" else key
    return next((unit for suffix, unit in _UNITS.items() if f"_{key}".endswith(suffix)), None)


def _explain(problem: Any, data: dict[str, Any]) -> str:
    """One pydantic problem in a plant engineer's words."""
    place, key, owner = _locate(problem["loc"], data)
    unit = _unit_in(key, owner)
    label = f"{place} [{unit}]" if unit else place
    kind, context = problem["type"], problem.get("ctx", {})
    got = _got(problem.get("input"))
    in_unit = f" {unit}" if unit else ""
    of_unit = f" of {unit}" if unit else ""
    match kind:
        case "extra_forbidden":
            return f"{place}: unknown key; check its spelling or remove it"
        case "missing" if isinstance(problem["loc"][-1], int):
            return f"{place}: missing; the list is too short"
        case "missing" if place in _LISTS:
            return f"{place}: missing; add at least one [[{place}]]"
        case "missing":
            return f"{label}: missing; add it{f' in {unit}' if unit else ''}"
        case "greater_than":
            return f"{label}: must be greater than {context['gt']:g}{in_unit}{got}"
        case "greater_than_equal":
            return f"{label}: must not be below {context['ge']:g}{in_unit}{got}"
        case "finite_number":
            return f"{label}: must be a finite number{of_unit}{got}"
        case "float_parsing" | "float_type":
            return f"{label}: must be a number{of_unit}{got}"
        case "int_parsing" | "int_type" | "int_from_float":
            return f"{label}: must be a whole number{of_unit}{got}"
        case "string_type":
            return f"{label}: must be text in quotes{got}"
        case "tuple_type" if place in _LISTS:
            return f"{place}: must be written in double brackets, [[{place}]]"
        case "tuple_type":
            return f"{label}: must be a list in square brackets{got}"
        case "model_type" | "dict_type":
            return f"{label}: must be a table of keys and values{got}"
        case "too_short" if place in _LISTS:
            return f"{place}: is empty; add at least one [[{place}]]"
        case "too_short":
            return f"{label}: must have at least {context['min_length']} entries"
        case "too_long":
            return f"{label}: must have no more than {context['max_length']} entries"
        case "literal_error":
            return f"{label}: must be one of {context['expected'].replace(' or ', ', ')}{got}"
        case "value_error":
            return f"{label}: {context['error']}" if place else str(context["error"])
        case "union_tag_not_found" if place.startswith("actuator"):
            return f"{place}: kind is missing; use one of 'voice_coil', 'shaker', 'force'"
        case "union_tag_not_found":
            return f"{place}: {context['discriminator'].strip(chr(39))} is missing; add it"
        case "union_tag_invalid":
            told_by = context["discriminator"].strip("'")
            return f"{place}: {told_by} must be one of {context['expected_tags']}, got {context['tag']!r}"
        case "string_pattern_mismatch" if key == "recorded_as":
            return f'{label}: must be "array", "array:unit" or "array[:,2]:unit"{got}'
        case "string_pattern_mismatch":
            return f"{label}: must begin with a letter and hold letters, digits and _ only{got}"
        case _:
            message = str(problem["msg"])
            return f"{label}: {message[0].lower()}{message[1:]}{got}"


def _got(given: object) -> str:
    """Return what was given, as TOML spells it."""
    if isinstance(given, bool):
        return f", got {str(given).lower()}"
    if not isinstance(given, int | float | str):
        return ""
    text = repr(given)
    return f", got {text}" if len(text) <= 60 else f", got {text[:57]}..."


def _unit_in(key: str, owner: object) -> str | None:
    """Unit of a key; a sensor's noise and range are in the unit of what it measures."""
    kind = owner.get("kind") if isinstance(owner, dict) else None
    if key in ("noise_density", "range") and isinstance(kind, str) and kind in SENSOR_UNITS:
        return SENSOR_UNITS[kind] + ("/√Hz" if key == "noise_density" else "")
    return unit_of(key) if key else None


def _locate(loc: tuple[Any, ...], data: dict[str, Any]) -> tuple[str, str, object]:
    """Where a problem is, as ``body[1] 'absorber' mass_kg``, the key it is about and the table that holds it."""
    words: list[str] = []
    key = ""
    node: Any = data
    owner: Any = data
    for part in loc:
        if isinstance(part, int):
            node = node[part] if isinstance(node, list) and part < len(node) else None
            label = f"[{part}]" + (f" '{node['name']}'" if isinstance(node, dict) and "name" in node else "")
            words[-1:] = [words[-1] + label] if words else [label]
        elif isinstance(node, dict) and (part in node or part not in _FORMS):
            owner, node = node, node.get(part)
            words.append(str(part))
            key = str(part)
    return " ".join(words), key, owner

"""Messages that no rig and no station should send: random bytes, and valid ones with something wrong in them."""

import json
import random
from typing import Any

HUGE = 10**30
WRONG: list[Any] = [
    None, True, "", "x", "\ud800", "a" * 3000, -1, -(2**63), HUGE, 10**400, 0.5, 1e308, float("nan"), float("inf"),
    float("-inf"), [], {}, [[]] * 50, {"a": {"b": {"c": [1, {"d": None}]}}}, ["0"], "\x00\x1b[2J",
]  # fmt: skip


def deep(levels: int = 3000) -> bytes:
    """JSON nested deeper than any parser's stack."""
    return b'{"run_id":' + b"[" * levels + b"]" * levels + b"}"


def text(message: Any) -> bytes:
    """JSON as a careless sender writes it, NaN and lone surrogates included."""
    return json.dumps(message).encode("utf-8", "surrogatepass")


def spoiled(rng: random.Random, message: dict[str, Any]) -> bytes:
    """A valid message with one thing wrong: a value, a key, or some of its bytes."""
    match rng.randrange(6):
        case 0 | 1:
            return text(message | {rng.choice(list(message)): rng.choice(WRONG)})
        case 2:
            left_out = rng.choice(list(message))
            return text({k: v for k, v in message.items() if k != left_out} | {"surprise": rng.choice(WRONG)})
        case 3:
            data = bytearray(text(message))
            for _ in range(rng.randrange(1, 8)):
                data[rng.randrange(len(data))] = rng.randrange(256)
            return bytes(data)
        case 4:
            data = text(message)
            return data[: rng.randrange(len(data))]
        case _:
            return rng.choice(
                [deep(), b"", b"{}", b"[]", b"null", b"1" * 5000, b'{"a":1e999}', rng.randbytes(40)]
            )

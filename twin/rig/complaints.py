"""What was refused, counted by its reason, and said often enough to be known and seldom enough not to be a flood."""

from collections import deque

from pydantic import ValidationError

FIRST = 5
"""Of each reason so many are told; after that the tenth, hundredth, thousandth and so on."""

MOST_WAITING = 200


def plain(text: object, most: int = 200) -> str:
    """Text from a stranger, fit for a log: of bounded length, printable, and valid Unicode."""
    cut = str(text)[:most].encode("utf-8", "replace").decode("utf-8")
    return "".join(c if c.isprintable() else "?" for c in cut)


def first_problem(error: ValidationError) -> str:
    """Say where a message is wrong, and how."""
    problem = error.errors()[0]
    return f"{'.'.join(str(part) for part in problem['loc']) or 'message'}: {problem['msg']}"


class Complaints:
    """Counts refusals by kind, and keeps words about some of them until they are fetched.

    Attributes
    ----------
    by_kind
        How often each kind of reason was given.
    """

    def __init__(self) -> None:
        self.by_kind: dict[str, int] = {}
        self._waiting: deque[str] = deque(maxlen=MOST_WAITING)

    @property
    def in_all(self) -> int:
        """How many there were."""
        return sum(self.by_kind.values())

    def add(self, kind: str, words: str = "") -> None:
        """Count one.

        Parameters
        ----------
        kind
            One of a fixed few: a kind is remembered for ever.
        words
            What to say of this one, after the kind; cut to a readable length.
        """
        count = self.by_kind[kind] = self.by_kind.get(kind, 0) + 1
        if count <= FIRST or _is_power_of_ten(count):
            more = f" ({count} of this kind so far)" if count > FIRST else ""
            self._waiting.append(f"{kind}{': ' + plain(words) if words else ''}{more}")

    def said(self) -> tuple[str, ...]:
        """Words since the last call."""
        found = []
        while self._waiting:
            found.append(self._waiting.popleft())
        return tuple(found)


def _is_power_of_ten(count: int) -> bool:
    return set(str(count)[1:]) <= {"0"} and str(count)[0] == "1"

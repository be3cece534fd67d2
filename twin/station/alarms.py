"""What is wrong with how a block went, by the limits and the budget."""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Literal

from tuning.types import BudgetKind
from twin.plant.config import Plant
from twin.station.frame import Performance

POWER_BLOCKS = 10
"""Power is judged as the mean of so many blocks: what sensor noise burns differs from one to the next."""

OVER_BUDGET, AT_LIMIT = 1.15, 0.98
"""Shares of the budget and of a limit from which there is an alarm."""

AlarmState = Literal["none", "over budget", "at a limit"]


@dataclass(slots=True)
class AlarmWatch:
    """Holds every block against the coil's current limit and the power budget.

    Attributes
    ----------
    plant
        Gives the limit.
    kind
        Which power the budget bounds.
    """

    plant: Plant
    kind: BudgetKind = "joule_mean"
    _spent: deque[float] = field(default_factory=lambda: deque(maxlen=POWER_BLOCKS))

    @property
    def spent_w(self) -> float:
        """Mean power of the latest blocks [W]; NaN before the first."""
        return sum(self._spent) / len(self._spent) if self._spent else math.nan

    def restart(self) -> None:
        """Forget the blocks before: a recording jumped."""
        self._spent.clear()

    def take(self, performance: Performance | None) -> tuple[AlarmState, str]:
        """Return the worst of a block's alarms and what it is in words; ``none`` and nothing where all is well."""
        p, coil = performance, self.plant.voice_coil
        if p is None or coil is None:
            self._spent.clear()
            return "none", ""
        self._spent.append(p.powers.of_kind(self.kind))
        limit = self.plant.limits.get(f"{coil.name}_current_a", math.inf)
        if p.current_peak_a > AT_LIMIT * limit:
            return "at a limit", f"{coil.name}: {p.current_peak_a:.2f} A, limit {limit:g} A"
        spent = self.spent_w
        if spent > OVER_BUDGET * p.budget_w:
            return "over budget", f"{spent:.3g} W, budget {p.budget_w:.3g} W"
        return "none", ""

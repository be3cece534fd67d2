"""What a campaign asks, as one TOML file: plants, excitations, schedule, scatter, goal; or an archive of recordings."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from tuning.campaign.sampling import Correlation, correlation_root
from tuning.campaign.sampling import Kind as Sampling
from tuning.campaign.scatter import Scatter
from tuning.types import BudgetKind
from twin.plant.config import Frozen, Name, NonNegative, Positive
from twin.rig.excitation import Excitation

MOST_CASES = 1_000_000


class ThesisRule(Frozen):
    """The scheduling rule of the thesis (eq. 6-5).

    Attributes
    ----------
    at_hz
        Table, ``FROM:TO:STEP`` or a list.
    high_pass_hz, low_pass_hz
        Cutoffs; without a low-pass it is paired, ``f² / high_pass_hz``.
    per_case
        True: the rule knows each case's own parameters. False: those of the nominal plant.
    """

    kind: Literal["thesis"]
    at_hz: str = "45:55:1"
    high_pass_hz: Positive = 2.5
    low_pass_hz: Positive | None = None
    per_case: bool = False


class Retuned(Frozen):
    """Gains by the tuner, as ``atmd tune`` finds them, within the budget of the case.

    Attributes
    ----------
    at_hz, high_pass_hz, low_pass_hz, per_case
        As `ThesisRule`; retuning every case takes a fraction of a second for each point of the table.
    modulus_margin, delay_margin_us, drift_hz
        What the tuner keeps.
    """

    kind: Literal["retuned"]
    at_hz: str = "45:55:1"
    high_pass_hz: Positive = 2.5
    low_pass_hz: Positive | None = None
    per_case: bool = False
    modulus_margin: NonNegative = 0.15
    delay_margin_us: NonNegative = 0.0
    drift_hz: NonNegative = 0.25


class FromFile(Frozen):
    """A schedule that was handed over: the JSON of ``atmd tune`` or of ``atmd export``, or a recording's last."""

    kind: Literal["from_file"]
    file: str


Schedule = Annotated[ThesisRule | Retuned | FromFile, Field(discriminator="kind")]


class GoalSpec(Frozen):
    """What a case must keep to count, beside the plant's limits, stability and the budget."""

    displacement_m: Positive | None = None
    attenuation: float | None = Field(default=None, lt=1.0)
    settle_s: NonNegative = 1.0


class Archive(Frozen):
    """Recordings to be replayed instead of cases to be simulated.

    Attributes
    ----------
    recordings
        A pattern such as ``runs/**/*.rrd``, from the folder of the specification on.
    plants
        Presets or plant files in place of the one that each recording carries; several compare models or coils.
    budgets_w, budget_kind, modulus_margins
        What the tuner is asked in place of what it was asked then: every recording is replayed with every combination,
        and what would have been proposed is kept.
    """

    recordings: str
    plants: tuple[str, ...] = ()
    budgets_w: tuple[Positive, ...] = ()
    budget_kind: BudgetKind = "joule_mean"
    modulus_margins: tuple[NonNegative, ...] = ()


class CampaignSpec(Frozen):
    """A campaign.

    Attributes
    ----------
    draws
        How often the scattered parameters are drawn for each plant, excitation and budget.
    plants
        Presets or plant files, one for each coil or build to be compared.
    budgets_w, budget_kind
        Power that the coil may take; none for no budget.
    delay_us
        Between measuring and the converter's update; any number, parts of a sample included.
    sensor_noise
        Whether the accelerometers are noisy; drawn as the simulated rig draws it, which triples the time.
    sampling, correlation
        How the draws are spread (``random``, ``latin_hypercube``, ``sobol``), and parameters that vary together.
    report_hz
        Where poles and margins are looked at.
    """

    name: Name
    seed: int = Field(default=0, ge=0)
    draws: int = Field(default=1, ge=1, le=MOST_CASES)
    plants: tuple[str, ...] = Field(default=("rig",), min_length=1)
    budgets_w: tuple[Positive, ...] = ()
    budget_kind: BudgetKind = "joule_mean"
    sample_rate_hz: Positive = 10_000.0
    block_s: Positive = 0.1
    delay_us: NonNegative = 50.0
    measurement: Literal["relative", "absolute"] = "relative"
    sensor_noise: bool = False
    report_hz: str = "45:55:1"
    excitation: tuple[Excitation, ...] = ()
    schedule: Schedule | None = None
    goal: GoalSpec = GoalSpec()
    scatter: tuple[Scatter, ...] = ()
    sampling: Sampling = "random"
    correlation: tuple[Correlation, ...] = ()
    archive: Archive | None = None

    @model_validator(mode="after")
    def _asks_one_thing(self) -> Self:
        if self.archive is not None:
            extra = [
                key
                for key in ("excitation", "schedule", "scatter", "correlation", "budgets_w")
                if getattr(self, key)
            ]
            if extra:
                raise ValueError(
                    f"archive: recordings are replayed as they are; leave out {', '.join(extra)}"
                )
            return self
        if not self.excitation:
            raise ValueError(
                "excitation: missing; add at least one [[excitation]], or [archive] with recordings"
            )
        if self.schedule is None:
            raise ValueError(
                'schedule: missing; add [schedule] with kind = "thesis", "retuned" or "from_file"'
            )
        if isinstance(self.schedule, Retuned) and not self.budgets_w:
            raise ValueError("budgets_w [W]: missing; the tuner needs a budget to retune within")
        names = [s.parameter for s in self.scatter]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(
                f"scatter: {', '.join(twice)} is there twice; give each parameter one distribution"
            )
        correlation_root(tuple(names), self.correlation)
        noisy = [name for name in names if name.endswith(".noise_density")]
        if noisy and not self.sensor_noise:
            raise ValueError(f"scatter: {noisy[0]} does nothing without noise; add sensor_noise = true")
        if self.draws > 1 and not self.scatter and not self.sensor_noise:
            raise ValueError("draws: nothing is scattered, every draw would be the same; add [[scatter]]")
        if self.cases > MOST_CASES:
            raise ValueError(f"{self.cases} cases are more than {MOST_CASES}; take fewer draws")
        return self

    @property
    def combinations(self) -> list[tuple[int, int, int]]:
        """Indices of plant, budget and excitation; -1 for no budget."""
        budgets = range(len(self.budgets_w)) if self.budgets_w else [-1]
        return [
            (p, b, e) for p in range(len(self.plants)) for b in budgets for e in range(len(self.excitation))
        ]

    @property
    def cases(self) -> int:
        """How many cases there are."""
        return len(self.combinations) * self.draws

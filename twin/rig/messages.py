"""What rig and station say to each other, as strict models: `docs/protocol.md` is the page about them."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from twin.control.schedule import GainSchedule

VERSION: Literal[2] = 2
MAX_BLOCK_SAMPLES = 1_000_000
MAX_CHANNELS = 256

Short = Annotated[str, Field(max_length=200)]


class Message(BaseModel):
    """Base of all messages: frozen, finite, and deaf to what a later version may add."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False, strict=True)


class WireChannel(Message):
    """One column of the samples: its name and the unit of its values."""

    name: Annotated[str, Field(min_length=1, max_length=100)]
    unit: Annotated[str, Field(max_length=20)]


class Hello(Message):
    """What the rig is and sends, told again every second.

    Attributes
    ----------
    run_id
        Anew with every start of the rig: its sample count begins at 0 again.
    plant, config_id
        Name and fingerprint of the plant the rig was set up for.
    schedule
        The controller's at the start of the run; None if the rig runs none.
    loop_delay_samples
        Samples between measuring and the converter's update.
    waits_for_start
        Whether the rig sends nothing before ``start``.
    """

    version: Literal[2]
    run_id: Annotated[str, Field(min_length=1, max_length=64)]
    sample_rate_hz: Annotated[float, Field(gt=0.0, le=1e8)]
    block_samples: Annotated[int, Field(ge=1, le=MAX_BLOCK_SAMPLES)]
    channels: Annotated[tuple[WireChannel, ...], Field(min_length=1, max_length=MAX_CHANNELS, strict=False)]
    plant: Short = ""
    config_id: Short = ""
    schedule: GainSchedule | None = None
    measurement: Literal["relative", "absolute"] = "relative"
    loop_delay_samples: Annotated[int, Field(ge=0, le=10_000)] = 1
    waits_for_start: bool = False


class SamplesHeader(Message):
    """What stands before a block's samples.

    Attributes
    ----------
    sequence
        Counts the blocks of a run from 0.
    first_sample
        Index of the block's first sample since the run began.
    control_on
        Whether the controller was acting at the block's end; None if the rig cannot tell.
    commands_applied
        Identifiers of the commands that took effect at the first sample.
    notice
        What the operator should know: a limit that tripped, a station that was lost.
    """

    run_id: Annotated[str, Field(min_length=1, max_length=64)]
    sequence: Annotated[int, Field(ge=0, le=2**62)]
    first_sample: Annotated[int, Field(ge=0, le=2**62)]
    n_samples: Annotated[int, Field(ge=1, le=MAX_BLOCK_SAMPLES)]
    config_id: Short = ""
    control_on: bool | None = None
    commands_applied: Annotated[tuple[int, ...], Field(max_length=1000, strict=False)] = ()
    notice: Annotated[str, Field(max_length=500)] = ""

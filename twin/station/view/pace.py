"""How much of a run is shown, and how often: one pace for people who watch, one for the file."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Pace:
    """How much of a run is shown, and how often.

    Attributes
    ----------
    hold_blocks, hold_slow_blocks
        Blocks to collect before series are sent: those of many samples, and those of one per block.
    trend_s
        Width of the window in which slow quantities are shown [s]; None for the whole run.
    follow
        Whether the viewer keeps up with the end of the data.
    spectrum_s, curve_s, text_s, image_s
        Time between spectra, curves of the damping, figures in the drawing and, at least, images of the waterfall [s].
    """

    hold_blocks: int
    hold_slow_blocks: int
    trend_s: float | None
    follow: bool
    spectrum_s: float
    curve_s: float
    text_s: float
    image_s: float


WATCHED = Pace(1, 5, trend_s=30.0, follow=True, spectrum_s=0.1, curve_s=0.5, text_s=0.5, image_s=0.5)
"""For people who look on as it happens."""

KEPT = Pace(50, 50, trend_s=None, follow=False, spectrum_s=1.0, curve_s=1.0, text_s=1.0, image_s=1.0)
"""For a file that is looked at afterwards."""

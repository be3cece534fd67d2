"""A circuit as a SPICE deck (tested with ngspice): what the thesis simulates in 4.3.4 and 11.7 to 11.10.

Elements carry the names of their loops: L_, R_ and C_, and a source VI_ of zero volt as ammeter, so that
``i(VI_table)`` is the current of loop ``table``. A loop nested in another is a pair of parallel paths in it: its own
inductor, and the branch they share, which then carries the difference of the two currents.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from math import inf

from twin.plant.analogue import Circuit, Feedback, Loop, Source
from twin.plant.config import GROUND


@dataclass(frozen=True, slots=True)
class AcSweep:
    """Response to one source's command of amplitude 1, at points equally far apart [Hz]."""

    source: str
    first_hz: float
    last_hz: float
    points: int


@dataclass(frozen=True, slots=True)
class Transient:
    """From rest, one source's command a sine from time 0: amplitude in its unit, Hz, seconds.

    ``step_s`` is the longest step the simulator may take.
    """

    source: str
    amplitude: float
    frequency_hz: float
    stop_s: float
    step_s: float


def spice_deck(circuit: Circuit, analysis: AcSweep | Transient) -> str:
    """Write the circuit as a SPICE deck with one analysis, ``.ac`` or ``.tran``.

    Batch use: ``ngspice -b -r out.raw deck.cir``; without ``-r`` the loop currents are printed.

    Parameters
    ----------
    circuit
        Its controlled sources become one behavioural source each (B_), which reads charges from capacitors,
        currents from ammeters and their rates from inductors: no integrator, no state of its own.

    Raises
    ------
    ValueError
        If two names differ in upper and lower case only, which SPICE does not tell apart, if the analysis
        names no source, or asks for frequencies, points or times that are not above 0.
    """
    _check_names(circuit, analysis.source)
    kind = "ac" if isinstance(analysis, AcSweep) else "tran"
    currents = " ".join(f"i(VI_{loop.name})" for loop in circuit.loop)
    lines = [
        f"* {circuit.name}: volt = newton, ampere = metre per second, coulomb = metre",
        *_Deck(circuit, analysis).lines(),
        _command(analysis),
        f".print {kind} {currents}",
        ".options reltol=1e-6",
        ".end",
    ]
    return "\n".join(lines) + "\n"


def _check_names(circuit: Circuit, driven: str) -> None:
    names = [loop.name for loop in circuit.loop]
    names += [source.name for source in circuit.source] + [law.name for law in circuit.feedback]
    for name, count in Counter(name.casefold() for name in names).items():
        if count > 1:
            raise ValueError(f"names that differ in case only are one to SPICE: '{name}'; rename one")
    if driven not in {source.name for source in circuit.source}:
        known = ", ".join(source.name for source in circuit.source) or "none"
        raise ValueError(f"'{driven}' names no source of the circuit; known: {known}")


def _command(analysis: AcSweep | Transient) -> str:
    if isinstance(analysis, AcSweep):
        # asked for two points, ngspice gives one
        if not (0.0 < analysis.first_hz < analysis.last_hz < inf and analysis.points >= 3):
            raise ValueError("an AC sweep needs 0 < first_hz < last_hz and at least three points")
        return f".ac lin {analysis.points} {_number(analysis.first_hz)} {_number(analysis.last_hz)}"
    step, stop = analysis.step_s, analysis.stop_s
    if not (0.0 < step <= stop < inf and 0.0 < analysis.frequency_hz < inf and abs(analysis.amplitude) < inf):
        raise ValueError("a transient needs 0 < step_s <= stop_s, frequency_hz above 0, finite amplitude")
    return f".tran {_number(step)} {_number(stop)} 0 {_number(step)} uic"


class _Deck:
    """Elements of one circuit, loop after loop; each loop numbers its own nodes."""

    def __init__(self, circuit: Circuit, analysis: AcSweep | Transient) -> None:
        self.circuit = circuit
        self.analysis = analysis
        self._nodes: Counter[str] = Counter()
        self._inductor: dict[str, tuple[str, str]] = {}
        self._capacitor: dict[str, tuple[str, str]] = {}

    def lines(self) -> Iterator[str]:
        """All elements: loops, then what drives several of them or needs a gain, then the feedback."""
        for loop in self.circuit.loop:
            if loop.branch_with is None:
                yield from self._loop(loop, "0", self._node(loop))
        for source in self.circuit.source:
            if not _is_plain(source):
                unit = "V" if source.command == "V" else "A; one volt stands for one ampere"
                yield f"* command of {source.name} [{unit}]"
                yield f"V_{source.name} u_{source.name} 0 {self._waveform(source)}"
        for law in self.circuit.feedback:
            yield f"B_{law.name} law_{law.name} 0 V = {self._law(law)}"

    def _node(self, loop: Loop) -> str:
        self._nodes[loop.name] += 1
        return f"{loop.name}_{self._nodes[loop.name]}"

    def _loop(self, loop: Loop, start: str, end: str) -> Iterator[str]:
        """From start to end the loop's own path; from end back to start the branch it shares, or its own."""
        yield f"* loop {loop.name}"
        here = start
        for element in self._drives(loop):
            there = self._node(loop)
            yield element.format(there=there, here=here)
            here = there
        there = self._node(loop)
        yield f"VI_{loop.name} {here} {there} 0"
        children = [other for other in self.circuit.loop if other.branch_with == loop.name]
        here, there = there, (self._node(loop) if children else end)
        self._inductor[loop.name] = (here, there)
        yield f"L_{loop.name} {here} {there} {_number(loop.inductance_h)}"
        middle = end
        if loop.resistance_ohm > 0.0:  # SPICE knows no resistor of zero
            middle = self._node(loop)
            yield f"R_{loop.name} {end} {middle} {_number(loop.resistance_ohm)}"
        self._capacitor[loop.name] = (middle, start)
        yield f"C_{loop.name} {middle} {start} {_number(loop.capacitance_f)}"
        for number, child in enumerate(children, 1):
            here, there = there, (end if number == len(children) else self._node(loop))
            yield from self._loop(child, here, there)

    def _drives(self, loop: Loop) -> Iterator[str]:
        """Sources in the loop's own path, with places for the two nodes; a positive one drives its current."""
        for source in self.circuit.source:
            for (place, sign), which in zip(source.pushes, ("first", "second"), strict=False):
                if place != loop.name:
                    continue
                if _is_plain(source):
                    yield f"V_{source.name} {{there}} {{here}} {self._waveform(source)}"
                else:
                    gain = sign * (source.volts_per_unit or 1.0)
                    yield f"E_{source.name}_{which} {{there}} {{here}} u_{source.name} 0 {_number(gain)}"
        for law in self.circuit.feedback:
            for place, sign, which in ((law.first, -1.0, "first"), (law.second, 1.0, "second")):
                if place == loop.name:
                    yield f"E_{law.name}_{which} {{there}} {{here}} law_{law.name} 0 {_number(sign)}"

    def _waveform(self, source: Source) -> str:
        analysis = self.analysis
        if analysis.source != source.name:
            return "dc 0"
        if isinstance(analysis, AcSweep):
            return "dc 0 ac 1"
        return f"dc 0 sin(0 {_number(analysis.amplitude)} {_number(analysis.frequency_hz)})"

    def _law(self, law: Feedback) -> str:
        """Write the law with alpha, beta and gamma as they stand, over voltages and currents SPICE has anyway."""
        terms = []
        by_name = {loop.name: loop for loop in self.circuit.loop}
        if law.alpha_h:
            rates = [
                f"v({','.join(self._inductor[name])})/{_number(by_name[name].inductance_h)}"
                for name in (law.first, law.second)
            ]
            terms.append(f"({_number(law.alpha_h)})*({rates[0]} - {rates[1]})")
        if law.beta_ohm:
            terms.append(f"({_number(law.beta_ohm)})*(i(VI_{law.first}) - i(VI_{law.second}))")
        if law.gamma_1_f:
            charge = " ".join(
                f"{sign} {_number(loop.capacitance_f)}*v({','.join(self._capacitor[loop.name])})"
                for sign, loop in _charge(self.circuit, law)
            )
            terms.append(f"({_number(law.gamma_1_f)})*({charge})")
        return " + ".join(terms) or "0"


def _charge(circuit: Circuit, law: Feedback) -> list[tuple[str, Loop]]:
    """Capacitors, with their signs, whose charges add up to the first loop's charge less the second's."""
    first, second = circuit.path(law.first), circuit.path(law.second)
    return [("+", loop) for loop in first if loop not in second] + [
        ("-", loop) for loop in second if loop not in first
    ]


def _number(value: float) -> str:
    """All digits of a number, as SPICE reads them."""
    return repr(float(value))


def _is_plain(source: Source) -> bool:
    """Whether one voltage source in one loop is all there is to it."""
    return source.on is not None and source.on != GROUND and source.volts_per_unit is None

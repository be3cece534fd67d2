"""The simulated rig as a process of its own, for the program that starts it and ends with it.

Started with a JSON object on standard input (programme, keys, pace), it answers with one JSON line on standard
output (its ports) and then speaks only over ZeroMQ. When its standard input closes, its starter is gone and it
ends.
"""

import json
import os
import select
import sys

from twin.plant.errors import RunError
from twin.rig.programme import Programme
from twin.rig.server import RigServer
from twin.rig.simulated import SimulatedRig
from twin.rig.wire import KeyPair


def main() -> None:
    """Entry point of the process; see the module's description."""
    order = json.loads(sys.stdin.buffer.readline())
    programme = Programme.model_validate_json(json.dumps(order["programme"]))
    rig = SimulatedRig(programme)
    warm_up(programme)
    keys = KeyPair(order["rig_public"].encode(), order["rig_secret"].encode())
    stations = [order["station_public"].encode()]
    server = RigServer(rig, keys, stations, float(order["speed"]), starter_gone=_starter_gone)
    ports = {"samples_port": server.samples_port, "commands_port": server.commands_port}
    print(json.dumps(ports), flush=True)
    try:
        server.run()
    except RunError as error:
        print(f"rig: {error}", file=sys.stderr, flush=True)
        sys.exit(3)
    except KeyboardInterrupt:
        sys.exit(130)


def warm_up(programme: Programme) -> None:
    """Compile the kernels before the first block is due."""
    short = programme.model_copy(update={"block_samples": 10})
    SimulatedRig(short).next_block()


def _starter_gone() -> bool:
    """Whether standard input has closed: nobody is left who would miss this process."""
    if os.name != "posix":
        return False  # pipes cannot be polled there; the silent-station limit ends the rig instead
    ready, _, _ = select.select([sys.stdin], [], [], 0.0)
    return bool(ready) and os.read(sys.stdin.fileno(), 4096) == b""


if __name__ == "__main__":
    main()

"""The cases by name, in their usual setting and in a tiny one that only shows that they work."""

from collections.abc import Callable
from typing import Any

from benchmarks import campaign, chain, filters, latency, observer, plant, replay, retune
from benchmarks.report import Report

CASES: dict[str, tuple[Callable[[Any], Report], Any, Any]] = {
    "observer": (observer.run_observer, observer.Setting(), observer.SMALL),
    "plant": (plant.run_plant, plant.Setting(), plant.SMALL),
    "filters": (filters.run_filters, filters.Setting(), filters.SMALL),
    "chain": (chain.run_chain, chain.Setting(), chain.SMALL),
    "replay": (replay.run_replays, replay.Setting(), replay.SMALL),
    "campaign": (campaign.run_campaign_case, campaign.Setting(), campaign.SMALL),
    "latency": (latency.run_latency, latency.Setting(), latency.SMALL),
    "retune": (retune.run_retune, retune.Setting(), retune.SMALL),
}


def run_case(name: str, *, small: bool = False) -> Report:
    """Run one case."""
    run, usual, tiny = CASES[name]
    return run(tiny if small else usual)

"""Fixtures for all tests, their order, and one torch thread so that results do not depend on cores."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.sim.bundle import MapBundle
from tests.helpers.places import NOT_SHARED
from tests.helpers.straight_road import straight_network

INTEGRATION = Path(__file__).parent / "integration"

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def straight_map() -> MapBundle:
    return build_bundle(straight_network())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of `integration/` carry the mark and come last."""
    for item in items:
        if INTEGRATION in item.path.parents:
            item.add_marker(pytest.mark.integration)
    items.sort(key=lambda item: item.get_closest_marker("integration") is not None)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """How many tests were skipped because the data that is not shipped is not there."""
    skipped = terminalreporter.stats.get("skipped", [])
    count = sum(NOT_SHARED in str(report.longrepr) for report in skipped)
    if count:
        terminalreporter.write_line(f"{count} tests skipped, {NOT_SHARED}")

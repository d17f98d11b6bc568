"""A written site, and a browser."""

import pytest
from browser import CHROMIUM, Browser
from example_site import board, report

from leaderboard.report.site import write_site


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    write_site(board(), report(), folder)
    return folder


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("chromium is not installed")
    with Browser() as made:
        yield made

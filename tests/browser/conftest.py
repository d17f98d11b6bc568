"""A written site, and a browser."""

import pytest
from browser import CHROMIUM, Browser
from example_site import board, built


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    built(board(), folder)
    return folder


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("chromium is not installed")
    with Browser() as made:
        yield made

"""Number of examples of a property: few in the suite, many times as many in `make test-long`."""

import os

from hypothesis import settings

FACTOR = int(os.environ.get("ROADRECON_EXAMPLES", "1"))


def examples(number: int) -> settings:
    """Return the decorator of a test with so many examples, times ROADRECON_EXAMPLES, not 30."""
    return settings(max_examples=number * FACTOR, deadline=None)

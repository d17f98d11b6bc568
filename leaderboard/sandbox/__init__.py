"""Isolation of foreign code: it runs in guest processes, inside bubblewrap where that is available.

    client             in the host: runs estimators in guests and checks every reply
    retest             in the host: does an entry look ahead, or remember?
    launch             start of a guest: what it sees, its environment, its container
    bubblewrap         the command line of the container: a minimal, read-only tree without network
    guest              one guest process: pipes, limits, ending it with everything it has started
    messages           the format of requests and replies
    worker             in the guest: becomes another user, sets limits, serves requests
    estimator_handler  in the guest: the requests to an estimator

The host is the process that evaluates. It holds the truth of the test drives, their roads and their
seeds, and never sends them. `docs/isolation.md` says what is guaranteed, and what is not.
"""

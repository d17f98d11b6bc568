"""Isolation of entries: each runs in a guest process, inside bubblewrap where that is available.

    client      in the host: drives the dialogue, checks every reply, measures time and memory
    entry_files snapshot and digest of the code of an entry, without importing it
    bubblewrap  the command line of the container: a minimal, read-only tree without network
    guest       one guest process: pipes, limits, ending it with everything it has started
    messages    the format of requests and replies
    worker      in the guest: loads the estimator and serves requests

The host is the process that evaluates. It holds the truth of the test drives, their roads and
their seeds, and never sends them.
`docs/running.md` says what is guaranteed, with and without bubblewrap, and what is not.
"""

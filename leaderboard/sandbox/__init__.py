"""Isolation of entries in separate processes.

    client      in the evaluating process: holds the truth, writes records, reads estimates
    server      a process with the libraries loaded, started before any truth exists; forks
    supervisor  one for each run of an entry: enforces limits, kills leftover processes
    worker      the entry's process: records in, estimates out

The truth of a test drive never reaches the server or its descendants. The isolation of the worker
depends on the platform. It always has its own session, environment, folder and limits, and is
killed with all its children. Where the kernel grants namespaces (Linux, for root or with user
namespaces) it has no network, sees no process but its own, cannot write outside its folder, and
does not see the folder of results. `docs/running.md` lists the remaining gaps.
"""

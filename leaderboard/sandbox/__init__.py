"""Entries in processes of their own.

    host      the judge: holds the truth, writes records, reads estimates
    server    a clean process with the libraries loaded, started before any truth exists; forks
    guard     one for each run of an entry: watches time, memory and processes, kills what is left
    guest     the entry's process: records in, estimates out, nothing else

The truth of a test drive never reaches the server or anything below it. What is kept from the guest
depends on the platform. Everywhere it has its own session, environment, folder and limits, and is
killed with all its children. Where the kernel grants namespaces (Linux, for root or where users may
have them) it has no network, sees no process but its own, cannot write outside its folder, and
does not see the folder of results. `docs/running.md` says what is left open.
"""
